"""Exam of engines against engines: a setting, or a native parameter, hidden in one of two simulators; and none hidden.

Every case is drawn from (seed, part, index) alone: a robot of one to three links, the engine that is the simulation, the engine
that is the reality, and what the second has otherwise. `named`: the cause is the setting or the effect that was drawn, at its
site; `number`: within 2 % of what was drawn; `reproduced`: held-out rollouts within 1e-6 of each channel's deviation.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from exams.store import sittings
from harness import Row, main

import gapcert as gc
import gapcert_engines

KINDS = ("drag", "inertia", "step", "rk4", "substeps", "armature", "dry", "gear", "tilt", "damping")
ENGINES = ("mujoco", "pybullet", "dart")
PERIOD, TOLD, EXACT = 0.005, 0.02, 1e-6
CALM = {"linear_damping": 0.0, "angular_damping": 0.0}
PARTS = {"hidden": 80, "matched": 300}


def robot(rng: np.random.Generator, joints: int, damping: list[float], dry: list[float]) -> str:
    """A chain that swings about parallel axes, with centres of mass and axes of inertia of no particular place."""
    out, last = ['<robot name="chain"><link name="base"/>'], 0.0
    for k in range(joints):
        length, mass = rng.uniform(0.25, 0.5), rng.uniform(0.4, 1.5)
        size = mass * length**2
        xx, yy, zz = [*(rng.uniform(0.06, 0.12, 2) * size).tolist(), rng.uniform(0.01, 0.03) * size]
        zz = max(zz, abs(xx - yy) * 1.05)
        parent = "base" if k == 0 else f"link{k - 1}"
        place = "0 0 0" if k == 0 else f"0 0 {-last!r}"
        out.append(
            f'<link name="link{k}"><inertial><origin xyz="{rng.uniform(-0.02, 0.02)!r} 0.01 {-length / 2!r}"/>'
            f'<mass value="{mass!r}"/>'
            f'<inertia ixx="{xx!r}" iyy="{yy!r}" izz="{zz!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="j{k}" type="continuous"><parent link="{parent}"/><child link="link{k}"/>'
            f'<origin xyz="{place}"/><axis xyz="0 1 0"/><dynamics damping="{damping[k]!r}" friction="{dry[k]!r}"/></joint>'
        )
        last = length
    return "".join([*out, "</robot>"])


def backend(kind: str, text: str, joints: int, folder: Path, name: str, **options: Any) -> gapcert_engines.EngineBackend:
    (folder / f"{name}.urdf").write_text(text.replace("><", ">\n<"))
    ends = (("", "position"), ("_dot", "velocity"))
    section = {
        "kind": kind,
        "robot": str(folder / f"{name}.urdf"),
        "states": {f"q{k}{end}": f"j{k}.{field}" for end, field in ends for k in range(joints)},
        "inputs": {f"u{k}": f"j{k}" for k in range(joints)},
        "period": f"{PERIOD} s",
    }
    known, calm = gc.registry(), CALM if kind == "pybullet" else {}
    config: Any = known.config("backend", kind)
    built: gapcert_engines.EngineBackend = known.build(
        "backend", kind, config.model_validate(section | calm | options), gc.Context()
    )
    return built


def drawn(part: str, seed: int, index: int) -> dict[str, Any]:
    """What is hidden where."""
    rng = np.random.default_rng([seed, sorted(PARTS).index(part), index])
    kind = KINDS[index % len(KINDS)] if part == "hidden" else "none"
    joints = int(rng.integers(1, 4 if part == "matched" else 3))
    j = int(rng.integers(joints))
    reality = {"drag": "pybullet", "inertia": "pybullet", "rk4": "mujoco", "armature": "mujoco"}.get(kind)
    reality = reality or str(rng.choice(["mujoco", "dart"] if kind == "dry" else ENGINES))
    simulation = str(rng.choice(ENGINES))
    hidden: dict[str, Any] = {"effect": "engine-setting", "site": kind, "value": None}
    options: dict[str, Any] = {}
    damping, dry = [0.0] * joints, [0.0] * joints
    if kind == "drag":
        hidden["site"], options = "damping", {"linear_damping": 0.04, "angular_damping": 0.04}
    elif kind == "inertia":
        hidden["site"], options = "use_inertia_from_file", {"use_inertia_from_file": False}
    elif kind == "step":
        hidden |= {"site": "time_step", "value": 1 / 240}
    elif kind == "rk4":
        hidden["site"], options = "integrator", {"integrator": "RK4"}
    elif kind == "substeps":
        hidden["value"] = int(rng.choice([2, 3, 4, 5, 8, 10]))
        options = {"substeps": hidden["value"]}
    elif kind == "armature":
        value = rng.uniform(0.005, 0.05)
        hidden, options = {"effect": "parameter", "site": "armature_j0", "value": value}, {"armature": value}
    elif kind == "dry":
        dry[j] = rng.uniform(0.03, 0.3)
        hidden = {"effect": "coulomb-friction", "site": f"q{j}", "value": dry[j]}
    elif kind == "gear":
        hidden = {"effect": "input-gain", "site": f"u{j}", "value": float(rng.choice([0.8, 0.9, 1.1, 1.25]))}
    elif kind == "tilt":
        angle = float(rng.choice([-1, 1]) * rng.uniform(0.02, 0.1))
        hidden = {"effect": "gravity-tilt", "site": "q0", "value": angle}
        options = {"gravity": (-9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))}
    elif kind == "damping":
        damping[j] = rng.uniform(0.02, 0.2)
        hidden = {"effect": "viscous-friction", "site": f"q{j}", "value": damping[j]}
    case = {"part": part, "seed": seed, "index": index, "kind": kind, "joints": joints, "hidden": hidden}
    return case | {"simulation": simulation, "reality": reality, "options": options, "damping": damping, "dry": dry}


def played(case: dict[str, Any], folder: Path) -> tuple[gapcert_engines.EngineModel, gc.Recording]:
    seeds = [case["seed"], 7, case["index"]]
    n, shape = case["joints"], np.random.default_rng([*seeds, 1]).integers(2**32)
    calm, real = (
        robot(np.random.default_rng(int(shape)), n, *rubs) for rubs in (([0.0] * n, [0.0] * n), (case["damping"], case["dry"]))
    )
    model = gapcert_engines.EngineModel(backend(case["simulation"], calm, n, folder, "simulation"))
    system = backend(
        case["reality"],
        real,
        n,
        folder,
        "reality",
        **case["options"] | ({"period": f"{1 / 240} s"} if case["kind"] == "step" else {}),
    )
    # Bullet clamps speeds at 100 rad/s, which is no setting of ours: arms swing, they do not whirl.
    ranges = {f"u{k}": (-0.6 * 0.4**k, 0.6 * 0.4**k) for k in range(n)} | {f"q{k}": (-0.5, 0.5) for k in range(n)}
    log = gc.play(system, ranges, seconds=5.0, trajectories=4, seed=int(np.random.default_rng(seeds).integers(2**31)))
    hidden = case["hidden"]
    if case["kind"] == "gear":
        # The reality's actuator makes `value` of what the log says was commanded.
        log = restamped(log, lambda t, n, v: v / hidden["value"] if n == hidden["site"] else v, 1.0)
    if case["kind"] == "step":
        log = restamped(log, lambda t, n, v: v, PERIOD * 240)
    return model, log


def restamped(log: gc.Recording, change: Any, pace: float) -> gc.Recording:
    trajectories = tuple(
        replace(t, t=t.t * pace, channels={n: change(t, n, v) for n, v in t.channels.items()}) for t in log.trajectories
    )
    return replace(log, trajectories=trajectories)


def sit(task: tuple[str, int, int]) -> dict[str, Any]:
    case, start = drawn(*task), time.process_time()
    with tempfile.TemporaryDirectory() as folder, Quiet():
        try:
            model, log = played(case, Path(folder))
            found = gc.diagnose(model, log, horizons=[0.5])
        except gc.UsageError as error:
            return case | {"error": str(error)[:300], "cpu": round(time.process_time() - start, 1)}
    spread = {n: float(np.std(np.concatenate([t.channels[n] for t in log.trajectories]))) for n in found.gain["0.5"]}
    after = max(g.after / spread[n] for n, g in found.gain["0.5"].items())
    before = max(g.before / spread[n] for n, g in found.gain["0.5"].items())
    causes = [
        {
            "effect": c.effect,
            "site": c.site,
            "native": c.native,
            "setting": c.setting,
            "numbers": {n: p.value for n, p in c.parameters.items()},
        }
        for c in found.causes
    ]
    ties = [[list(k) for k in t] for t in found.ambiguous_with]
    record = {"verdict": found.verdict, "causes": causes, "ties": ties, "before": before, "after": after}
    return case | record | judged(case, record) | {"cpu": round(time.process_time() - start, 1)}


class Quiet:
    """Without what native loaders print about a base without mass."""

    def __enter__(self) -> None:
        self.saved, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, 2)
        os.close(sink)

    def __exit__(self, *_: object) -> None:
        os.dup2(self.saved, 2)
        os.close(self.saved)


def judged(case: dict[str, Any], record: dict[str, Any]) -> dict[str, Any]:
    hidden, causes = case["hidden"], record["causes"]
    if case["kind"] == "none":
        return {"silent": not causes and record["verdict"] == "nothing"}
    ours = [c for c in causes if (c["effect"], c["site"]) == (hidden["effect"], hidden["site"])]
    extra = [c for c in causes if c not in ours and not (case["kind"] == "armature" and c["site"].startswith("armature"))]
    # How another engine solves friction is a setting that differs as well.
    solved = {"dry": "dry_friction", "damping": "implicit_damping"}.get(case["kind"])
    extra = [c for c in extra if c["site"] != solved]
    number = None
    if ours and isinstance(hidden["value"], int | float):
        known = [*ours[0]["numbers"].values()]
        number = bool(known) and abs(known[0] - hidden["value"]) <= TOLD * abs(hidden["value"])
    if not ours and [[hidden["effect"], hidden["site"]]] in record["ties"]:
        # One of a class: one joint's torque and its mass, say, are a matter of scale.
        return {"named": not extra[1:], "number": number, "reproduced": record["after"] <= EXACT}
    return {"named": bool(ours) and not extra, "number": number, "reproduced": record["after"] <= EXACT}


def measure(options: argparse.Namespace) -> list[Row]:
    rows = []
    for part in options.part or PARTS:
        count = options.cases or (20 if options.quick else PARTS[part])
        records = list(sittings(sit, [(part, options.seed, i) for i in range(count)], options.jobs, options.store))
        case = f"{part}, {len(records)} pairs"
        answered = [r for r in records if "error" not in r]
        if part == "matched":
            rows.append(Row(case, "silent", "1", sum(r["silent"] for r in answered) / len(records), 0.99, "goal", None))
        else:
            right = sum(r["named"] and (r["number"] is not False or r["reproduced"]) for r in answered)
            rows.append(Row(case, "named, and the number or the motion right", "1", right / len(records), 0.95, "goal", None))
            rows.append(
                Row(case, "motion reproduced", "1", sum(r["reproduced"] for r in answered) / len(records), None, "", None)
            )
        rows.append(Row(case, "time", "CPU s", float(np.median([r["cpu"] for r in records])), None, "median", None))
        for r in records if options.verbose else ():
            if "error" in r or not r.get("silent", r.get("named")) or r.get("number") is False:
                print(
                    json.dumps(
                        {
                            k: r.get(k)
                            for k in (
                                "index",
                                "kind",
                                "simulation",
                                "reality",
                                "joints",
                                "hidden",
                                "verdict",
                                "causes",
                                "after",
                                "error",
                            )
                        }
                    )
                )
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", action="append", choices=list(PARTS), help="one part of the exam; may be repeated")
    parser.add_argument("--cases", type=int, help="cases of each part, instead of its own number")
    parser.add_argument("--seed", type=int, default=1, help="another seed is another exam")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--store", type=Path, help="JSON lines of the answers; a run goes on where this file ends")
    parser.add_argument("--verbose", action="store_true", help="print every miss")
    main(measure, parser)
