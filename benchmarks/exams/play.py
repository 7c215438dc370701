"""Experiments: where an answer is ambiguous, the proposed input is played on the hidden system, and fixed inputs beside it.

All keep to the same limits of inputs and outputs, and to the same length.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import gapcert as gc
from exams import sit
from exams.hidden.draw import Case, doubtful, generator
from exams.hidden.rig import Rig, rig
from exams.hidden.truth import Truth
from exams.sit import Record
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.experiment import Limits
from gapcert_diagnosis.thresholds import THRESHOLDS

FIXED = ("multisine", "steps", "chirp")
LEAST = 100  # samples that are played of an input that leaves the limits at once


def experiment(seed: int, index: int, limit: float) -> Record:
    """The first answer; where it is ambiguous, the answers to it together with each second log."""
    case = doubtful("experiments", seed, index)
    asked, log = sit.question(case), case.recording()
    found: list[gc.Diagnosis] = []

    def first() -> Record:
        found.append(sit.diagnosed(case, "all", log))
        return sit.answer(found[0])

    record = asked | sit.timed(first, limit)
    if not found or found[0].verdict != "ambiguous" or found[0].design is None:
        return record
    designed = _designed(case, found[0].design.t, found[0].design.inputs)
    limits = _limits(case, log)
    played = {"designed": designed} | {kind: _fixed(case, kind, limits) for kind in FIXED}
    members = _members(found[0])
    record |= {"members": sorted(map(list, members)), "equal": sorted(map(list, _equal(case, members, played)))}
    for name, second in played.items():
        both = gc.Recording((log.trajectories[0], replace(_recorded(case, second, name), name="experiment")))
        record[name] = sit.timed(lambda both=both: sit.answer(sit.diagnosed(case, "all", both)), limit)
    return record


def _members(found: gc.Diagnosis) -> set[tuple[str, str]]:
    return {(c.effect, c.site) for c in found.causes} | {k for group in found.ambiguous_with for k in group}


def _designed(case: Case, t: Any, inputs: Mapping[str, Any]) -> Rig:
    """The proposed input, held at the log's own rate."""
    grid = np.arange(0.0, t[-1] - t[0] + 1e-9, case.rig.period)
    rows = np.clip(np.searchsorted(t - t[0], grid + 1e-9, side="right") - 1, 0, len(t) - 1)
    return case.rig.given(np.stack([np.asarray(inputs[name])[rows] for name in case.rig.plant.inputs], axis=1))


def _limits(case: Case, log: gc.Recording) -> Limits:
    """Those of a diagnosis to which nothing is said."""
    model = sit.model(case.model)
    return Limits.of(model, Dataset.of(model, log.split({"last": 0.25})[0]))


def _fixed(case: Case, kind: str, limits: Limits) -> Rig:
    """A fixed input of the list, as a design would choose its size: where the hidden system stays within the limits longest."""
    plant, period = case.rig.plant, case.rig.period
    u = rig(plant.name, kind, period, limits.seconds, generator(f"fixed {kind}", case.seed, case.index)).u
    low, high = np.array([limits.inputs[n] for n in plant.inputs]).T
    shape = u / np.maximum(np.abs(u).max(axis=0), 1e-12)
    names = (*plant.positions, *plant.velocities)
    columns = [names.index(n) for n in case.noise.sigma]
    least, most = np.array([limits.outputs[n] for n in case.noise.sigma]).T
    best, worth = case.rig.given(u), -1.0
    for size in THRESHOLDS.input_sizes:
        tried = case.rig.given(size * ((low + high) / 2 + (high - low) / 2 * shape))
        y = tried.play(case.hidden).x[:, columns]
        inside = ((y >= least) & (y <= most)).all(axis=1)
        kept = len(y) if inside.all() else int(np.argmin(inside))
        if size * kept > worth:
            best, worth = case.rig.given(tried.u[: max(kept, LEAST)]), size * kept
    return best


def _recorded(case: Case, second: Rig, name: str) -> gc.Trajectory:
    salt = 10 + ("designed", *FIXED).index(name)
    return replace(case, rig=second).recording(salt=salt).trajectories[0]


def _equal(case: Case, members: set[tuple[str, str]], played: Mapping[str, Rig]) -> set[tuple[str, str]]:
    """The truth, and the members that fit every one of these logs without noise as well as the truth does."""
    (hidden,) = case.hidden
    rng = generator("same", case.seed, case.index)
    truths = [Truth(second, case.hidden, case.noise.sigma) for second in played.values()]
    return {hidden.key} | {k for k in members - {hidden.key} if all(t.resembles(hidden, k, rng) for t in truths)}
