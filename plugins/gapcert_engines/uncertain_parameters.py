"""Native parameters of an engine as numbers of the equations that stand for it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from gapcert.plugin import Extension, Model, Parameter, site_units
from gapcert_engines.thresholds import THRESHOLDS

from .backend import EngineBackend
from .contract import Engine

DAMPING = "implicit_damping"
"""Of a model, instead of the engine's: whether damping that a diagnosis finds is solved with the step."""
DOUBTED = ("mass", "armature")
"""Native parameters that may be wrong though no tolerance is stated; of gravity, the components that are not zero."""


def known(backend: EngineBackend) -> dict[str, Parameter]:
    """The engine's native parameters, and inertia of joints that it has none of: only the equations know that."""
    out = {p.name: p for p in backend.parameters}
    for joint, _ in backend.moved():
        none = Engine.joint_parameter("armature", joint, 0.0)
        out.setdefault(none.name, none)
    return out


def plain_name(p: Parameter) -> str:
    return re.sub(r"\W", "_", p.name)


def doubted(p: Parameter) -> bool:
    what = p.name.partition(".")[0]
    return what in DOUBTED or (what.startswith("gravity_") and p.value != 0)


def scales(model: Model, parameters: Sequence[Parameter], coordinates: Mapping[str, str]) -> dict[str, float]:
    """What change of a native parameter matters: its value, or the inertia that its joint feels where that is zero."""
    out = {}
    for p in parameters:
        what, _, joint = p.name.partition(".")
        out[plain_name(p)] = abs(p.value) or (felt(model, coordinates[joint]) if what == "armature" else 1.0)
    return out


def felt(model: Model, q: str) -> float:
    """M⁻¹ of a coordinate at rest in zero, inverted."""
    push = Parameter("probe_force", 0.0, site_units(model, "coordinate", q)["force"])
    pushed = model.extend([Extension("probe", q, (push,), force=push.name)])
    x, u = np.zeros((1, model.nx)), np.zeros((1, model.nu))
    column = [s.name for s in model.states].index(f"{q}_dot")
    # Far more than dry friction holds.
    on, off = (
        pushed.step(x, u, parameters={push.name: np.array([f])}).x[0, column]
        for f in (2 * THRESHOLDS.strong_push, THRESHOLDS.strong_push)
    )
    return float(model.period * THRESHOLDS.strong_push / abs(on - off))
