"""Backend against backend: how far apart, where, from which step on, and which settings would close the difference."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    Array,
    Build,
    Emit,
    Event,
    MissingDependency,
    Model,
    Pulse,
    SpecError,
    System,
    UsageError,
    difference,
)
from gapcert_engines import Options, changed

from .causes import answer
from .laboratory import Given, Laboratory, Peer, misfit, rebuilt
from .settings import Attempt, Change, Trial, candidates, explain

Judge = Callable[[Array, Array], tuple[float, bool]]
"""x⁺ of both → the mean difference between them, and whether it is within both resolutions."""
# A config's own check (ValueError), ours, and what the bindings of an engine raise for a value that it does not take.
_REFUSALS = (ValueError, TypeError, RuntimeError, UsageError, SpecError, MissingDependency)


@final
@dataclass(frozen=True)
class Meeting:
    """f̂_a − f̂_b at the common points: d (n, nx), both resolutions together e (nx,), and the length s (nx,) of a step's motion.

    `mean` = mean over states of mean|d_i| / s_i: the difference as a share of what one step moves.
    """

    d: Array
    e: Array
    s: Array

    @classmethod
    def of(cls, a: System, b: System, after: tuple[Array, Array], x: Array) -> Meeting:
        d = np.abs(difference(a.states, *after))
        e = a.resolution(np.abs(after[0]).max(axis=0)) + b.resolution(np.abs(after[1]).max(axis=0))
        motion = np.maximum(*(np.abs(difference(a.states, one, x)).mean(axis=0) for one in after))
        # A state that does not move at all, but for rounding, is measured by its own size.
        least = 1e3 * (a.rounding(np.abs(after[0]).max(axis=0)) + b.rounding(np.abs(after[1]).max(axis=0)))
        return cls(d, e, np.where(motion <= least, np.maximum(np.abs(x).max(axis=0), least), motion))

    @property
    def mean(self) -> float:
        return float((self.d.mean(axis=0) / self.s).mean())

    @property
    def noise(self) -> float:
        return float((self.e / self.s).mean())

    @property
    def resolved(self) -> np.ndarray:
        """(nx,): where more than both resolutions lies between the two."""
        return np.asarray(self.d.max(axis=0) > self.e)


@final
@dataclass(frozen=True)
class Pair:
    """What was found between two backends: the JSON entry, the drift (T + 1,) of a run, and the map around the worst point."""

    summary: dict[str, Any]
    drift: Array | None = None
    state: int = 0
    at: Array | None = None
    slice: Array | None = None


@final
@dataclass
class Pairs:
    """Compares backends two by two; what a backend answers with changed options is asked for once."""

    build: Build
    model: Model
    laboratory: Laboratory
    emit: Emit
    _answers: dict[str, Array | None] = field(default_factory=dict)

    def all(self, peers: Mapping[str, Peer]) -> Iterator[Pair]:
        """Every pair, in the order of the spec."""
        couples = list(itertools.combinations(peers.values(), 2))
        differ = explained = 0
        for k, (a, b) in enumerate(couples, 1):
            made = self.between(a, b)
            yield made
            differ += bool(made.summary.get("resolved"))
            explained += bool(made.summary["explained_by"])
            told = {"done": k, "total": len(couples), "unit": "pairs", "best": {"differ": differ, "explained": explained}}
            self.emit(Event("progress", "pairs", told))

    def between(self, a: Peer, b: Peer) -> Pair:
        """One pair."""
        head = {"a": a.name, "b": b.name}
        for peer in (a, b):
            if peer.apart:
                nothing: dict[str, Any] = dict.fromkeys(("mean", "max", "where"))
                return Pair({**head, **nothing, "explained_by": [], "refused": f"{peer.name}: {peer.apart}"})
        x = self.laboratory.domain.split(self.laboratory.z)[0]
        after = self.laboratory.successors(a.system), self.laboratory.successors(b.system)
        m = Meeting.of(a.system, b.system, after, x)
        row, state = np.unravel_index(int(np.argmax(m.d / m.s)), m.d.shape)
        names = [s.name for s in a.system.states]
        rollout, drift = self._rollouts(a, b, m)
        apart = bool(m.resolved.any())
        per_state = {
            n: {"mean": float(m.d[:, i].mean()), "max": float(m.d[:, i].max()), "resolution": float(m.e[i]),
                "relative": float(m.d[:, i].mean() / m.s[i]), "resolved": bool(m.resolved[i])}
            for i, n in enumerate(names)
        }  # fmt: skip
        summary = {
            **head,
            "mean": float(m.d.mean(axis=0).max()),
            "max": float(m.d.max()),
            "where": dict(zip([s.name for s in self.laboratory.domain.axes], self.laboratory.z[row].tolist(), strict=True)),
            "state": names[state],
            "relative": m.mean,
            "relative_max": float((m.d / m.s).max()),
            "resolved": apart,
            "states": per_state,
            "first_differing_step": rollout,
            "explained_by": self._explained(a, b, m, x) if apart and self.laboratory.asked.pairs.settings else [],
        }
        at = self.laboratory.z[row]
        return Pair(summary, drift, int(state), at, self._slice(a, b, at, int(state)) if apart else None)

    def _rollouts(self, a: Peer, b: Peer, m: Meeting) -> tuple[dict[str, Any], Array | None]:
        """First step at which any bit differs, and at which step k more than k resolutions do; None if there is none.

        Rounding adds at most e per step as long as the motion itself does not stretch it, hence k e.
        """
        asked = self.laboratory.asked.pairs
        if not asked.rollouts:
            return {"bits": None, "resolved": None, "steps": 0, "rollouts": 0}, None
        head = {"steps": asked.steps, "rollouts": asked.rollouts}
        try:
            xa, xb = self.laboratory.rollouts(a.system), self.laboratory.rollouts(b.system)
        except UsageError as error:
            return {"bits": None, "resolved": None, **head, "refused": str(error)}, None
        d = np.abs(difference(a.system.states, xa, xb))
        e = sum(p.system.resolution(np.abs(x).max(axis=(0, 1))) for p, x in ((a, xa), (b, xb)))
        steps = np.arange(asked.steps + 1)[None, :, None]
        found = {"bits": _first(xa != xb), "resolved": _first(d > steps * np.asarray(e)), **head}
        return found, np.asarray((d / m.s).max(axis=(0, 2)))

    def _slice(self, a: Peer, b: Peer, at: Array, state: int) -> Array | None:
        """|d| of one state (n, n) over the two axes of the map (row = second), others as at the worst point; NaN outside Z."""
        n, domain = self.laboratory.asked.pairs.cells, self.laboratory.domain
        if not n or len(domain.low) < 2:
            return None
        i, j = map_axes(self.laboratory)
        grid = (2 * np.arange(n) + 1) / (2 * n)
        z = np.tile(at, (n * n, 1))
        second, first = np.meshgrid(grid, grid, indexing="ij")
        z[:, i], z[:, j] = (domain.low[k] + domain.width[k] * g.ravel() for k, g in ((i, first), (j, second)))
        after = self.laboratory.successors(a.system, z), self.laboratory.successors(b.system, z)
        d = np.abs(difference(a.system.states, *after))[:, state]
        return np.where(domain.contains(z), d, np.nan).reshape(n, n)

    def _explained(self, a: Peer, b: Peer, m: Meeting, x: Array) -> list[dict[str, Any]]:
        def judge(one: Array, other: Array) -> tuple[float, bool]:
            d = np.abs(difference(a.system.states, one, other))
            return float((d.mean(axis=0) / m.s).mean()), bool((d.max(axis=0) <= m.e).all())

        pulse = Pulse(self.emit, f"settings of {a.name} and {b.name}", unit="settings")
        tried, best = itertools.count(1), [m.mean]

        def attempt(changes: tuple[Change, ...]) -> Trial | None:
            names = " + ".join(f"{c.on}.{c.setting}" for c in changes)
            pulse(next(tried), {"difference closed": f"{1 - min(best) / m.mean:.0%}"}, text=names)
            after = self._changed(a, changes), self._changed(b, changes)
            if after[0] is None or after[1] is None:
                return None
            made = Trial(changes, *judge(after[0], after[1]))
            best.append(made.mean)
            return made

        def diagnose(single: Sequence[Trial]) -> list[Trial]:
            """First of the backend whose own settings gain more: they are likely to be among the causes."""
            gains = {a.name: dict[str, float](), b.name: dict[str, float]()}
            for c, gain in ((t.changes[0], m.mean - t.mean) for t in single):
                gains[c.on][c.setting] = max(gain, gains[c.on].get(c.setting, 0.0))
            found: list[Trial] = []
            for one, other in sorted(((a, b), (b, a)), key=lambda pair: -sum(gains[pair[0].name].values())):
                found += self._diagnosed(one, other, judge, attempt)
                if any(t.done(m.mean) for t in found) or (found and any(t.closes for t in single)):
                    break
            return found

        changes = [*candidates(a, b), *candidates(b, a)]
        return explain(changes, attempt, m.mean, self.laboratory.asked.pairs.least, m.noise, diagnose)

    def _diagnosed(self, simulation: Peer, reality: Peer, judge: Judge, attempt: Attempt) -> list[Trial]:
        """What a diagnosis of one backend by the motion of the other names: made in the backend, or else in its equations."""
        there = self.laboratory.successors(reality.system)
        found = answer(simulation, reality, self.laboratory, lambda after: judge(after, there), self._rebuilt)
        if found.left is None:
            return []
        tried = [attempt(changes) for changes in found.alternatives] if found.made else []
        made = [replace(t, named=True) for t in tried if t is not None]
        # The rounded numbers stand first: fitted ones have to leave less.
        return [min(made, key=lambda t: t.mean)] if made else [Trial(found.alternatives[0], *found.left, False, True)]

    def _changed(self, peer: Peer, changes: Sequence[Change]) -> Array | None:
        """x⁺ of a backend with those of the changes that are on it; None where it refuses them."""
        mine = [c for c in changes if c.on == peer.name]
        if not mine:
            return self.laboratory.successors(peer.system)
        key = repr(sorted(c.key for c in mine))
        if key not in self._answers:
            options = {k: v for c in mine for k, v in c.options.items()}
            natives = {k: v for c in mine for k, v in c.natives.items()}
            self._answers[key] = self._tried(peer, options, natives)
        return self._answers[key]

    def _tried(self, peer: Peer, options: Options, natives: Mapping[str, float]) -> Array | None:
        system = self._rebuilt(peer, options) if options else peer.system
        if system is None:
            return None
        try:
            return self.laboratory.successors(Given(system, natives) if natives else system)
        except _REFUSALS:
            return None
        finally:
            if system is not peer.system:
                _close(system)

    def _rebuilt(self, peer: Peer, options: Options) -> System | None:
        """A backend with changed options; None where it refuses them or is no peer any more."""
        try:
            system = rebuilt(self.build, changed(peer.config, options), self.model)
        except _REFUSALS:
            return None
        if not misfit(self.model, system):
            return system
        _close(system)
        return None


def _close(system: System) -> None:
    if callable(close := getattr(system, "close", None)):
        close()


def map_axes(laboratory: Laboratory) -> tuple[int, int]:
    """Which two columns of z the maps are drawn over."""
    names = [s.name for s in laboratory.domain.axes]
    chosen = laboratory.asked.pairs.axes
    return (names.index(chosen[0]), names.index(chosen[1])) if chosen else (0, 1)


def _first(differs: np.ndarray) -> int | None:
    """The first step (second axis) at which anything differs."""
    steps = np.flatnonzero(differs.any(axis=(0, 2)))
    return int(steps[0]) if len(steps) else None
