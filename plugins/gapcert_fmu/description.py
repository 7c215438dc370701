"""What an FMU says of itself: its variables, their units, how it can be stepped; and the names of a spec among them."""

from __future__ import annotations

import difflib
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import fmpy
import numpy as np

from gapcert import Array, Parameter, StateSpec, System, UsageError
from gapcert.plugin import magnitude

from .config import FmuConfig

REALS = ("Real", "Float64", "Float32")
INTEGERS = ("Integer", "Enumeration", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64")
_DOUBLE = ("Real", "Float64")
_BASE = {"kg": "kg", "m": "m", "s": "s", "A": "A", "K": "K", "mol": "mol", "cd": "cd", "rad": "rad"}
_POWER = re.compile(r"(?<=[A-Za-z])(-?\d+)")


@final
@dataclass(frozen=True)
class Description:
    """The model description of an unpacked FMU, with `interface` co-simulation or model-exchange."""

    file: str
    folder: Path
    read: Any
    interface: str

    @classmethod
    def of(cls, file: str, folder: Path, interface: str | None) -> Description:
        """UsageError where it is not valid, or has nothing that runs here."""
        try:
            read = fmpy.read_model_description(str(folder), validate=True)
        except Exception as error:  # lxml, the schema, and fmpy's own checks
            reason = " ".join(str(error).split())
            raise UsageError(f"file: {file}: its model description is not valid: {reason}; ask its exporter") from None
        has = {"co-simulation": read.coSimulation, "model-exchange": read.modelExchange}
        kinds = [name for name, there in has.items() if there is not None]
        if not read.fmiVersion.startswith(("2.", "3.")):
            raise UsageError(f"file: {file} is FMI {read.fmiVersion}; expected 2.0 or 3.0; export it so")
        if interface is not None and interface not in kinds:
            raise UsageError(
                f"backend.interface: {file} has no {interface}; it has {', '.join(kinds) or 'none that can be stepped'}"
            )
        if not kinds:
            raise UsageError(f"file: {file} has neither co-simulation nor model exchange; expected one of them")
        found = cls(file, folder, read, interface or kinds[0])
        found._check_binary()
        return found

    @property
    def of_interface(self) -> Any:
        """What stands under <CoSimulation> or <ModelExchange>."""
        return self.read.coSimulation if self.interface == "co-simulation" else self.read.modelExchange

    @property
    def newer(self) -> bool:
        """Is it FMI 3?"""
        return bool(self.read.fmiVersion.startswith("3."))

    def variable(self, where: str, name: str) -> Any:
        """By name; UsageError where there is none, or it is an array."""
        known = {v.name: v for v in self.read.modelVariables}
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"it has {', '.join(list(known)[:20])}"
            raise UsageError(f"backend.{where}: {self.file} has no variable '{name}'; {hint}")
        if known[name].dimensions:
            raise UsageError(f"backend.{where}: '{name}' of {self.file} is an array; expected a single number")
        return known[name]

    def real(self, where: str, name: str) -> Any:
        """A variable that is a real number in double precision."""
        found = self.variable(where, name)
        if found.type not in _DOUBLE:
            raise UsageError(
                f"backend.{where}: '{name}' of {self.file} is of type {found.type}; expected a real number of 64 bits"
            )
        return found

    def unit(self, variable: Any) -> str:
        """Of a variable, as gapcert writes it; 1 where it says none."""
        name = variable.unit or (variable.declaredType.unit if variable.declaredType is not None else None)
        if not name:
            return "1"
        for known in self.read.unitDefinitions:
            if known.name == name and known.baseUnit is not None:
                return _written(name, known.baseUnit)
        return spelled(name)

    def continuous(self) -> list[Any]:
        """The continuous states, in the order of their derivatives."""
        return [u.variable.derivative for u in self.read.derivatives if u.variable.derivative is not None]

    def discrete(self) -> list[Any]:
        """Variables that keep a start value until an event changes them: what the FMU remembers."""
        return [
            v
            for v in self.read.modelVariables
            if v.variability == "discrete" and v.causality in ("local", "output") and _settable(v) and not v.dimensions
        ]

    def tunable(self) -> list[Any]:
        """Parameters that are single real numbers with a start value."""
        return [
            v
            for v in self.read.modelVariables
            if v.causality == "parameter" and v.type in _DOUBLE and v.start is not None and not v.dimensions
        ]

    def _check_binary(self) -> None:
        system = "linux64" if not self.newer else f"{platform.machine()}-linux"
        name = f"{self.of_interface.modelIdentifier}.so"
        if self.of_interface.needsExecutionTool:
            raise UsageError(f"file: {self.file} needs the tool that wrote it to run; export it with everything in it")
        if not (self.folder / "binaries" / system / name).is_file():
            has = sorted(p.name for p in (self.folder / "binaries").glob("*")) or ["none"]
            raise UsageError(
                f"file: {self.file} has no binary for this machine, binaries/{system}/{name}; it has those for "
                f"{', '.join(has)}; export it for Linux, or compile its sources with fmpy"
            )


@final
@dataclass(frozen=True)
class Wiring:
    """What the backend declares, and value references: `reads` of states and hidden states, `writes` of what sets these and of
    inputs, `references` of parameters. starts, nominal (nx,): of the states; preset: what the spec's `set` gives."""

    states: tuple[StateSpec, ...]
    inputs: tuple[StateSpec, ...]
    hidden: tuple[StateSpec, ...]
    hidden_default: tuple[float, ...]
    parameters: tuple[Parameter, ...]
    starts: Array
    nominal: Array
    reads: tuple[int, ...]
    writes: tuple[int, ...]
    references: Mapping[str, int]
    preset: tuple[tuple[Any, float | bool | str], ...]


def wire(config: FmuConfig, d: Description, model: System | None) -> Wiring:
    """UsageError where a name or a unit does not fit, or a state cannot be started."""
    read = {n: d.real(f"states.{n}", config.variable(n)) for n in config.states}
    write = {n: d.real(f"states.{n}", config.setter(n)) for n in config.states}
    driven = {n: d.real(f"inputs.{n}", v) for n, v in config.inputs.items()}
    for name, variable in driven.items():
        if variable.causality != "input":
            raise UsageError(
                f"backend.inputs.{name}: '{variable.name}' is of causality {variable.causality}; expected an input"
            )
    for name, variable in write.items():
        if not _settable(variable):
            raise UsageError(
                f"backend.states.{name}: '{variable.name}' cannot be given a start value ({variable.initial or 'calculated'}); "
                f"expected a variable with initial exact or approx, or {{variable: {variable.name}, start: PARAMETER}}"
            )
    states = _axes("states", d, read, None if model is None else model.states)
    inputs = _axes("inputs", d, driven, None if model is None else model.inputs)
    others = _others(config, d, {v.name for v in (*read.values(), *write.values())})
    starts = {v.name for v in write.values()}
    own = [v for v in d.tunable() if v.name not in starts]
    order = [s.name for s in states]
    writes = [write[n] for n in order] + others + [driven[s.name] for s in inputs]
    return Wiring(
        states,
        inputs,
        tuple(StateSpec(v.name, d.unit(v)) for v in others),
        tuple(float(v.start) for v in others),
        tuple(_parameter(config, d, v) for v in own),
        np.array([float(write[n].start or 0.0) for n in order]),
        np.array([float(read[n].nominal or 1.0) for n in order]),
        tuple([read[n].valueReference for n in order] + [v.valueReference for v in others]),
        tuple(v.valueReference for v in writes),
        {v.name: v.valueReference for v in own},
        tuple((d.variable(f"set.{n}", n), v) for n, v in config.set.items()),
    )


def _others(config: FmuConfig, d: Description, named: set[str]) -> list[Any]:
    """What the FMU declares to remember besides; UsageError where that cannot be handed on."""
    others = [v for v in (*d.continuous(), *d.discrete()) if v.name not in named]
    whole = [v.name for v in others if v.type not in _DOUBLE]
    if whole and config.memory == "refuse":
        raise UsageError(
            f"backend.states: the FMU remembers '{whole[0]}', which is no real number, so that no state can be it; say memory: "
            f"forget if every period may begin with its start value"
        )
    others = [v for v in others if v.name not in whole]
    if stuck := [v.name for v in others if not _settable(v)]:
        raise UsageError(
            f"backend.states: {stuck[0]} is a continuous state of the FMU that is in no state and cannot be given a start "
            f"value; name it, with a start"
        )
    return others


def _axes(section: str, d: Description, own: Mapping[str, Any], given: Sequence[StateSpec] | None) -> tuple[StateSpec, ...]:
    """The model's axes, whose units must be the FMU's, or the FMU's own."""
    if given is None:
        return tuple(StateSpec(n, d.unit(v)) for n, v in own.items())
    names = [s.name for s in given]
    if extra := [n for n in own if n not in names]:
        raise UsageError(f"backend.{section}: the model has no '{extra[0]}'; it has {', '.join(names) or 'none'}")
    if missing := [n for n in names if n not in own]:
        raise UsageError(f"backend.{section}: '{missing[0]}' of the model is missing; add {missing[0]}: VARIABLE")
    for spec in given:
        _check_unit(f"{section}.{spec.name}", spec, d.unit(own[spec.name]), own[spec.name].name)
    return tuple(given)


def _parameter(config: FmuConfig, d: Description, variable: Any) -> Parameter:
    value = float(config.set.get(variable.name, variable.start))
    low, high = (float(e) if e is not None else end for e, end in ((variable.min, -np.inf), (variable.max, np.inf)))
    if not low <= value <= high:
        raise UsageError(f"backend.set.{variable.name}: found {value}; expected a number in [{low}, {high}], as the FMU says")
    return Parameter(variable.name, value, d.unit(variable), low=low, high=high)


def _settable(variable: Any) -> bool:
    """Can it be given a value while the FMU is initialised?"""
    return variable.initial in ("exact", "approx") and variable.variability != "constant"


def spelled(name: str) -> str:
    """Modelica's way to write a unit, `N.m/s2`, as `N*m/s**2`."""
    return _POWER.sub(r"**\1", name.replace(".", "*"))


def _check_unit(where: str, spec: StateSpec, unit: str, name: str) -> None:
    """Refuses a model's unit that is not the FMU's."""
    try:
        same = abs(magnitude(f"1 {spec.unit}", unit) - 1) <= 1e-12 and magnitude(f"0 {spec.unit}", unit) == 0
    except ValueError:
        same = False
    if not same:
        raise UsageError(
            f"backend.{where}: the model gives it in {spec.unit}, but '{name}' of the FMU is in {unit}; use {unit}"
        )


def _written(name: str, base: Any) -> str:
    """The name where it means what the definition says; else the definition."""
    parts = [f"{unit}**{power}" for key, unit in _BASE.items() if (power := getattr(base, key))]
    exact = "*".join(parts) or "1"
    factor = float(base.factor)
    try:
        agree = float(base.offset) == 0 and abs(magnitude(f"1 {spelled(name)}", exact) - factor) <= 1e-9 * factor
    except ValueError:
        agree = False
    if agree:
        return spelled(name)
    if factor == 1 and float(base.offset) == 0:
        return exact
    return spelled(name)
