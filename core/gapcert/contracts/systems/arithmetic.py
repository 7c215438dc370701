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
    jitter (nx,): of an engine, by how much answers a few ulp apart left a parabola; e covers twice that.
    """

    e: Array
    proved: bool = False
    terms: tuple[str, ...] = ()
    jitter: Array | None = None

    @classmethod
    def of(cls, system: System, domain: Domain) -> Arithmetic:
        """By a Model's proof, where there is one; else what the System states at the largest |x⁺| on Z's corners and centre,
        and for a Model no less than what is proved at points of Z.
        """
        own = ref(system), ref(domain)
        known = next((e for *asked, e in _KNOWN if asked[0] is own[0] and asked[1] is own[1]), None)
        if known is None:
            _KNOWN.append((*own, known := cls._of(system, domain)))
        return known

    @classmethod
    def _of(cls, system: System, domain: Domain) -> Arithmetic:
        if not isinstance(system, Model) or (bound := system.rounding_over(domain.interval)) is None:
            return cls(system.resolution(_largest(system, domain)))
        boxes, points = domain.interval, _points(domain)
        if (bound > system.resolution(system.enclosure(boxes).mag[0]) / 2).any():
            boxes, bound, least = _covered(system, domain, bound, points)
            if not np.isfinite(bound).all():
                stated = system.resolution(_largest(system, domain))
                return cls(np.maximum(stated, np.where(np.isfinite(least), 2 * least, 0.0)))
        # f̂ − f, whole turns of it, and r − p round in turn, by u = eps / 2 of |f̂| + |f| or of that and a few turns.
        e = bound.max(axis=0) + 2 * np.finfo(float).eps * system.enclosure(boxes).mag.max(axis=0)
        plain = e <= THRESHOLDS.rounding_plain * system.resolution(_size(system, points))
        worst = ("",) * len(e) if plain.all() else system.rounding_terms(boxes[(bound / e).max(axis=1).argmax()][None])
        return cls(e, True, tuple("" if small else term for small, term in zip(plain, worst, strict=True)))

    def covering(self, jitter: Array | None) -> Arithmetic:
        """With e no less than twice what was seen at some points of Z."""
        return self if jitter is None else replace(self, e=np.maximum(self.e, 2 * jitter), jitter=jitter)

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
        return f"is measured, not proved: it covers twice what close answers leave a parabola by, {a.jitter.max():.2g} at most"
    return "is proved by a running error analysis of the equations" if a.proved else "is assumed as it is stated, not proved"


def named(backend: Arithmetic, model: Arithmetic, names: Sequence[str]) -> list[str]:
    """Terms with which text cancels badly, and states of f̂ that jitter by more than is stated."""
    seen = zip(names, backend.e, () if backend.jitter is None else backend.jitter, strict=False)
    return [f"e({n}) of f̂ is twice its jitter, which is more than is stated." for n, e, j in seen if e == 2 * j > 0] + [
        f"Most of e({n}) is the rounding of {term} in {of}."
        for of, a in (("f̂", backend), ("f", model))
        for n, term in zip(names, a.terms, strict=False)
        if term
    ]


def _largest(system: System, domain: Domain) -> Array:
    """Max |x⁺| (nx,) on Z's corners and centre. Where relations cut a corner off, the last point of Z on the way stands in."""
    corners = np.stack(np.meshgrid(*zip(domain.low, (domain.low + domain.high) / 2, domain.high, strict=True)), axis=-1)
    return _size(system, domain.reach(domain.centre, corners.reshape(-1, len(domain.low))))


def _size(system: System, z: Array) -> Array:
    return np.asarray(np.abs(system.step(z[:, : system.nx], z[:, system.nx :]).x).max(axis=0))


def _covered(model: Model, domain: Domain, bound: Array, points: Array) -> tuple[Interval, Array, Array]:
    """(boxes that cover Z, bounds over each (n, nx), the largest of those at points of Z (nx,)), from `bound` over Z's box.

    Boxes are cut across their widest axis while a bound is well above those at points.
    """
    boxes, width = domain.interval, np.maximum(domain.width, np.finfo(float).tiny)
    least = np.asarray(model.rounding_over(Interval.exact(points))).max(axis=0)
    while True:
        over = (bound / np.maximum(least, np.finfo(float).tiny)).max(axis=1)
        most = THRESHOLDS.rounding_boxes * (1 if over.max() < THRESHOLDS.rounding_wide else 8)
        urgent = np.flatnonzero(~(over <= 2))[: max(0, most - len(boxes))]
        if not len(urgent):
            return boxes, bound, least
        parts = boxes[urgent].cut(((boxes.hi - boxes.lo)[urgent] / width).argmax(axis=1))
        parts = parts[~domain.outside(parts)]
        kept, finer = np.delete(np.arange(len(boxes)), urgent), np.asarray(model.rounding_over(parts))
        boxes, bound = Interval.concatenate([boxes[kept], parts]), np.concatenate([bound[kept], finer])


def _points(domain: Domain) -> Array:
    """Corners of Z, or what relations leave of the way there, and points inside."""
    rng, n = np.random.default_rng(0), THRESHOLDS.rounding_points
    ends = np.where(rng.random((n, len(domain.low))) < 0.5, domain.low, domain.high)
    return np.concatenate([domain.reach(domain.centre, ends), domain.draw(n, rng)])
