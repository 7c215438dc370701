"""How far computed steps may be from exact ones on Z: proved over a cover where there is text, else as the System states it."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final
from weakref import ref

import numpy as np

from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Model, System
from gapcert.contracts.thresholds import THRESHOLDS
from gapcert.numerics.arrays import Array
from gapcert.numerics.intervals import Interval

_KNOWN = deque[tuple[Any, Any, "Arithmetic"]](maxlen=4)  # gates, questions and margins ask the same of one pair of systems


@final
@dataclass(frozen=True)
class Arithmetic:
    """e (nx,) of one System on Z, see `Model.rounding_over`; `proved`, or an assumption.

    terms: per state the term whose rounding has the largest share, empty where e is as small as the state's own last digits.
    jitter (nx,): of an engine, by how much close answers left a parabola; e covers four times that.
    """

    e: Array
    proved: bool = False
    terms: tuple[str, ...] = ()
    jitter: Array | None = None

    @classmethod
    def of(cls, system: System, domain: Domain) -> Arithmetic:
        """By a Model's proof, where there is one; else what the System states at the largest |x⁺| on corners of Z and points
        in it, and for a Model no less than what is proved there.
        """
        own = ref(system), ref(domain)
        known = next((e for *asked, e in _KNOWN if asked[0] is own[0] and asked[1] is own[1]), None)
        if known is None:
            _KNOWN.append((*own, known := cls._of(system, domain)))
        return known

    @classmethod
    def _of(cls, system: System, domain: Domain) -> Arithmetic:
        points = _points(domain)
        text = system if isinstance(system, Model) else None
        boxes = Interval.concatenate([domain.interval, Interval.exact(points)])
        if text is None or (over := text.rounding_over(boxes)) is None:
            return cls(system.resolution(_size(system, points)))
        boxes, bound, least = domain.interval, over[:1], over[1:].max(axis=0)
        size = text.enclosure(boxes).mag
        if np.isinf(bound).any() or (bound > text.resolution(size[0]) / 2).any():
            boxes, bound = _covered(text, domain, bound, least)
            if not np.isfinite(bound).all():
                stated = text.resolution(_size(text, points))
                return cls(np.maximum(stated, np.where(np.isfinite(least), 2 * least, 0.0)))
            size = text.enclosure(boxes).mag if len(boxes) > 1 else size
        # f̂ − f, whole turns of it, and r − p round in turn, by u = eps / 2 of |f̂| + |f| or of that and a few turns.
        e = bound.max(axis=0) + 2 * np.finfo(float).eps * size.max(axis=0)
        plain = e <= THRESHOLDS.rounding_plain * text.resolution(_size(text, points))
        worst = ("",) * len(e) if plain.all() else text.rounding_terms(boxes[(bound / e).max(axis=1).argmax()][None])
        return cls(e, True, tuple("" if small else term for small, term in zip(plain, worst, strict=True)))

    def covering(self, jitter: Array | None) -> Arithmetic:
        """With e no less than four times what was seen at some points of Z."""
        return self if jitter is None else replace(self, e=np.maximum(self.e, 4 * jitter), jitter=jitter)

    def to_data(self) -> dict[str, Any]:
        """JSON-able."""
        seen = {"proved": self.proved, "terms": list(self.terms)}
        return {"e": self.e.tolist(), **seen} | ({} if self.jitter is None else {"jitter": self.jitter.tolist()})


def sentence(backend: Arithmetic, model: Arithmetic, names: Sequence[str]) -> str:
    """What both are within, and what of that is proved."""
    each = ", ".join(f"e({n}) = {e:.2g}" for n, e in zip(names, backend.e + model.e, strict=True))
    here, there = _known(model), _known(backend)
    how = f"of both it {here}" if here == there else f"of f̂ it {there}, and of f it {here}"
    one = f"One step of f̂ and of f, as computed, is within e of its exact value: {each}; {how}."
    return " ".join([one, *named(backend, model, names)])


def _known(a: Arithmetic) -> str:
    if a.jitter is not None:
        by = f"close answers leave a parabola by, {a.jitter.max():.2g} at most"
        return f"is measured, not proved: it covers four times what {by}"
    return "is proved by a running error analysis of the equations" if a.proved else "is assumed as it is stated, not proved"


def named(backend: Arithmetic, model: Arithmetic, names: Sequence[str]) -> list[str]:
    """Terms with which text cancels badly, and states of f̂ that jitter by more than is stated."""
    seen = zip(names, backend.e, () if backend.jitter is None else backend.jitter, strict=False)
    return [f"e({n}) of f̂ is four times its jitter, which is more than is stated." for n, e, j in seen if e == 4 * j > 0] + [
        f"Most of e({n}) is the rounding of {term} in {of}."
        for of, a in (("f̂", backend), ("f", model))
        for n, term in zip(names, a.terms, strict=False)
        if term
    ]


def _size(system: System, z: Array) -> Array:
    return np.asarray(np.abs(system.step(z[:, : system.nx], z[:, system.nx :]).x).max(axis=0))


def _covered(model: Model, domain: Domain, bound: Array, least: Array) -> tuple[Interval, Array]:
    """(boxes that cover Z, bounds over each (n, nx)), from `bound` over Z's box and the largest at points of Z, `least` (nx,).

    Boxes are cut across their widest axis while a bound is well above those at points.
    """
    boxes, width = domain.interval, np.maximum(domain.width, np.finfo(float).tiny)
    while True:
        over = (bound / np.maximum(least, np.finfo(float).tiny)).max(axis=1)
        most = THRESHOLDS.rounding_boxes * (1 if over.max() < THRESHOLDS.rounding_wide else 8)
        urgent = np.flatnonzero(~(over <= 2))[: max(0, most - len(boxes))]
        if not len(urgent):
            return boxes, bound
        parts = boxes[urgent].cut(((boxes.hi - boxes.lo)[urgent] / width).argmax(axis=1))
        parts = parts[~domain.outside(parts)]
        kept, finer = np.delete(np.arange(len(boxes)), urgent), np.asarray(model.rounding_over(parts))
        boxes, bound = Interval.concatenate([boxes[kept], parts]), np.concatenate([bound[kept], finer])


def _points(domain: Domain) -> Array:
    """Corners of Z, drawn where there are many, or what relations leave of the way there; its centre, and points inside."""
    rng, n, nz = np.random.default_rng(0), THRESHOLDS.rounding_points, len(domain.low)
    sides = np.indices((2,) * nz).reshape(nz, -1).T if 2**nz <= n else rng.integers(2, size=(n, nz))
    ends = domain.reach(domain.centre, np.where(sides, domain.high, domain.low))
    return np.concatenate([domain.centre[None], ends, domain.draw(n, rng)])
