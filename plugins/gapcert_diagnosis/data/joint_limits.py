"""Ends of joints: what a recording must keep clear of, where the equations of the simulation know none."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gapcert.plugin import Array, Model, StateSpec, UsageError

from .dataset import Dataset


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
