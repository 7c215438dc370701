"""From a spec's names to a robot's joints: axes, columns, units, parameters and the time step."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert import Parameter, StateSpec, System, UsageError, magnitude
from gapcert_pybullet.config import PyBulletConfig, seconds
from gapcert_pybullet.world import Joint

FIELDS = ("position", "velocity")
UNITS = {"revolute": ("rad", "rad/s", "N*m"), "prismatic": ("m", "m/s", "N")}
"""Units of position, velocity and effort."""

Index = npt.NDArray[np.intp]


@final
@dataclass(frozen=True)
class Wiring:
    """Which joint number each state, input and hidden state is: (2, ·) rows of joint and field, (nu,) joints."""

    states: tuple[StateSpec, ...]
    inputs: tuple[StateSpec, ...]
    hidden: tuple[StateSpec, ...]
    coordinates: tuple[str, ...]
    seen: Index
    unseen: Index
    driven: Index


def wire(config: PyBulletConfig, file: str, joints: Sequence[Joint], model: System | None) -> Wiring:
    """The names of the spec looked up among the robot's joints and the model's axes."""
    movable = [j for j in joints if j.movable]
    states = {
        name: (_find(f"states.{name}", target.rpartition(".")[0], file, joints), FIELDS.index(target.rpartition(".")[2]))
        for name, target in config.states.items()
    }
    inputs = {name: _find(f"inputs.{name}", target, file, joints) for name, target in config.inputs.items()}
    if model is None:
        x_axes = tuple(_axis(name, joint, field) for name, (joint, field) in states.items())
        u_axes = tuple(StateSpec(name, UNITS[joint.type][2]) for name, joint in inputs.items())
    else:
        x_axes, u_axes = _matched("states", model.states, states), _matched("inputs", model.inputs, inputs)
    for s in x_axes:
        joint, field = states[s.name]
        _check_unit(f"states.{s.name}", s, UNITS[joint.type][field], f"the {FIELDS[field]} of joint '{joint.name}'")
    for s in u_axes:
        _check_unit(f"inputs.{s.name}", s, UNITS[inputs[s.name].type][2], f"the effort of joint '{inputs[s.name].name}'")
    seen = [(movable.index(joint), field) for joint, field in (states[s.name] for s in x_axes)]
    unseen = [(k, field) for k in range(len(movable)) for field in (0, 1) if (k, field) not in seen]
    position = {joint.name: name for name, (joint, field) in states.items() if field == 0}
    return Wiring(
        x_axes,
        u_axes,
        tuple(_axis(f"{movable[k].name}.{FIELDS[field]}", movable[k], field) for k, field in unseen),
        tuple(position.get(j.name, j.name) for j in movable),
        np.array(seen, dtype=np.intp).reshape(-1, 2).T,
        np.array(unseen, dtype=np.intp).reshape(-1, 2).T,
        np.array([movable.index(inputs[s.name]) for s in u_axes], dtype=np.intp),
    )


def _find(where: str, name: str, file: str, joints: Sequence[Joint]) -> Joint:
    known = {j.name: j for j in joints}
    if name not in known:
        raise UsageError(f"backend.{where}: {file} has no joint '{name}'; {_hint(name, known)}")
    if not (joint := known[name]).movable:
        raise UsageError(f"backend.{where}: joint '{name}' of {file} is {joint.type}; expected one that turns or slides")
    return joint


def _hint(name: str, known: Collection[str]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    return f"did you mean '{near[0]}'?" if near else f"it has {', '.join(known) or 'none'}"


def _axis(name: str, joint: Joint, field: int) -> StateSpec:
    angle = joint.type == "revolute" and field == 0 and not joint.limited
    return StateSpec(name, UNITS[joint.type][field], "angle" if angle else "real")


def _matched(section: str, specs: Sequence[StateSpec], given: Mapping[str, object]) -> tuple[StateSpec, ...]:
    """The model's axes, which the spec must map exactly."""
    names = [s.name for s in specs]
    if extra := [n for n in given if n not in names]:
        raise UsageError(f"backend.{section}: the model has no '{extra[0]}'; {_hint(extra[0], names)}")
    if missing := [n for n in names if n not in given]:
        what = "JOINT.position or JOINT.velocity" if section == "states" else "JOINT"
        raise UsageError(f"backend.{section}: '{missing[0]}' of the model is missing; add {missing[0]}: {what}")
    return tuple(specs)


def _check_unit(where: str, spec: StateSpec, unit: str, what: str) -> None:
    """Refuses a model's unit that is not the engine's."""
    try:
        factor = magnitude(f"1 {spec.unit}", unit)
    except ValueError:
        factor = None
    if factor is None or abs(factor - 1) > 1e-12 or spec.kind == "quaternion":
        raise UsageError(
            f"backend.{where}: the model gives it in {spec.unit}, but {what} is in {unit}; use {unit} in the model"
        )


def native_parameters(config: PyBulletConfig, joints: Sequence[Joint]) -> tuple[Parameter, ...]:
    """What PyBullet can change at run time: damping and gravity."""

    def joint(j: Joint) -> Parameter:
        value = j.damping if config.joint_damping is None else config.joint_damping
        return Parameter(f"damping.{j.name}", value, "N*m*s/rad" if j.type == "revolute" else "N*s/m", low=0.0)

    return (
        Parameter("linear_damping", config.linear_damping, "1/s", low=0.0),
        Parameter("angular_damping", config.angular_damping, "1/s", low=0.0),
        *(Parameter(f"gravity_{a}", g, "m/s^2") for a, g in zip("xyz", config.gravity, strict=True)),
        *(joint(j) for j in joints if j.movable),
    )


def step_period(config: PyBulletConfig, model: System | None) -> float:
    """Seconds per step: the spec's, else the model's."""
    if config.period is not None:
        return seconds(config.period)
    if model is None:
        raise UsageError("backend.period: there is no model to take it from; add for instance period: 5 ms")
    return model.period


def fuses(period: float, substeps: int) -> bool:
    """Whether Bullet's own sub-stepping takes exactly `substeps` steps, every time.

    It adds up time and takes int(time / step) steps; only a remainder of exactly zero leaves nothing for the next query.
    """
    step = period / substeps
    return substeps > 1 and int(period / step) == substeps and period - substeps * step == 0


BASE = (
    *(StateSpec(f"base.{a}", "m") for a in "xyz"),
    StateSpec("base.rotation", "1", "quaternion"),
    *(StateSpec(f"base.v{a}", "m/s") for a in "xyz"),
    *(StateSpec(f"base.w{a}", "rad/s") for a in "xyz"),
)
"""Hidden state of a base that floats: its centre of mass, as World.base orders it."""
