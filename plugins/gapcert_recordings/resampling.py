"""Logs as they come, onto an even grid: clocks that jump, angles that wrap, samples that are lost, late or absurd.

Everything done is counted, and told.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import SHORTEST, TURN, Array, Bools, Hold, StateSpec, Trajectory, UsageError, circle, times
from gapcert_recordings.thresholds import THRESHOLDS

Rows = npt.NDArray[np.intp]
JITTER = 1e-3  # of the sampling period: below that, samples are evenly spaced
SHOWN = 3  # places of a kind that are told


@final
@dataclass
class Log:
    """What was found and repaired, as plain data.

    gaps, resets, cuts: where a trajectory was cut, because time jumped ahead, was set back, or an input moved unseen;
    dropped: rows that are missing; duplicates: rows whose time does not go forward; outliers, missing: values per channel that
    count for nothing; repaired: input values replaced; jitter: rms of the times about an even grid, in s; stamps: `ignored`
    where they were times of arrival of even samples; unused: s in stretches too short or too empty; resampled: `from` and `to`
    which period, in s, where samples are on another grid than their own.
    """

    gaps: list[dict[str, Any]] = field(default_factory=list)
    resets: list[dict[str, Any]] = field(default_factory=list)
    cuts: list[dict[str, Any]] = field(default_factory=list)
    dropped: int = 0
    duplicates: int = 0
    outliers: dict[str, int] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)
    repaired: dict[str, int] = field(default_factory=dict)
    jitter: float = 0.0
    stamps: str = "used"
    unused: float = 0.0
    resampled: dict[str, float] = field(default_factory=dict)

    def count(self, kind: str, names: Sequence[str], flags: Bools) -> None:
        """Add the flags (T, k) of each channel to `outliers`, `missing` or `repaired`."""
        table: dict[str, int] = getattr(self, kind)
        for name, n in zip(names, np.sum(flags, axis=0).tolist(), strict=True):
            if n:
                table[name] = table.get(name, 0) + int(n)


@final
@dataclass(frozen=True)
class Piece:
    """An uninterrupted stretch on an even grid of times t (T,): outputs y, weight, smooth and slope (T, ny), offset (T,).

    knots (K,): the times, in samples, from which the inputs u (K, nu) act; noise (ny,): σ of a single measurement.
    """

    t: Array
    y: Array
    weight: Array
    offset: Array
    smooth: Array
    slope: Array
    knots: Array
    u: Array
    noise: Array

    def means(self, repeat: int, hold: Hold) -> Array:
        """The mean input over each of `repeat` equal parts of every sample, (T·repeat, nu)."""
        return means(self.knots, self.u, np.arange(len(self.t) * repeat + 1) / repeat, hold)


def means(knots: Array, u: Array, edges: Array, hold: Hold) -> Array:
    """Exact means of u (K, nu) between successive edges (M + 1,), (M, nu); held, or straight from knot to knot."""
    # A part without a knot inside is taken at its middle, so that no digit is lost on an even grid.
    low, high = edges[:-1], edges[1:]
    first = np.searchsorted(knots, low, side="right") - 1
    inside = np.searchsorted(knots, high, side="left") - 1 > first
    out = np.empty((len(low), u.shape[1]))
    for j in range(u.shape[1]):
        if hold == "zero":
            out[:, j] = u[np.maximum(first, 0), j]
            total = np.concatenate([[0.0], np.cumsum(u[:-1, j] * np.diff(knots))])
        else:
            out[:, j] = np.interp((low + high) / 2, knots, u[:, j])
            total = np.concatenate([[0.0], np.cumsum((u[:-1, j] + u[1:, j]) / 2 * np.diff(knots))])
        area = [_integral(knots, u[:, j], total, e[inside], hold) for e in (low, high)]
        out[inside, j] = (area[1] - area[0]) / (high - low)[inside]
    return out


def _integral(knots: Array, u: Array, total: Array, at: Array, hold: Hold) -> Array:
    k = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 1)
    tau = at - knots[k]
    end = np.interp(at, knots, u) if hold == "first" else u[k]
    return np.asarray(total[k] + tau * (u[k] + end) / 2)


def pieces(
    tr: Trajectory,
    outputs: Sequence[StateSpec],
    inputs: Sequence[StateSpec],
    period: float,
    every: float | None,
    log: Log,
    exact: bool = False,
    rates: Mapping[int, int] = MappingProxyType({}),
) -> list[Piece]:
    """The usable stretches of a trajectory on a grid of `period`, or of `every` where that is given.

    rates: output → the output that is its derivative.
    exact: steps and kinks are the signal's own, and nothing is smoothed or left out for its size.
    """
    dt = period if every is None else tr.period
    rows, cuts = _clock(tr, log)
    t = tr.t[rows]
    for k in cuts:
        t[k:] += t[k - 1] + dt - t[k]
    y, u = _columns(tr, outputs, rows, t, rates, not exact), _columns(tr, inputs, rows, t, {})
    u = u if exact else _despiked(u, [s.name for s in inputs], log)
    cuts = sorted({0, len(t), *cuts, *_gaps(tr.name, t, u, dt, log)})
    found = []
    for start, stop in itertools.pairwise(cuts):
        part = slice(start, stop)
        known = int(np.isfinite(u[part]).all(axis=1).sum())
        if known < SHORTEST or np.isfinite(y[part]).sum(axis=0).min() < max(SHORTEST, known / 4):
            log.unused += float(t[stop - 1] - t[start])
            continue
        piece = _piece(t[part], y[part], u[part], outputs, dt, log, exact)
        piece = piece if every is None else _thinned(piece, dt, every)
        if len(piece.t) >= SHORTEST:
            found.append(piece)
    return found


def _clock(tr: Trajectory, log: Log) -> tuple[Rows, list[int]]:
    """(rows to keep, places among them where the clock was set back)."""
    kept = np.flatnonzero(np.isfinite(tr.t))
    kept = kept[np.diff(tr.t[kept], prepend=-np.inf) != 0]
    cuts: list[int] = []
    start = 0
    while True:
        t = tr.t[kept[start:]]
        late = np.concatenate([[False], t[1:] <= np.maximum.accumulate(t)[:-1]])
        edges = np.flatnonzero(np.diff(np.concatenate([[False], late, [False]])))
        runs = edges.reshape(-1, 2)
        back = runs[runs[:, 1] - runs[:, 0] > THRESHOLDS.stray_samples, 0]
        stop = int(back[0]) if len(back) else len(t)
        stray = start + np.flatnonzero(late[:stop])
        kept = np.delete(kept, stray)
        if not len(back):
            break
        start += stop - len(stray)
        cuts.append(start)
        log.resets.append({"trajectory": tr.name, "at": float(t[stop - 1]), "to": float(t[stop])})
        if len(cuts) > THRESHOLDS.clock_resets:
            raise UsageError(
                f"recording: trajectory '{tr.name}': time is set back more than {THRESHOLDS.clock_resets} times; "
                "expected a clock; name the "
                "column of times as `time`, or the column that tells trajectories apart as `trajectory`"
            )
    log.duplicates += len(tr.t) - len(kept)
    return kept, cuts


def readings(values: Array, fills: bool = True) -> Array:
    """A column (T,) with NaN for what is no measurement: beyond `no_measurement`, or what loggers fill holes with, such as
    -9999.

    Such a fill is one value other than zero, found more than once, further from all others than `fill_distance` times their
    range. What moves cannot come back to exactly the same place out there; at zero it can rest, an input anywhere: it is asked
    without `fills`.
    """
    out = np.where(np.abs(values) <= THRESHOLDS.no_measurement, values, np.nan)
    known = out[np.isfinite(out)]
    for end in (known.min(), known.max()) if fills and len(known) else ():
        rest = known[known != end]
        alone = len(rest) >= SHORTEST and np.abs(rest - end).min() > THRESHOLDS.fill_distance * np.ptp(rest) > 0
        if alone and end != 0 and np.sum(known == end) > 1:
            out[out == end] = np.nan
    return out


def _columns(
    tr: Trajectory, specs: Sequence[StateSpec], rows: Rows, t: Array, rates: Mapping[int, int], fills: bool = False
) -> Array:
    """Channels (T, k) of some rows, at times t (T,); what is no reading is NaN, and angles do not jump."""
    out = np.empty((len(rows), len(specs)))
    for j, spec in enumerate(specs):
        out[:, j] = readings(tr.channels[spec.name][rows], fills)
    for j, spec in enumerate(specs):
        if spec.kind == "angle":
            out[:, j] = unwrapped(out[:, j], t, tr.period, out[:, rates[j]] if j in rates else None)
    return out


def unwrapped(values: Array, t: Array, dt: float, rate: Array | None = None) -> Array:
    """Angles (T,) at times t (T,), `dt` apart, without jumps by whole turns; NaN stays. rate (T,): measured, in rad/s.

    From sample to sample an angle moves by less than half a turn. Over a hole it may turn several times: a log that counts
    turns itself is taken at its word, else the turn nearest to where the rate leads is meant.
    """
    rows = np.flatnonzero(np.isfinite(values))
    if len(rows) < 2:
        return values
    holes = 1 + np.flatnonzero((np.diff(rows) > 1) | (np.diff(t[rows]) > THRESHOLDS.hole_step * dt))
    runs = [rows[a:b] for a, b in itertools.pairwise([0, *holes.tolist(), len(rows)])]
    out = values.copy()
    for run in runs:
        out[run] = np.unwrap(values[run])
    wraps = any(np.abs(out[run] - values[run]).max() > 1 for run in runs)
    if not wraps and np.ptp(values[rows]) > TURN:
        return values
    for before, after in itertools.pairwise(runs):
        expected = out[before[-1]] + _moved(out, t, dt, before, after, rate, wraps)
        out[after] += TURN * circle.turns(expected, out[after[0]])
    return out


def _moved(angle: Array, t: Array, dt: float, before: Rows, after: Rows, rate: Array | None, turns: bool) -> float:
    """By how much an angle moved over a hole: by its measured rate, else at the speed of both ends if it is one that turns."""
    a, b = int(before[-1]), int(after[0])
    inner = slice(a + 1, b)
    if rate is not None and np.isfinite(rate[inner]).sum() >= ((t[b] - t[a]) / dt - 1) / 2:
        known = np.flatnonzero(np.isfinite(rate))
        at = np.arange(a, b + 1)
        return float(np.trapezoid(np.interp(at, known, rate[known]), t[at])) if len(known) else 0.0
    ends = [run for run in (before[-THRESHOLDS.hole_ends :], after[: THRESHOLDS.hole_ends]) if len(run) > 1]
    if not turns or not ends:
        return 0.0
    return float(t[b] - t[a]) * float(np.mean([(angle[e[-1]] - angle[e[0]]) / (t[e[-1]] - t[e[0]]) for e in ends]))


def _despiked(u: Array, names: Sequence[str], log: Log) -> Array:
    """Inputs without single readings far outside everything else."""
    out = u.copy()
    wild = np.zeros(u.shape, dtype=bool)
    for j in range(u.shape[1]):
        there = np.isfinite(u[:, j])
        if there.sum() < SHORTEST:
            raise UsageError(f"recording: input '{names[j]}' is missing nearly everywhere; expected numbers; repair the log")
        low, high = np.quantile(u[there, j], [0.01, 0.99])
        far = there & ((u[:, j] > high + 5 * (high - low)) | (u[:, j] < low - 5 * (high - low)))
        alone = far & ~np.roll(far, 1) & ~np.roll(far, -1)
        # A signal that rests between pulses has no range to be outside of.
        wild[:, j] = alone if high > low and alone.sum() <= 0.01 * len(u) else False
        out[wild[:, j], j] = np.nan
    log.count("repaired", names, wild)
    return out


def _gaps(name: str, t: Array, u: Array, dt: float, log: Log) -> list[int]:
    """Rows before which a trajectory is cut: time jumps ahead, or an input is unknown for too long."""
    known = np.isfinite(u).all(axis=1)
    rows = np.flatnonzero(known)
    if not len(rows):
        return []
    cuts: list[int] = []
    ahead = np.diff(t[rows])
    lost = np.round(ahead / dt).astype(int) - 1
    usual = [np.quantile(np.abs(np.diff(u[rows, j])), 0.9) for j in range(u.shape[1])]
    for k in np.flatnonzero(lost > 0).tolist():
        a, b = int(rows[k]), int(rows[k + 1])
        moved = any(abs(u[b, j] - u[a, j]) > THRESHOLDS.input_jump * usual[j] * (lost[k] + 1) for j in range(u.shape[1]))
        if lost[k] > THRESHOLDS.bridged_samples or moved:
            cuts += [a + 1, b]
            kind = log.gaps if lost[k] > THRESHOLDS.bridged_samples else log.cuts
            kind.append({"trajectory": name, "at": float(t[a]), "seconds": float(ahead[k])})
        else:
            log.dropped += int(lost[k]) - (b - a - 1)
    return cuts


def _piece(t: Array, y: Array, u: Array, outputs: Sequence[StateSpec], dt: float, log: Log, exact: bool) -> Piece:
    """On the grid of dt, every sample at the nearest node."""
    steps = np.diff(t) / dt
    even = bool((np.abs(steps - np.round(steps)) <= JITTER * np.round(steps)).all())
    if even:
        at = np.concatenate([[0], np.cumsum(np.round(steps))])
        start = t[0]
    else:
        phase = float(np.angle(np.mean(np.exp(2j * np.pi * (t - t[0]) / dt)))) / (2 * np.pi)
        start = t[0] + dt * phase
        at = (t - start) / dt
        start += dt * round(at[0])
        at -= round(at[0])
        log.jitter = max(log.jitter, float(dt * np.sqrt(np.mean((at - np.round(at)) ** 2))))
    node, row = _nearest(at)
    count = int(node[-1]) + 1
    values = np.full((count, y.shape[1]), np.nan)
    values[node] = y[row]
    offset = np.zeros(count)
    offset[node] = 0.0 if even else dt * (at[row] - node)
    knots, held = _knots(at, u)
    grid = np.interp(np.arange(count), at, t) if even else start + dt * np.arange(count)
    if exact:
        slope = np.gradient(values, dt, axis=0)
        return Piece(grid, values, np.ones_like(values), offset, values, slope, knots, held, np.zeros(values.shape[1]))
    return _smooth(grid, values, offset, knots, held, outputs, dt, log)


def _nearest(at: Array) -> tuple[Rows, Rows]:
    """(nodes, rows): for every node that has one, the sample nearest to it."""
    node = np.round(at).astype(int)
    order = np.lexsort((np.abs(at - node), node))
    nodes, first = np.unique(node[order], return_index=True)
    return nodes, order[first]


def _knots(at: Array, u: Array) -> tuple[Array, Array]:
    """Where the inputs act from, with a knot for every sample that was lost."""
    known = np.isfinite(u).all(axis=1)
    at, u = at[known], u[known]
    extra = np.maximum(np.round(np.diff(at)).astype(int) - 1, 0)
    if not len(at) or not extra.any():
        return at, u
    more = [at[k] + (at[k + 1] - at[k]) * np.arange(1, n + 1) / (n + 1) for k, n in enumerate(extra.tolist()) if n]
    knots = np.sort(np.concatenate([at, *more]))
    filled = np.empty((len(knots), u.shape[1]))
    for j in range(u.shape[1]):
        filled[:, j] = np.interp(knots, at, u[:, j])
    return knots, filled


def _smooth(
    t: Array, y: Array, offset: Array, knots: Array, u: Array, outputs: Sequence[StateSpec], dt: float, log: Log
) -> Piece:
    # Its filters load slowly, and a page of a report takes the words of `repairs` alone.
    from .smoothing import absurd, filled_in, noise_floor, smoothed

    there: Bools = np.isfinite(y)
    names = [s.name for s in outputs]
    wild = np.stack([absurd(np.where(there[:, j], y[:, j], 0.0), there[:, j]) for j in range(len(names))], axis=-1)
    log.count("outliers", names, wild)
    log.count("missing", names, ~there)
    valid = there & ~wild
    curves = [smoothed(y[:, j], valid[:, j], offset, dt) for j in range(len(names))]
    if offset.any():
        even = [noise_floor(filled_in(y[:, j], valid[:, j]), valid[:, j]) for j in range(len(names))]
        # A signal that is smoother over an even grid than over the times it came with was sampled evenly.
        if (
            np.nanmean([np.log(max(e, 1e-300) / max(c.noise, 1e-300)) for e, c in zip(even, curves, strict=True)])
            < THRESHOLDS.arrival_gain
        ):
            log.stamps, offset = "ignored", np.zeros_like(offset)
            curves = [smoothed(y[:, j], valid[:, j], offset, dt) for j in range(len(names))]
    smooth, slope = (np.stack([getattr(c, n) for c in curves], axis=-1) for n in ("value", "slope"))
    filled = np.where(valid, y, smooth)
    noise = np.array([c.noise for c in curves])
    if (np.sqrt(np.mean((slope * offset[:, None]) ** 2, axis=0)) < THRESHOLDS.unseen_jitter * noise).all():
        offset = np.zeros_like(offset)
    return Piece(t, filled, valid.astype(np.float64), offset, smooth, slope, knots, u, noise)


def _thinned(piece: Piece, dt: float, every: float) -> Piece:
    """On a coarser grid: the nearest sample of the outputs; the inputs keep their knots."""
    ratio = every / dt
    if abs(ratio - round(ratio)) <= JITTER * ratio:
        ratio, every = round(ratio), round(ratio) * dt
    count = int((len(piece.t) - 1) / ratio + 1e-6) + 1
    wanted = np.arange(count) * ratio
    row = np.minimum(np.round(wanted).astype(int), len(piece.t) - 1)
    late = row - wanted
    late[np.abs(late) < JITTER] = 0.0
    t = piece.t[0] + every * np.arange(count)
    rows = np.arange(len(piece.t))
    smooth, slope = (
        np.stack([np.interp(wanted, rows, column) for column in values.T], axis=-1) for values in (piece.smooth, piece.slope)
    )
    offset = piece.offset[row] + dt * late
    knots = piece.knots / ratio
    return Piece(t, piece.y[row], piece.weight[row], offset, smooth, slope, knots, piece.u, piece.noise)


def repairs(log: Mapping[str, Any]) -> Iterator[str]:
    """A clause each for what is not as it was logged, from a `Log` as plain data; nothing for a clean one."""
    if resets := log.get("resets"):
        yield f"the clock is set back{_places(resets)}, where the recording is cut"
    if gaps := log.get("gaps"):
        yield f"time jumps ahead{_places(gaps)}, where the recording is cut"
    if cuts := log.get("cuts"):
        yield f"an input moved unseen{_places(cuts)}, where the recording is cut"
    if n := log.get("duplicates"):
        yield f"{times(n, 'row')} whose time is missing or does not go forward {_are(n)} left out"
    if n := log.get("dropped"):
        yield f"{times(n, 'row')} {_are(n)} missing, and bridged"
    if found := log.get("resampled"):
        yield f"samples about {found['from']:.3g} s apart, unevenly, are put on a grid of {found['to']:.6g} s"
    if log.get("stamps") == "ignored":
        yield "times are taken for those of arrival, and replaced by even ones"
    for key, what in (("outliers", "far outside of everything around"), ("missing", "missing")):
        yield from (f"{times(n, 'value')} of {name} {_are(n)} {what}, and left out" for name, n in log.get(key, {}).items())
    yield from (
        f"{times(n, 'reading')} of {name} {_are(n)} far outside of everything else, and replaced"
        for name, n in log.get("repaired", {}).items()
    )
    if seconds := log.get("unused"):
        yield f"{seconds:.3g} s are in stretches too short or too empty to be used"


def _places(found: Sequence[Mapping[str, Any]]) -> str:
    said = ", ".join(f"{f['at']:.6g} s" for f in found[:SHOWN])
    return f" {len(found)} times (first at {said})" if len(found) > SHOWN else f" at {said}"


def _are(n: int) -> str:
    return "are" if n > 1 else "is"
