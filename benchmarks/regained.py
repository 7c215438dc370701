"""What a named cause buys: γ and the winning domain of a symbolic controller before and after a diagnosis.

The exam's generator hides a law in a system's data. The diagnosis sees only these; the certificate then compares the model, as
stated and with the causes in it, with a simulation of the hidden law at its true numbers (a tenth of the step), on the ranges
of the recorded motion. The controller must keep the system in the middle of these ranges.
"""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from exams.hidden import draw
from exams.hidden.draw import Case
from exams.sit import model
from harness import Row, main, row

import gapcert as gc

HIDDEN = (("drive", "viscous-friction"), ("pendulum", "linear-spring"), ("pendulum", "quadratic-drag"))
SEED = 7
INNER = 0.8  # share of the ranges to stay in
FINE, LEVELS = 3, 9  # cells that a state crosses in one step at most; values per input


def drawn(plant: str, effect: str) -> Case:
    """The first that is sampled at 100 Hz: a grid must be so fine that a state leaves its cell in one step."""
    names = [e for e in draw.NAMES if draw.sites(draw.PLANTS[plant], e)]
    cases = (draw.single("regained", SEED + k, names.index(effect), (plant,)) for k in itertools.count())
    return next(c for c in cases if c.rig.period == 0.01 and c.rig.hold == "zero")


def hidden(case: Case) -> dict[str, Any]:
    """The section of a model with the hidden law, at the true numbers."""
    (h,), stated = case.hidden, model(case.model)
    effect = gc.registry().build("effect", h.effect)
    extension = effect.extension(h.site, stated)
    values = [h.numbers[p.name] for p in effect.parameters]
    numbers = tuple(replace(p, value=v) for p, v in zip(extension.parameters, values, strict=True))
    section = stated.extend([replace(extension, parameters=numbers)]).to_spec()
    for (name, (_, unit)), value in zip(case.rig.plant.stated.items(), case.rig.parameters, strict=True):
        section["parameters"][name] = f"{float(value)!r} {unit}"
    return section | {"substeps": 10}


def spec(case: Case, folder: Path) -> dict[str, Any]:
    plant, motion = case.rig.plant, case.motion()
    (tr,) = case.recording(motion).trajectories
    columns = {"t": tr.t, **tr.channels}
    np.savetxt(
        folder / "log.csv", np.stack(list(columns.values()), axis=1), delimiter=",", header=",".join(columns), comments=""
    )
    names = (*plant.positions, *plant.velocities)
    ranges = {n: [float(motion.x[:, i].min()), float(motion.x[:, i].max())] for i, n in enumerate(names)}
    middle = {
        n: [INNER * low + (1 - INNER) / 2 * (low + high), INNER * high + (1 - INNER) / 2 * (low + high)]
        for n, (low, high) in ranges.items()
    }
    inputs = {n: [float(motion.u[:, i].min()), float(motion.u[:, i].max())] for i, n in enumerate(plant.inputs)}
    return {
        "version": 1,
        "name": f"{plant.name}_{case.hidden[0].effect.replace('-', '_')}",
        "model": case.model,
        "backend": hidden(case),
        "domain": ranges | inputs,
        "sampling": {"kind": "adaptive", "budget": 200},
        "gap": {"kind": "constant"},
        "certificate": {"claim": "statistical", "violation": 0.001, "confidence": 0.99},
        "controller": {
            "kind": "symbolic",
            "goal": {"invariance": middle},
            "cells": {n: cells(motion.x[:, i]) for i, n in enumerate(names)},
            "inputs": dict.fromkeys(plant.inputs, LEVELS),
        },
        "recording": {
            "kind": "csv",
            "files": [str(folder / "log.csv")],
            "time": "t",
            "columns": {n: n for n in columns if n != "t"},
            "hold": case.rig.hold,
        },
        "diagnose": {"effects": "all", "hold_out": {"last": "25 %"}, "horizons": ["0.5 s"]},
    }  # fmt: skip


def cells(x: Any) -> int:
    return math.ceil(FINE * float(np.ptp(x)) / float(np.abs(np.diff(x)).max()))


def measure(options: argparse.Namespace) -> list[Row]:
    rows = []
    for plant, effect in HIDDEN[:1] if options.quick else HIDDEN:
        case = drawn(plant, effect)
        with tempfile.TemporaryDirectory() as place:
            summary = gc.run(spec(case, Path(place)), out=Path(place)).summary
        assert summary["causes"], f"{effect} in the {plant}: {summary['verdict']}"
        again, said = summary["recertified"], ", ".join(c["effect"] for c in summary["causes"])
        name, units = f"{effect} in the {plant}, named {said}", {s.name: s.unit for s in model(case.model).states}
        for state, before in again["before"]["states"].items():
            after = again["after"]["states"][state]["gamma_mean"]
            rows.append(row(name, f"mean γ of {state}", units[state], after, before["gamma_mean"], "before"))
        won = [again[k]["controller"]["winning_cells"] / again[k]["controller"]["cells"] for k in ("after", "before")]
        rows.append(Row(name, "winning domain", "share", *won, "before", won[0] / won[1] if won[1] else None))
    return rows


if __name__ == "__main__":
    main(measure, argparse.ArgumentParser(description=__doc__))
