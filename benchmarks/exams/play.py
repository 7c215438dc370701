"""Experiments: where an answer is ambiguous, the proposed input is played on the hidden system, and fixed inputs beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import gapcert as gc
from exams import sit
from exams.sit import Record
from gapcert.testing.hidden.draw import Case, doubtful, generator
from gapcert.testing.hidden.rig import Rig, rig
from gapcert.testing.hidden.truth import Truth

FIXED = ("multisine", "steps", "chirp")


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
    played = {"designed": designed} | {kind: _fixed(case, kind, len(designed.u)) for kind in FIXED}
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


def _fixed(case: Case, kind: str, count: int) -> Rig:
    """A fixed input of the list, as long and as strong as the first log's."""
    rng = generator(f"fixed {kind}", case.seed, case.index)
    u = rig(case.rig.plant.name, kind, case.rig.period, count * case.rig.period, rng).u
    peak = np.abs(case.rig.u).max(axis=0)
    return case.rig.given(u * peak / np.maximum(np.abs(u).max(axis=0), 1e-12))


def _recorded(case: Case, second: Rig, name: str) -> gc.Trajectory:
    salt = 10 + ("designed", *FIXED).index(name)
    return replace(case, rig=second).recording(salt=salt).trajectories[0]


def _equal(case: Case, members: set[tuple[str, str]], played: Mapping[str, Rig]) -> set[tuple[str, str]]:
    """The truth, and the members that fit every one of these logs without noise as well as the truth does."""
    (hidden,) = case.hidden
    rng = generator("same", case.seed, case.index)
    truths = [Truth(second, case.hidden, case.noise.sigma) for second in played.values()]
    return {hidden.key} | {k for k in members - {hidden.key} if all(t.resembles(hidden, k, rng) for t in truths)}
