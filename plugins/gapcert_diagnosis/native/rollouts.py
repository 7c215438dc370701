"""Measured motions beside rollouts from their own starts: errors per trajectory, over short horizons and to the end."""

from __future__ import annotations

import hashlib
import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import final

import numpy as np

from gapcert.plugin import DAMAGE, Array, Recording, UsageError, difference, npz_bytes, rotated, write_atomic
from gapcert_diagnosis.data.dataset import once
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import Group, NativeModel

from .candidates import CONTACT, tried

_PAIRS = (("position", "velocity"), ("rotation", "rate"))


@final
@dataclass(frozen=True)
class Motions:
    """Trajectories as states (T, nx) and inputs (T, nu) of a model, one sample per period.

    sigma, spread (G,): noise floor and size of each group of states. exact: of a simulator, whose states are starts. recent:
    the last rollouts by trajectory and first sample, with their model; a longer horizon goes on where these end.
    """

    model: NativeModel
    names: tuple[str, ...]
    states: tuple[Array, ...]
    inputs: tuple[Array, ...]
    t: tuple[Array, ...]
    sigma: Array
    spread: Array
    exact: bool = False
    order: tuple[int, ...] = ()
    known: dict[tuple[str, int, int, int], Array] = field(default_factory=dict, repr=False)
    recent: dict[tuple[int, int], tuple[NativeModel, Array]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, model: NativeModel, recording: Recording) -> Motions:
        """UsageError where a state is not measured, or where time is not even."""
        names = channels(model)
        if lacking := [n for n in (*names, *(u.name for u in model.inputs)) if n not in recording.names]:
            raise UsageError(
                f"recording.columns: '{lacking[0]}' is missing; rollouts start from measured states: expected "
                f"{', '.join(names)}; name its column",
                ("recording", "columns"),
            )
        units = {n: s.unit for s in (*model.states, *model.inputs) for n in _columns(s.name, s.size)}
        recording = recording.converted({n: u for n, u in units.items() if n in recording.names})
        states, inputs, times = [], [], []
        for tr in recording.trajectories:
            steps = np.diff(tr.t)
            if not np.allclose(steps, model.period, rtol=0, atol=THRESHOLDS.uneven_step * model.period):
                worst = float(steps[np.argmax(np.abs(steps - model.period))])
                raise UsageError(
                    f"recording: trajectory '{tr.name}' has a step of {worst:.6g} s; expected {model.period:.6g} s, the "
                    f"period of the model, throughout; cut or resample the log"
                )
            x = np.stack([tr.channels[n] for n in names], axis=1)
            u = np.stack([tr.channels[u.name] for u in model.inputs], axis=1) if model.inputs else np.empty((len(x), 0))
            if not (np.isfinite(x).all() and np.isfinite(u).all()):
                raise UsageError(f"recording: trajectory '{tr.name}' has values that are missing; leave it out")
            states.append(_unit(model, x))
            inputs.append(u)
            times.append(tr.t)
        sizes = np.array([[_noise(g, x), _size(g, x)] for x in states for g in model.groups])
        noise, spread = np.sqrt(np.mean(sizes.reshape(len(states), -1, 2) ** 2, axis=0)).T
        floor = np.maximum(noise, 1e-5 * spread)
        return cls(model, tuple(tr.name for tr in recording.trajectories), tuple(states), tuple(inputs), tuple(times), floor,
                   spread, bool(recording.noise), tuple(range(len(states))))  # fmt: skip

    def __len__(self) -> int:
        return len(self.states)

    def some(self, most: int) -> Motions:
        """At most so many of them, evenly spread; noise and size stay."""
        picks = sorted({int(k) for k in np.linspace(0, len(self) - 1, min(most, len(self)))})
        return self.take(picks)

    def take(self, picks: Sequence[int]) -> Motions:
        """Some of them; noise and size stay."""
        states, inputs, t = (tuple(a[k] for k in picks) for a in (self.states, self.inputs, self.t))
        names, order = tuple(self.names[k] for k in picks), tuple(self.order[k] for k in picks)
        return replace(self, names=names, states=states, inputs=inputs, t=t, order=order, recent={})

    @cached_property
    def digest(self) -> str:
        total = hashlib.sha256(f"{self.model.digest()} {self.exact}".encode())  # these have a part in the starts
        for array in (*self.states, *self.inputs, self.sigma):
            total.update(np.ascontiguousarray(array).tobytes())
        return total.hexdigest()

    def pieces(self, horizon: float) -> list[tuple[int, int, int]]:
        """(trajectory, first sample, steps): side by side, from one to the end where the horizon is longer than that."""
        steps = max(1, round(horizon / self.model.period))
        out = []
        for i, x in enumerate(self.states):
            last = len(x) - 1
            starts = range(0, max(1, last - steps + 1), steps)
            out += [(i, s, min(steps, last)) for s in starts]
        return out

    def starts(self, model: NativeModel, pieces: Sequence[tuple[int, int, int]]) -> Array:
        """(n, nx): the measured states, or what the flight from there says; for all hypotheses that fly alike the same."""
        if self.exact:
            return np.stack([self.states[i][s] for i, s, _ in pieces])
        flight, most = _flying(model, self.model), max(1, round(THRESHOLDS.start_lead / self.model.period))
        of = flight.digest()
        keys = [(of, self.order[i], s, min(steps, most)) for i, s, steps in pieces]
        new = {key: piece for key, piece in zip(keys, pieces, strict=True) if key not in self.known}
        if new:
            seen = np.full((len(new), most + 1, self.model.nx), np.nan)
            u = np.zeros((len(new), most, self.model.nu))
            for k, ((*_, steps), (i, s, _)) in enumerate(new.items()):
                seen[k, : steps + 1], u[k, :steps] = self.states[i][s : s + steps + 1], self.inputs[i][s : s + steps]
            self.known.update(zip(new, _settled(flight, self.sigma, seen, u), strict=True))
        return np.stack([self.known[key] for key in keys])

    def rolled(
        self, model: NativeModel, horizon: float, starts: Array | None = None
    ) -> tuple[list[tuple[int, int, int]], Array]:
        """(pieces, states (n, steps + 1, nx)) of rollouts from their `starts`, or those given; NaN beyond a piece's end.

        Those that the last rollouts of this model have begun go on from there.
        """
        pieces = self.pieces(horizon)
        order = np.array(sorted(range(len(pieces)), key=lambda k: -pieces[k][2]))
        lengths = np.array([pieces[k][2] for k in order])
        x = self.starts(model, pieces) if starts is None else starts
        out = np.full((len(pieces), int(lengths[0]) + 1, model.nx), np.nan)
        begun = np.zeros(len(pieces), dtype=np.intp)
        for k, (i, s, steps) in enumerate(pieces):
            part = self._begun(model, (i, s), x[k])[: steps + 1]
            out[k, : len(part)], begun[k] = part, len(part) - 1
        legs = {int(q) for q in np.quantile(lengths, np.linspace(0, 1, THRESHOLDS.rollout_legs + 1), method="nearest")} | set(
            begun.tolist()
        )
        for done, leg in itertools.pairwise(sorted(legs | {0})):
            rows = order[(lengths > done) & (begun[order] <= done)]
            if not len(rows):
                continue
            u = np.zeros((len(rows), leg - done, model.nu))
            for r, k in enumerate(rows.tolist()) if model.nu else ():
                i, s, steps = pieces[k]
                here = self.inputs[i][s + done : s + min(leg, steps)]
                u[r, : len(here)] = here
            out[rows, done : leg + 1] = model.rollout(out[rows, done], u).x
        for k, (_, _, steps) in enumerate(pieces):
            out[k, steps + 1 :] = np.nan
        self.recent.clear()
        self.recent.update({(i, s): (model, a[: steps + 1]) for (i, s, steps), a in zip(pieces, out, strict=True)})
        return pieces, out

    def _begun(self, model: NativeModel, place: tuple[int, int], x: Array) -> Array:
        """What is known of the rollout of a model from x: at least x."""
        of, states = self.recent.get(place, (model, x[None]))
        return states if of is model and states[0].tobytes() == x.tobytes() else x[None]

    def errors(self, model: NativeModel, horizon: float) -> Array:
        """(trajectories, groups, 3): mean square and mean of the error over time; mean over pieces of ½ ln(σ² + their e²)."""
        try:
            pieces, out = self.rolled(model, horizon)
        except UsageError:  # the engine cannot follow this hypothesis
            lost = THRESHOLDS.lost_rollout * self.spread
            return np.tile(np.stack([lost**2, lost, np.log(lost)], axis=-1), (len(self), 1, 1))
        return self.compared(pieces, out)

    def compared(self, pieces: Sequence[tuple[int, int, int]], out: Array, truth: Array | None = None) -> Array:
        """As `errors`, of rollouts that are known; truth: what they are compared with, by default the measurement."""
        sums, seen = np.zeros((len(self), len(self.model.groups), 3)), np.zeros((len(self), 2))
        for k, (i, s, steps) in enumerate(pieces):
            y = self.states[i][s + 1 : s + steps + 1] if truth is None else truth[k, 1 : steps + 1]
            for g, group in enumerate(self.model.groups):
                e = group.error(out[k, 1 : steps + 1], y)
                square = float(np.sum(e**2))
                sums[i, g] += square, np.sum(e), 0.5 * math.log(self.sigma[g] ** 2 + square / steps)
            seen[i] += steps, 1
        return np.asarray(sums / seen[:, None, [0, 0, 1]])


@final
class ErrorStore:
    """Errors of hypotheses, each computed once: in this process, and in a folder, from which an interrupted run goes on."""

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self.known: dict[str, Array] = {}
        self.computed = 0

    def errors(self, motions: Motions, model: NativeModel, horizons: Sequence[float]) -> Array:
        """(trajectories, horizons, groups, 3)."""
        return np.stack([self._one(motions, model, h) for h in horizons], axis=1)

    def _one(self, motions: Motions, model: NativeModel, horizon: float) -> Array:
        key = hashlib.sha256(f"{motions.digest} {model.digest()} {horizon!r}".encode()).hexdigest()[:32]
        return once(self.known, key, lambda: self._loaded(key, motions, model, horizon))

    def _loaded(self, key: str, motions: Motions, model: NativeModel, horizon: float) -> Array:
        path = None if self.folder is None else self.folder / f"{key}.npz"
        if path is not None and path.is_file():
            # What is damaged is computed again.
            with suppress(*DAMAGE), np.load(path, allow_pickle=False) as found:
                return np.asarray(found["errors"])
        errors = motions.errors(model, horizon)
        self.computed += 1
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(path, npz_bytes({"errors": errors}), flush=False)
        return errors


def channels(model: NativeModel) -> list[str]:
    """Names of the measured channels of a model: its states, `NAME.w`, `.x`, `.y`, `.z` of a rotation."""
    return [n for s in model.states for n in _columns(s.name, s.size)]


def score(errors: Array) -> Array:
    """(trajectories,): the mean over horizons, groups and pieces of ½ ln(σ² + e²), in nats: 0.1 less is an error 10 % smaller.

    The logarithm leaves a piece that no model can follow (chaos after an impact) one voice, like a flight that every model must
    follow: a wrong number that repairs impacts at the cost of flights is none.
    """
    return np.asarray(errors[..., 2].mean(axis=(1, 2)))


def sensitivity(motions: Motions, model: NativeModel, changes: Mapping[str, NativeModel], horizon: float) -> dict[str, Array]:
    """By how many noise floors each change moves the predictions of short rollouts, sample by sample, as one vector each.

    Each sample's change is cut at ten noise floors: impacts that happen or not say nothing of a slope.
    """
    weights = np.concatenate([np.full(_width(g), s) for g, s in zip(model.groups, motions.sigma, strict=True)])
    pieces, base = motions.rolled(model, horizon)
    out, starts = {}, motions.starts(model, pieces)
    for name, changed in changes.items():
        try:
            _, moved = motions.rolled(changed, horizon, starts)
        except UsageError:
            continue
        both = [(g, list(g.columns)) for g in model.groups]
        d = np.concatenate([difference(g.specs, moved[..., c], base[..., c]) for g, c in both], axis=-1)
        out[name] = np.clip(np.nan_to_num(d / weights), -10, 10).ravel()
    return out


def _flying(model: NativeModel, stated: NativeModel) -> NativeModel:
    """The model with the contacts of the stated one: what differs in contacts alone has one and the same flight."""
    return model.restated({p.name: p.value for p in stated.parameters if p.name in CONTACT})


def _settled(model: NativeModel, sigma: Array, seen: Array, u: Array) -> Array:
    """Starts (n, nx) of motions seen (n, T, nx), NaN beyond their ends, under u (n, T − 1, nu); sigma (G,): noise floors.

    A velocity from a filter is late, and one from a single sample is noisy. While a body flies, a wrong start shows in its
    place as an error that grows evenly: a line through the differences from the model's rollout is the error of the start,
    weighed against the velocity that was measured. As many samples count as tell the slope best, by their own misfit: an impact
    spoils it. Where a rollout with other contacts goes another way, or where no line fits, the start is the measured one.
    """
    groups = {g.output.name: (g, float(s)) for g, s in zip(model.groups, sigma, strict=True)}
    pairs = [(groups[a], groups[b]) for a, b in _PAIRS if a in groups and b in groups]
    start = seen[:, 0].copy()
    if not pairs:
        return start
    other = {p.name: values[0] for p in model.parameters if p.name in CONTACT and (values := tried(p))}
    rolled, touched = (m.rollout(start, u).x for m in (model, model.restated(other)))
    aloft = np.all([g.error(rolled, touched) <= THRESHOLDS.same_flight * s for g, s in groups.values()], axis=0)
    aloft = np.logical_and.accumulate(aloft, axis=1)
    now, moved = model.turned(start, back=False), np.zeros(len(start), dtype=bool)
    for (place, noise), (speed, spread) in pairs:
        columns = list(place.columns)
        with np.errstate(invalid="ignore"):
            off = difference(place.specs, seen[..., columns], rolled[..., columns])
        off[~aloft] = np.nan
        offset, slope = (noise * a for a in _line(model.period, off / noise, noise / spread))
        now[:, columns] = rotated(now[:, columns], offset) if place.specs[0].kind == "quaternion" else now[:, columns] + offset
        now[:, list(speed.columns)] += slope
        moved |= (offset != 0).any(axis=1)
    start[moved] = model.turned(now[moved], back=True)
    return start


def _line(period: float, off: Array, ratio: float) -> tuple[Array, Array]:
    """Offset and slope (n, 3) of the line with which each row of `off` (n, T, 3) begins, in noise floors; 0 where none does.

    1 / ratio: noise of the slope that was measured, which is 0.
    """
    t = period * np.arange(off.shape[1])
    n, t1, t2 = (np.cumsum(a)[:, None] for a in (np.ones_like(t), t, t**2))
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        y0, y1 = np.cumsum(off, axis=1), np.cumsum(t[:, None] * off, axis=1)
        wide = np.maximum(t2 - t1**2 / n, 1e-300)
        slope = (y1 - t1 / n * y0) / wide
        square = np.cumsum(off**2, axis=1) - y0**2 / n - wide * slope**2
        misfit = np.sum(square, axis=-1) / np.maximum(n[:, 0] - 2, 1)
        variance = np.maximum(misfit, 1.0) / wide[:, 0]
    variance[:, : THRESHOLDS.line_samples - 1] = np.inf
    variance[~(misfit <= THRESHOLDS.line_misfit**2)] = np.inf
    rows, best = np.arange(len(off)), np.argmin(variance, axis=1)
    found = np.isfinite(variance[rows, best])[:, None]
    b = np.where(found, slope[rows, best] / (1 + variance[rows, best] * ratio**2)[:, None], 0.0)
    return np.where(found, (y0[rows, best] - t1[best] * b) / n[best], 0.0), b


def _width(group: Group) -> int:
    return sum(3 if s.kind == "quaternion" else 1 for s in group.specs)


def _columns(name: str, size: int) -> list[str]:
    return [name] if size == 1 else [f"{name}.{a}" for a in "wxyz"]


def _unit(model: NativeModel, x: Array) -> Array:
    """With rotations of length 1."""
    at = 0
    for s in model.states:
        if s.kind == "quaternion":
            part = slice(at, at + s.size)
            length = np.linalg.norm(x[:, part], axis=1, keepdims=True)
            if (np.abs(length - 1) > 0.05).any():
                raise UsageError(f"recording: '{s.name}' has a length of {float(length.min()):.3g}; expected unit quaternions")
            x[:, part] /= length
        at += s.size
    return x


def _noise(group: Group, x: Array) -> float:
    """σ of the length of a group's noise, from the median of third differences; impacts are too few to move that."""
    specs, columns = group.specs, list(group.columns)
    d = np.diff(difference(specs, x[1:, columns], x[:-1, columns]), 2, axis=0)
    return float(np.sqrt(np.sum((1.4826 * np.median(np.abs(d), axis=0)) ** 2) / math.comb(6, 3)))


def _size(group: Group, x: Array) -> float:
    """How far a group moves: root mean square about its mean, or from its start where it turns."""
    specs, columns = group.specs, list(group.columns)
    y = x[:, columns]
    d = difference(specs, y, np.broadcast_to(y[:1], y.shape))
    centre = 0.0 if any(s.kind == "quaternion" for s in specs) else d.mean(axis=0)
    return float(np.sqrt(np.mean(np.sum((d - centre) ** 2, axis=1))))
