"""Experiments: where an answer is ambiguous, the proposed input is played on the hidden system, from where it says.

Every sixth case is a robot, the others are plants of another hand. Beside the answer to both logs stands how far the rivals of
the truth then are apart without noise, and how far the motion left the range of the recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import gapcert as gc
from exams import plain, sit
from exams.hidden import draw
from exams.sit import Record
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.experiment import Limits
from gapcert_diagnosis.fitting.fit import Fit, fit, promising
from gapcert_diagnosis.results import Experiment
from gapcert_diagnosis.search.candidates import Library

Key = tuple[str, str]


def experiment(seed: int, index: int, limit: float) -> Record:
    """The first answer; where it is ambiguous, the answer to it together with the log of the experiment."""
    robot = index % 6 == 5
    nth = index // 6 if robot else index - index // 6
    case: Any = (draw if robot else plain).doubtful("experiments", seed, nth)
    asked = _question(case, index)
    log, horizons = case.recording(), sit.HORIZONS if robot else [case.rig.horizon]
    # Most of them may go as far the other way as they went one way.
    limits = _limits(case, log) if index % 3 else {}
    model, found = sit.model(case.model if robot else case.rig.section), list[gc.Diagnosis]()

    def first() -> Record:
        found.append(gc.diagnose(model, log, "all", horizons=horizons, experiment={"limits": limits}))
        return sit.answer(found[0])

    record = asked | sit.timed(first, limit)
    if not found or found[0].verdict != "ambiguous" or (design := found[0].design) is None:
        return record
    second = _given(case, model, design)
    again, quiet = (t.trajectories[0] for t in _recorded(second))
    members = {(c.effect, c.site) for c in found[0].causes} | {k for group in found[0].ambiguous_with for k in group}
    record |= {"members": sorted(map(list, members))}
    fitted = log.split({"last": 0.25})[0]
    record["beyond"] = _beyond(model, fitted, limits, quiet)
    fine = model if robot else sit.model(case.rig.section | {"substeps": case.rig.sub})
    record["apart"] = _apart(fine, fitted, quiet, case.hidden[0].key, found[0])
    both = gc.Recording((*log.trajectories, replace(again, name="experiment")), hold=log.hold)
    record["designed"] = sit.timed(lambda: sit.answer(gc.diagnose(model, both, "all", horizons=horizons)), limit)
    return record


def _question(case: Any, index: int) -> Record:
    rig = case.rig
    name = rig.plant.name
    asked = {"part": case.part, "seed": case.seed, "index": index, "plant": name, "excitation": rig.excitation}
    hidden = [{"effect": h.effect, "site": h.site, "numbers": sit.plain(h.numbers)} for h in case.hidden]
    return asked | {"period": rig.period, "hidden": hidden, "strength": round(case.strength, 2)}


def _given(case: Any, model: gc.Model, design: Experiment) -> Any:
    """The hidden system under the proposed input, from the proposed start."""
    u = np.stack([design.inputs[s.name] for s in model.inputs], axis=1)
    start = {n: v for n, (v, _) in design.start.items()}
    if isinstance(case, plain.Case):
        return case.given(u, np.array([start[n] for n in case.rig.plant.states]), start[next(iter(case.rig.plant.inputs))], 10)
    names = (*case.rig.plant.positions, *case.rig.plant.velocities)
    return replace(case, rig=replace(case.rig.given(u), start=np.array([start.get(n, 0.0) for n in names])))


def _recorded(second: Any) -> tuple[gc.Recording, gc.Recording]:
    """(with noise, without)."""
    if isinstance(second, plain.Case):
        return second.recording(), replace(second, rig=replace(second.rig, noise=0 * second.rig.noise)).recording()
    silent = replace(second.noise, sigma=dict.fromkeys(second.noise.sigma, 0.0))
    return second.recording(salt=10), replace(second, noise=silent).recording(salt=10)


def _limits(case: Any, log: gc.Recording) -> dict[str, list[float]]:
    """The range of the recording and its mirror image about rest, of every channel."""
    if case.rig.plant.name in ("heater", "tank"):
        return {}
    reach = {n: float(np.abs(log.trajectories[0].channels[n]).max()) for n in log.names}
    return {n: [-r, r] for n, r in reach.items()}


def _beyond(model: gc.Model, log: gc.Recording, given: Mapping[str, Any], quiet: gc.Trajectory) -> float:
    """By how much of its range a channel leaves the limits, at most."""
    limits, over = Limits.of(model, Dataset.of(model, log), given), [0.0]
    for name, (low, high) in {**limits.outputs, **limits.inputs}.items():
        v = quiet.channels[name]
        least, most = min(low, float(v[0])), max(high, float(v[0]))
        over += [(least - v.min()) / (high - low), (v.max() - most) / (high - low)]
    return round(float(max(over)), 4)


def _apart(model: gc.Model, log: gc.Recording, quiet: gc.Trajectory, truth: Key, found: gc.Diagnosis) -> list[Record]:
    """Of every pair with the truth: what was promised, and what its rival leaves of the log without noise in a joint fit."""
    second, design = gc.Recording((replace(quiet, name="experiment"),)).split({"last": 0.25})[0], found.design
    both = gc.Recording((*log.trajectories, *second.trajectories), hold=log.hold)
    alone, out = Dataset.of(model, log), []
    measured = replace(Dataset.of(model, both), sigma=alone.sigma, spread=alone.spread)
    if design is None or design.window is None or len(found.causes) > 1:
        return []
    length = round(design.window / measured.period)
    for p in design.apart:
        if truth in (p.one, p.other) and p.separated:
            rival, promised = (p.other, p.if_one) if truth == p.one else (p.one, p.if_other)
            out.append({"rival": list(rival), "promised": promised, "found": _left(model, measured, alone, rival, length)})
    return out


def _left(model: gc.Model, both: Dataset, alone: Dataset, key: Key, length: int) -> float:
    """RMS of the experiment's residual in noise floors, with one effect fitted to both logs, from its best fit to the first."""
    library = Library(model, alone, [gc.registry().build("effect", key[0])])
    c = next(c for c in library.candidates if c.key == key)
    h, starts, windows = library.hypothesis((c,)), library.starts(c), both.windows(length)
    rows = np.tile(h.value, (len(starts), 1))
    rows[:, [h.names.index(n) for n in library.names(c)]] = starts
    # From what the first log says alone, and from what both say.
    first = [promising(h, w, rows, w.start)[0] for w in (alone.windows(length), windows)]
    again: Fit = min((fit(h, windows, theta=theta) for theta in first), key=lambda f: float(f.chi.sum()))
    of = np.array([both.source[i] == max(both.source) for i in windows.place[:, 0]])
    return float(np.sqrt(np.mean(again.residual[of] ** 2)))
