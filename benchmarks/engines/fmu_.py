"""An FMU of our own against a loop over fmpy's calls; it is compiled here."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from harness import Row, alternate, row

import gapcert
from engines.case import MODELS, Array

PERIOD = 0.005
PEER = "bare Python loop over fmpy: reset, setReal, doStep, getReal"


def rows(quick: bool) -> list[Row]:
    """Co-simulation, both versions of FMI, and model exchange with one step of Runge–Kutta."""
    if shutil.which("cc") is None:
        return []
    found, n, repeats = list[Row](), 1000 if quick else 5000, 5 if quick else 9
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-0.25, 0.25, (n, 2)), rng.uniform(-1, 1, (n, 1))
    with tempfile.TemporaryDirectory() as folder:
        files = {fmi: _build(Path(folder) / f"pendulum{fmi}.fmu", fmi) for fmi in (2, 3)}
        theirs = _Loop(files[2])
        for fmi, interface in ((2, "co-simulation"), (3, "co-simulation"), (3, "model-exchange")):
            ours = _backend(files[fmi], interface)
            if interface == "co-simulation" and ours.step(x, u).x.tobytes() != theirs.step(x, u).tobytes():
                raise SystemExit(f"throughput: an FMU of version {fmi} differs from fmpy's loop")
            seconds = alternate(lambda b=ours: b.step(x, u), lambda: theirs.step(x, u), repeats=repeats)
            case = f"fmu pendulum, FMI {fmi}.0, {interface}"
            found.append(row(case, "time", "us per transition", *(1e6 * s / n for s in seconds), PEER))
    return found


def _build(path: Path, fmi: int) -> Path:
    spec = importlib.util.spec_from_file_location("fmu_build", MODELS / "fmu/build.py")
    assert spec is not None
    assert spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    made: Path = module.build("pendulum", path, fmi)
    return made


def _backend(file: Path, interface: str) -> gapcert.Backend:
    registry = gapcert.registry()
    config = registry.config("backend", "fmu")
    assert config is not None, "it has options"
    names = {"states": {"theta": "theta", "omega": "omega"}, "inputs": {"torque": "torque"}}
    section = config(file=file, interface=interface, period=f"{PERIOD} s", **names)
    backend: gapcert.Backend = registry.build("backend", "fmu", section, gapcert.Context(allow_code=True))
    return backend


class _Loop:
    """What a user of fmpy would write."""

    def __init__(self, file: Path) -> None:
        described = fmpy.read_model_description(str(file))
        self.fmu = FMU2Slave(guid=described.guid, modelIdentifier="pendulum", unzipDirectory=fmpy.extract(str(file)))
        self.fmu.instantiate()
        reference = {v.name: v.valueReference for v in described.modelVariables}
        self.set = [reference[n] for n in ("theta", "omega", "torque")]

    def step(self, x: Array, u: Array) -> Array:
        fmu, out = self.fmu, np.empty_like(x)
        for k in range(len(x)):
            fmu.reset()
            fmu.setupExperiment(startTime=0.0)
            fmu.enterInitializationMode()
            fmu.setReal(self.set, [*x[k], *u[k]])
            fmu.exitInitializationMode()
            fmu.doStep(0.0, PERIOD)
            out[k] = fmu.getReal(self.set[:2])
        return out
