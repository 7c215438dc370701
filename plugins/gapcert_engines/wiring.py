"""From a spec's names to the numbers of a robot: axes, columns, units and the time step."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Parameter, StateSpec, System, UsageError, magnitude

from .config import FEEDBACK, EngineConfig, seconds
from .contract import BASE, BASE_EULER, Actuator, Drive, Engine, Joint, Motor

FIELDS = ("position", "velocity")
CONTROL = ".ctrl"
"""Of an input that is an actuator's control, ACTUATOR.ctrl."""
EFFORT = ".effort"
"""Of an input that is an effort at a joint which the file drives otherwise, JOINT.effort."""
UNITS = {"revolute": ("rad", "rad/s", "N*m"), "prismatic": ("m", "m/s", "N")}
"""Units of position, velocity and effort."""

Index = npt.NDArray[np.intp]


@final
@dataclass(frozen=True)
class Lever:
    """The motor at an input: its control where the input is `control`, else the effort that the file's gear makes of it."""

    motor: Motor
    control: bool

    @property
    def native(self) -> str:
        return f"gear.{self.motor.name}"

    def factor(self, gear: Array | float) -> Array | float:
        """Of the input, with this gear."""
        return gear if self.control else gear / self.motor.gear


@final
@dataclass(frozen=True)
class Wiring:
    """Columns of the full state (positions and velocities of the movable joints in turn, then the base) that each state and
    hidden state is; column of the effort and motor of each input, −1 and None where it goes to the drive or there is none."""

    states: tuple[StateSpec, ...]
    inputs: tuple[StateSpec, ...]
    hidden: tuple[StateSpec, ...]
    hidden_default: tuple[float, ...]
    coordinates: tuple[str, ...]
    seen: Index
    unseen: Index
    driven: Index
    levers: tuple[Lever | None, ...]
    drive: Drive | None

    @functools.cached_property
    def straight(self) -> bool:
        """Is x the full state as it stands?"""
        return not len(self.unseen) and bool((self.seen == np.arange(len(self.seen))).all())

    @property
    def commanded(self) -> Index:
        """Columns of u that go to the drive."""
        return np.flatnonzero(self.driven < 0)


def wire(engine: Engine, model: System | None) -> Wiring:
    """The names of the spec looked up among the robot's joints, its base and the model's axes."""
    config = engine.config
    movable = [j for j in engine.joints if j.movable]
    columns = _columns(engine, movable)
    states = {name: _column(name, target, engine, columns) for name, target in config.states.items()}
    targets = {name: _target(f"inputs.{name}", t, engine) for name, t in config.inputs.items()}
    levers = {name: _lever(f"inputs.{name}", t, engine) for name, t in targets.items()}
    joint = {name: t if (lever := levers[name]) is None else lever.motor.joint for name, t in targets.items()}
    inputs = {name: None if t == "drive" else _driven(f"inputs.{name}", t, engine) for name, t in joint.items()}
    if twice := [n for n, t in joint.items() if t != "drive" and list(joint.values()).count(t) > 1]:
        raise UsageError(
            f"backend.inputs: {' and '.join(twice)} both drive joint '{joint[twice[0]]}'; expected one input per joint"
        )
    x_axes, u_axes = _axes(config, model, states, inputs, columns)
    names = list(columns)
    seen = [names.index(states[s.name]) for s in x_axes]
    starts = np.cumsum([0, *(c.size for c in columns.values())])
    unseen = [k for k in range(len(names)) if k not in seen]
    rest = np.array([(j.rest, 0.0) for j in movable]).ravel()
    default = np.concatenate([rest, to_columns(np.asarray(engine.loose)[None], config)[0]])
    spread = [c for k in unseen for c in range(starts[k], starts[k + 1])]
    pushed = [*movable, *engine.actuators]
    position = {target.rpartition(".")[0]: name for name, target in config.states.items() if target.endswith(".position")}
    return Wiring(
        x_axes,
        u_axes,
        tuple(columns[names[k]] for k in unseen),
        tuple(default[spread].tolist()),
        tuple(position.get(j.name, j.name) for j in movable),
        np.array([starts[k] for k in seen], dtype=np.intp),
        np.array(spread, dtype=np.intp),
        np.array([-1 if (at := inputs[s.name]) is None else pushed.index(at) for s in u_axes], dtype=np.intp),
        tuple(levers[s.name] for s in u_axes),
        _drive(engine, [s.name for s in u_axes if inputs[s.name] is None]),
    )


def _columns(engine: Engine, movable: Sequence[Joint]) -> dict[str, StateSpec]:
    """Every number of the robot's state by name, in the order of the full state."""
    specs = [_axis(f"{j.name}.{FIELDS[k]}", j, k) for j in movable for k in (0, 1)]
    if engine.base:
        specs += BASE_EULER if engine.config.rotation == "euler" else BASE
    specs += engine.beside
    return {s.name: s for s in specs}


def _column(name: str, target: str, engine: Engine, columns: Mapping[str, StateSpec]) -> str:
    owner, _, _ = target.rpartition(".")
    if owner in {s.name.rpartition(".")[0] for s in engine.beside}:
        known = [c for c in columns if c.startswith(f"{owner}.") and columns[c].kind != "quaternion"]
        if target not in known:
            raise UsageError(f"backend.states.{name}: found '{target}'; expected one of {', '.join(known)}")
    elif owner != "base":
        _find(f"states.{name}", owner, engine)
        if target not in columns:
            raise UsageError(f"backend.states.{name}: found '{target}'; expected {owner}.position or {owner}.velocity")
    elif not engine.base:
        raise UsageError(f"backend.states.{name}: the base is fixed, and '{target}' is its own; set fixed_base: false")
    elif target not in columns or columns[target].kind == "quaternion":
        known = [c.removeprefix("base.") for c in columns if c.startswith("base.") and columns[c].kind != "quaternion"]
        more = "" if engine.config.rotation == "euler" else "; roll, pitch and yaw need rotation: euler"
        raise UsageError(f"backend.states.{name}: found '{target}'; expected base.FIELD with one of {', '.join(known)}{more}")
    return target


def _axes(
    config: EngineConfig,
    model: System | None,
    states: Mapping[str, str],
    inputs: Mapping[str, Joint | Actuator | None],
    columns: Mapping[str, StateSpec],
) -> tuple[tuple[StateSpec, ...], tuple[StateSpec, ...]]:
    """The axes of x and u: the model's, whose units must be the engine's, or the engine's own."""
    effort = {name: None if j is None else _unit(j) for name, j in inputs.items()}
    if model is None:
        x_axes = tuple(StateSpec(name, columns[c].unit, columns[c].kind) for name, c in states.items())
        return x_axes, tuple(StateSpec(name, unit or "1") for name, unit in effort.items())
    x_axes, u_axes = _matched("states", model.states, states), _matched("inputs", model.inputs, inputs)
    for s in x_axes:
        _check_unit(f"states.{s.name}", s, columns[states[s.name]].unit, states[s.name])
    for s in u_axes:
        if (unit := effort[s.name]) is not None:
            _check_unit(f"inputs.{s.name}", s, unit, f"what drives '{config.inputs[s.name]}'")
    return x_axes, u_axes


def _drive(engine: Engine, commands: Sequence[str]) -> Drive | None:
    config = engine.config.drive
    if config is None:
        if commands:
            raise UsageError(f"backend.inputs.{commands[0]}: goes to the drive, and there is none; add a section drive:")
        return None
    known, quantities = engine.drivable(), (*commands, *FEEDBACK)
    for name, row in config.elements.items():
        if name not in known:
            raise UsageError(f"backend.drive.elements: {engine.file} has no '{name}' to drive; {hint(name, known)}")
        if unknown := [q for q in row if q not in quantities]:
            raise UsageError(
                f"backend.drive.elements.{name}: '{unknown[0]}' is no input of the drive; {hint(unknown[0], quantities)}"
            )
    drive = Drive.of(config, commands)
    if drive.feeds_back and not engine.base:
        raise UsageError("backend.drive: yaw is fed back, and the base is fixed; set fixed_base: false")
    if engine.config.substeps % drive.every:
        raise UsageError(
            f"backend.drive.every: {drive.every} is no divisor of the {engine.config.substeps} sub-steps; give one"
        )
    return drive


def _target(where: str, target: str, engine: Engine) -> str:
    """Of an effort the joint. A command that is taken for an effort would run without an error, and mean nothing."""
    if (by := engine.served.get(target)) is not None:
        raise UsageError(
            f"backend.{where}: {engine.file} drives joint '{target}' by its actuator '{by}'; give its command, {by}{CONTROL}, "
            f"or say {target}{EFFORT} where the input is an effort in its place"
        )
    return target.removesuffix(EFFORT)


def _lever(where: str, target: str, engine: Engine) -> Lever | None:
    """The motor that an input is the control of, or that makes the effort which it is."""
    at_joint, named = {m.joint: m for m in engine.motors}, {m.name: m for m in engine.motors}
    name = target.removesuffix(CONTROL)
    if any(name == t.name for t in engine.actuators):
        return None
    if target in {j.name for j in engine.joints} or name == target:
        return Lever(at_joint[target], False) if target in at_joint else None
    if name not in named:
        raise UsageError(
            f"backend.{where}: {engine.file} has no actuator '{name}' without a memory of its own; {hint(name, named)}"
        )
    return Lever(named[name], True)


def _unit(driven: Joint | Actuator) -> str:
    return driven.unit if isinstance(driven, Actuator) else UNITS[driven.type][2]


def _driven(where: str, name: str, engine: Engine) -> Joint | Actuator:
    actuators = {t.name + CONTROL: t for t in engine.actuators}
    return actuators[name] if name in actuators else _find(where, name, engine)


def _find(where: str, name: str, engine: Engine) -> Joint:
    known = {j.name: j for j in engine.joints}
    if name not in known:
        raise UsageError(f"backend.{where}: {engine.file} has no joint '{name}'; {hint(name, known)}")
    if not (joint := known[name]).movable:
        raise UsageError(f"backend.{where}: joint '{name}' of {engine.file} is {joint.type}; expected one that turns or slides")
    return joint


def hint(name: str, known: Collection[str]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    return f"did you mean '{near[0]}'?" if near else f"it has {', '.join(known) or 'none'}"


def _axis(name: str, joint: Joint, field: int) -> StateSpec:
    angle = joint.type == "revolute" and field == 0 and not joint.limited
    return StateSpec(name, UNITS[joint.type][field], "angle" if angle else "real")


def _matched(section: str, specs: Sequence[StateSpec], given: Mapping[str, object]) -> tuple[StateSpec, ...]:
    """The model's axes, which the spec must map exactly."""
    names = [s.name for s in specs]
    if extra := [n for n in given if n not in names]:
        raise UsageError(f"backend.{section}: the model has no '{extra[0]}'; {hint(extra[0], names)}")
    if missing := [n for n in names if n not in given]:
        what = "JOINT.position, JOINT.velocity or base.FIELD" if section == "states" else "JOINT"
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


def check_ranges(who: str, parameters: Sequence[Parameter], given: Mapping[str, Array]) -> None:
    """UsageError where a parameter is given a value (n,) outside of its bounds."""
    for p in parameters:
        value = given.get(p.name)
        if value is not None and (outside := (value < p.low) | (value > p.high)).any():
            bad = float(value[outside][0])
            raise UsageError(f"{who}: parameter {p.name} = {bad}; expected a number in [{p.low}, {p.high}]")


def step_period(period: str | None, model: System | None) -> float:
    """Seconds per step: the spec's, else the model's."""
    if period is not None:
        return seconds(period)
    if model is None:
        raise UsageError("backend.period: there is no model to take it from; add for instance period: 5 ms")
    return model.period


def to_columns(base: Array, config: EngineConfig) -> Array:
    """The base's 13 numbers as the spec's columns: themselves, or 12 with roll, pitch and yaw; what follows stays."""
    if config.rotation == "quaternion" or config.fixed_base:
        return base
    w, x, y, z = base[:, 3], base[:, 4], base[:, 5], base[:, 6]
    ahead, aside = 1 - 2 * (y * y + z * z), 2 * (w * z + x * y)
    yaw, pitch = np.arctan2(aside, ahead), np.arctan2(2 * (w * y - z * x), np.hypot(ahead, aside))
    # Of what yaw leaves: at a pitch of ±90°, where yaw is any number, the rotation is still the same one.
    s, c = np.sin(yaw), np.cos(yaw)
    roll = np.arctan2(2 * (s * (x * z + w * y) + c * (w * x - y * z)), c * (1 - 2 * (x * x + z * z)) - 2 * s * (x * y - w * z))
    return np.concatenate([base[:, :3], np.stack([roll, pitch, yaw], axis=1), base[:, 7:]], axis=1)


def from_columns(columns: Array, config: EngineConfig) -> Array:
    """Inverse of `to_columns`."""
    if config.rotation == "quaternion" or config.fixed_base:
        return columns
    (cr, cp, cy), (sr, sp, sy) = np.cos(columns[:, 3:6].T / 2), np.sin(columns[:, 3:6].T / 2)
    rotation = np.stack(
        [cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy],
        axis=1,
    )
    return np.concatenate([columns[:, :3], rotation, columns[:, 6:]], axis=1)
