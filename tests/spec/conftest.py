"""Toy plugins: declarations and option models, as light as real ones."""

from pathlib import Path
from typing import Literal

import pluggy
import pytest
from pydantic import BaseModel, ConfigDict, Field

import gapcert
from gapcert import Component, UsageError
from gapcert.contracts.plugins.registry import Registry
from gapcert.plugin import Keyed


class Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class State(Options):
    unit: str = "1"
    kind: Literal["real", "angle"] = "real"


class ToyModel(Options):
    kind: Literal["equations"]
    states: dict[str, str | State]
    inputs: dict[str, str] = {}
    derivative: dict[str, str]
    integrator: Literal["euler", "rk4"] = "euler"
    period: str = "5 ms"

    def check(self):
        for name, text in self.derivative.items():
            if (at := text.find("foo")) >= 0:
                yield ("derivative", name), "unknown name 'foo'", at


class ToyBackend(Options):
    kind: Literal["pybullet"]
    robot: Path
    fixed_base: bool
    states: dict[str, str]
    inputs: dict[str, str] = {}
    substeps: int = Field(default=1, ge=1)


class Loose(BaseModel):
    """Forgets to forbid unknown keys; the core must notice them."""

    kind: Literal["loose"]
    rate: float = 1.0


class Declared(Options):
    kind: Literal["declared"]
    value: float = Field(gt=0)


class WoodZhang(Options):
    kind: Literal["wood-zhang"]
    safety: float = Field(default=1.2, ge=1)


class FromModel(Options):
    model: Path


class Envelope(Options):
    kind: Literal["envelope"]
    predictor: Literal["none", "affine"] | FromModel = "none"


class Symbolic(Options):
    kind: Literal["symbolic"]
    cells: dict[str, int]
    inputs: dict[str, int] = {}

    def keyed(self):
        return Keyed("cells", "states"), Keyed("inputs", "inputs")


class Csv(Options):
    kind: Literal["csv"]
    files: list[str] = Field(min_length=1)
    time: str = "t"
    columns: dict[str, str] = {}

    def paths(self):
        return [(("files", i), Path(file)) for i, file in enumerate(self.files)]


class ToyFamily:
    """Built from a spec; shows what it was given."""

    @classmethod
    def from_config(cls, config, context):
        made = cls()
        made.config, made.context = config, context
        return made


class Picky(Options):
    kind: Literal["picky"]

    def check(self):
        raise UsageError("picky: never satisfied; use another")


@pytest.fixture(scope="session")
def toys():
    def one(kind, name, config, **more):
        return Component(kind, name, f"toy {name}", f"{__name__}:ToyFamily", f"{__name__}:{config}" if config else "", **more)

    declared = [
        one("model", "equations", "ToyModel"),
        one("model", "picky", "Picky"),
        one("model", "broken", "NoSuchClass"),
        one("backend", "pybullet", "ToyBackend"),
        one("gap_family", "loose", "Loose"),
        one("backend", "absent", "", requires=("no_such_engine",), extra="absent"),
        one("lipschitz", "declared", "Declared"),
        one("lipschitz", "wood-zhang", "WoodZhang", claim="statistical"),
        one("gap_family", "envelope", "Envelope"),
        one("gap_family", "constant", ""),
        one("gap_family", "coded", "", code=True),
        one("synthesizer", "symbolic", "Symbolic"),
        one("reader", "csv", "Csv"),
        one("effect", "viscous-friction", ""),
        one("effect", "coulomb-friction", ""),
        one("executor", "processes", ""),
        one("executor", "far", "", requires=("no_such_engine",)),
    ]
    sections = [c for c in gapcert.registry().components.values() if c.kind in ("study", "section")]
    return Registry([*declared, *sections], [], pluggy.PluginManager("gapcert"))


PENDULUM = """\
version: 1
name: pendulum
model:
  kind: equations
  states: {theta: {unit: rad, kind: angle}, omega: rad/s}
  inputs: {torque: N*m}
  derivative: {theta: omega, omega: -3*9.81/2*sin(theta) + 3*torque}
backend: {kind: pybullet, robot: rod.urdf, fixed_base: true, states: {theta: hinge.position, omega: hinge.velocity}}
domain: {theta: [-0.2, 0.2], omega: [-0.25, 0.25], torque: [-1, 1]}
sampling: {kind: adaptive, budget: 300}
lipschitz: {residual: {kind: wood-zhang, safety: 1.2}}
gap: {kind: envelope, predictor: affine}
certificate: {claim: statistical, violation: 1e-3, confidence: 0.999999}
controller: {kind: symbolic, goal: {invariance: {theta: [0, 0.2], omega: [-0.25, 0.25]}}, cells: {theta: 200, omega: 200}}
closed_loop: {steps: 600, starts: 100}
expect: {verdict: holds, "certificate.states.*.tightness <=": 1.02}
"""

DRIVE = """\
version: 1
name: drive
model:
  kind: equations
  states: {q: m}
  inputs: {F: N}
  derivative: {q: F}
recording: {kind: csv, files: [a.csv], time: t, columns: {q: q, F: F}}
diagnose: {effects: all, hold_out: {last: 33 %}, horizons: [0.5 s, 7 s]}
expect: {verdict: causes}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the files that the specs name, as working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rod.urdf").write_text("<robot/>")
    (tmp_path / "a.csv").write_text("t,q,F\n")
    (tmp_path / "pendulum.yaml").write_text(PENDULUM)
    (tmp_path / "drive.yaml").write_text(DRIVE)
    return tmp_path


@pytest.fixture
def pendulum():
    return PENDULUM


@pytest.fixture
def drive():
    return DRIVE
