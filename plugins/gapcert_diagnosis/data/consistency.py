"""Is a recording what it is taken for: rows in order of time, a time in s, joints that keep clear of their ends?"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapcert.plugin import Array, Model, Recording, StateSpec, Trajectory, UsageError
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.thresholds import THRESHOLDS

from .dataset import Dataset

UNITS = {"ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60, "h": 1 / 3600}  # how much too slow a motion is, if read in s


def ordered(recording: Recording) -> None:
    """Refuses rows that are in no order of time."""
    for tr in recording.trajectories:
        step = np.diff(tr.t[np.isfinite(tr.t)])
        if (back := int((step < 0).sum())) > THRESHOLDS.backward_rows * len(tr) and (step > 0).any():
            raise UsageError(
                f"recording: trajectory '{tr.name}': time goes back after {back:,} of {len(tr):,} rows; "
                "expected rows in the order of time; sort them, or name the column that tells trajectories apart, "
                "recording.trajectory",
                ("recording",),
            )


def agreeing(model: Model, recording: Recording) -> None:
    """Refuses a recording in which measured positions move 1000 (10⁶, 1/60) times slower than their velocities say."""
    for q, v in ((c, f"{c}_dot") for c in model.coordinates if {c, f"{c}_dot"} <= set(recording.names)):
        units = {s.name: s.unit for s in model.outputs if s.name in (q, v)}
        if len(units) < 2 or next(s for s in model.outputs if s.name == q).kind == "quaternion":
            continue
        read = recording.converted(units)
        found = [two for tr in read.trajectories if (two := _moved(tr, q, v)) is not None]
        if not found:
            continue
        moved, said = (np.concatenate(one) for one in zip(*found, strict=True))
        size = np.sqrt(np.sum(moved**2) * np.sum(said**2))
        if not size or np.sum(moved * said) < THRESHOLDS.motion_agreement * size:
            continue
        slower = float(np.sqrt(np.sum(said**2) / np.sum(moved**2)))
        ratio = float(f"{max(slower, 1 / slower):.2g}")
        times = f"about {ratio:,.0f} times {'slower' if slower > 1 else 'faster'}"
        for unit, factor in UNITS.items():
            if abs(slower / factor - 1) < THRESHOLDS.unit_error:
                raise UsageError(
                    f"recording: {q} moves {times} than {v} says, with samples {recording.period:.6g} s apart; "
                    f"expected one motion; is the time in {unit}? Then give the unit of that column, recording.units: "
                    f"{{TIME: {unit}}}; otherwise mend the unit of {v}",
                    ("recording",),
                )


def _moved(tr: Trajectory, q: str, v: str) -> tuple[Array, Array] | None:
    """From one sample to the next: the move of q, and that which v makes; turns are left out, and so are the clock's jumps."""
    rate = tr.channels[v]
    with np.errstate(invalid="ignore"):
        step = np.diff(tr.t)
        moved, said = np.diff(tr.channels[q]), step * (rate[1:] + rate[:-1]) / 2
    good = np.isfinite(moved) & np.isfinite(said) & (step > 0) & (step < 1.5 * tr.period) & (np.abs(moved) < np.pi)
    return (_eased(moved[good]), _eased(said[good])) if good.sum() > THRESHOLDS.eased_steps else None


def _eased(steps: Array) -> Array:
    return np.convolve(steps, np.ones(THRESHOLDS.eased_steps), mode="valid")


def kept_within(model: Model, *logs: Dataset) -> tuple[str, ...]:
    """What is taken for granted of `model.within`, in words. UsageError where the data reach an end.

    A state reaches it where the distance is no larger than what it moves from one sample to the next, noise included.
    """
    nearest, unseen = dict[str, tuple[float, str]](), list[str]()
    for s in (*model.states, *model.inputs):
        if (ends := model.within.get(s.name)) is None:
            continue
        seen = [found for m in logs for found in _seen(model, m, s)]
        if not seen:
            unseen.append(s.name)
            continue
        step = max(float(np.abs(np.diff(v)).max(initial=0.0)) for v in seen)
        low, high = min(float(v.min()) for v in seen) - ends[0], ends[1] - max(float(v.max()) for v in seen)
        distance, end = (low, ends[0]) if low < high else (high, ends[1])
        # What an engine cuts, it leaves alone up to the end.
        if distance < 0 or (distance <= step and s in model.states):
            raise UsageError(
                f"recording: {s.name} comes to {max(distance, 0.0):.3g} {s.unit} from {end:.6g} {s.unit}, where the robot file "
                f"ends its range, and moves by up to {step:.3g} {s.unit} between samples; expected data that keep clear of "
                f"ends, which the equations of the bodies do not know; leave such stretches out"
            )
        if s.unit not in nearest or distance < nearest[s.unit][0]:
            nearest[s.unit] = distance, f"{distance:.3g} {s.unit} ({s.name}, to {end:.6g} {s.unit})"
    said = f"no limit of a joint is reached: the data come no nearer than {', '.join(t for _, t in nearest.values())}"
    blind = f"no limit of {', '.join(unseen)} is reached, which the data do not show"
    return (*((said,) if nearest else ()), *((blind,) if unseen else ()))


def _seen(model: Model, m: Dataset, s: StateSpec) -> Iterator[Array]:
    """Piece by piece, the values of an input or of a state that is measured; of a velocity also where its position is."""
    channels = [c.name for c in m.channels]
    if s in model.inputs:
        yield from (u[:, model.inputs.index(s)] for u in m.inputs)
    elif s.name in channels:
        k = channels.index(s.name)
        yield from (y[w[:, k] > 0, k] for y, w in zip(m.outputs, m.weights, strict=True) if (w[:, k] > 0).any())
    elif s.name.removesuffix("_dot") in channels:
        yield from (x[:, model.states.index(s)] for x in m.states)


def doubt(fitted: Fit) -> tuple[str, ...]:
    """What is taken for granted, in words, where a fit whose windows begin where they like follows none of the channels."""
    m, seconds = fitted.windows.measured, fitted.windows.length * fitted.windows.measured.period
    off = np.sqrt(fitted.chi) * m.sigma
    if not ((off > THRESHOLDS.lost_spread * m.spread).all() and fitted.chi.max() > THRESHOLDS.lost_floor):
        return ()
    return (
        f"time, units and signs are as the spec says: samples are {m.period:.6g} s apart. The simulation follows nothing over "
        f"{seconds:.3g} s, even from a start of its own; look at recording.units (is the time in ms?), recording.columns, and "
        "the model's units and signs first",
    )
