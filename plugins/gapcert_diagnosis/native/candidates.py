"""What may be blamed of a physics engine: its native parameters and settings, each as the effect that it realises."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert.plugin import Parameter
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_engines import NativeModel

SCALES = {"m/s^2": 2.0, "m": 0.02, "1/s": 1.0, "s": 0.02}
_CONTACT = {"friction": ("contact-friction", "mu", "ground"), "ground": ("contact-friction", "mu", "ground"),
            "spinning_friction": ("contact-friction", "coefficient", "spinning"),
            "rolling_friction": ("contact-friction", "coefficient", "rolling"),
            "restitution": ("contact-restitution", "coefficient", "ground"),
            "contact_time": ("contact-restitution", "time_constant", "ground"),
            "contact_damping": ("contact-restitution", "damping_ratio", "ground"),
            "linear_damping": ("viscous-friction", "coefficient", "base"),
            "angular_damping": ("viscous-friction", "coefficient", "base rotation")}  # fmt: skip
CONTACT = frozenset(n for n, (effect, _, _) in _CONTACT.items() if effect.startswith("contact-"))
"""Numbers that change nothing while nothing is touched."""
_SHAPE = ("com_", "inertia.")
"""Of a body: exact, where no tolerance says that they may be wrong."""
_JOINT = {"damping": "viscous-friction", "frictionloss": "coulomb-friction", "coulomb_friction": "coulomb-friction"}


@final
@dataclass(frozen=True)
class NativeCandidate:
    """A native parameter, or an option of the engine with one other value, as an effect at a site.

    number: what its parameter is called; factor: of its value over the native one; values: native ones that a screening tries.
    """

    effect: str
    site: str
    native: str
    number: str = "value"
    parameter: Parameter | None = None
    factor: float = 1.0
    option: Mapping[str, Any] | None = None
    values: tuple[float, ...] = ()
    setting: Mapping[str, Any] | None = None

    @property
    def key(self) -> tuple[str, str]:
        return self.effect, self.site

    @property
    def label(self) -> str:
        """What it is called, with the value of an option."""
        return self.native if self.setting is None else f"{self.native} = {self.setting['value']}"

    @property
    def logarithmic(self) -> bool:
        return self.parameter is not None and self.parameter.low >= 0 and self.parameter.value > 0

    def to(self, value: float) -> float:
        """The coordinate in which it is searched: ln(value / stated), or the value in its scale."""
        assert self.parameter is not None
        if self.logarithmic:
            return math.log(max(value, 1e-12 * self.parameter.value) / self.parameter.value)
        return value / _scale(self.parameter)

    def back(self, z: float) -> float:
        """Inverse of `to`, within bounds."""
        assert self.parameter is not None
        value = self.parameter.value * math.exp(z) if self.logarithmic else z * _scale(self.parameter)
        return float(np.clip(value, self.parameter.low, self.parameter.high))

    @property
    def bounds(self) -> tuple[float, float]:
        """(low, high) of that coordinate."""
        assert self.parameter is not None
        p = self.parameter
        return math.log(max(p.low / p.value, 1e-4)) if self.logarithmic else self.to(p.low), self.to(p.high)


def native_candidates(model: NativeModel, effects: Collection[str], *, simulated: bool) -> tuple[NativeCandidate, ...]:
    """All native parameters that realise one of these effects, and the settings of the engine that are no parameters.

    simulated: the data are another simulator's, whose gravity may differ; that of the earth is known.
    """
    stated = {p.name: p.value for p in model.parameters}
    down = max("xyz", key=lambda a: abs(stated.get(f"gravity_{a}", 0.0)))
    known = () if simulated else (f"gravity_{down}",)
    doubted = [p for p in model.parameters if p.tolerance > 0 or not (p.name in known or p.name.startswith(_SHAPE))]
    out = [n for p in doubted if (n := _candidate(model, p, down)).effect in effects]
    return (*out, *_settings(model))


def _candidate(model: NativeModel, p: Parameter, down: str) -> NativeCandidate:
    values = tried(p)
    kind, _, element = p.name.partition(".")
    if p.name in _CONTACT:
        effect, number, site = _CONTACT[p.name]
        # The smaller of robot's and ground's friction counts where an engine has both, else their product.
        both = any(q.name == "ground" for q in model.parameters)
        times = 1.0 if p.name != "friction" or both or model.of.ground is None else model.of.ground
        return NativeCandidate(effect, site, p.name, number, p, times, None, values)
    if kind in _JOINT and element:
        return NativeCandidate(_JOINT[kind], element, p.name, "coefficient", p, values=values)
    if kind == "gear":
        site = next(u.name for u in model.inputs if model.backend.realises("input-gain", u.name) == p.name)
        return NativeCandidate("input-gain", site, p.name, "gain", p, 1 / p.value, values=values)
    if p.name.startswith("gravity_") and not p.name.endswith(down):
        return NativeCandidate("gravity-tilt", p.name[-1], p.name, "acceleration", p, values=values)
    return NativeCandidate("parameter", p.name, p.name, "value", p, values=values)


def _settings(model: NativeModel) -> list[NativeCandidate]:
    """Options with other values; those that are native parameters stand above."""
    natives = {p.name.partition(".")[0] for p in model.parameters}
    joints = {"joint_damping", "frictionloss", "armature", "coulomb_friction", "joint_limits", "euler_damping", "damping"}
    out = []
    for name, values in model.of.settings().items():
        for value in values if name not in natives | joints else ():
            option = dict(value) if isinstance(value, Mapping) else {name: value}
            setting = {"value": value, "was": getattr(model.of, name, None)}
            out.append(NativeCandidate("engine-setting", name, name, option=option, setting=setting))
    return out


def tried(p: Parameter) -> tuple[float, ...]:
    if p.low >= 0 and p.value > 0:
        found = [p.value * f for f in THRESHOLDS.engine_factors]
    else:
        near = [s * _scale(p) for s in THRESHOLDS.engine_shares]
        found = [p.value + d for d in near] + ([p.value - d for d in near] if p.low < p.value else [])
    return tuple(sorted(v for v in found if p.low <= v <= p.high))


def _scale(p: Parameter) -> float:
    return abs(p.value) * 0.2 if p.value else SCALES.get(p.unit, 1.0)
