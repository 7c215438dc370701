"""The names of a spec looked up among the variables of an FMU."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from gapcert import Array, Parameter, StateSpec, System, UsageError

from .config import FmuConfig
from .description import Description, check_unit, settable


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
        if not settable(variable):
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
    whole = [v.name for v in others if v.type not in ("Real", "Float64")]
    if whole and config.memory == "refuse":
        raise UsageError(
            f"backend.states: the FMU remembers '{whole[0]}', which is no real number, so that no state can be it; say memory: "
            f"forget if every period may begin with its start value"
        )
    others = [v for v in others if v.name not in whole]
    if stuck := [v.name for v in others if not settable(v)]:
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
        check_unit(f"{section}.{spec.name}", spec, d.unit(own[spec.name]), own[spec.name].name)
    return tuple(given)


def _parameter(config: FmuConfig, d: Description, variable: Any) -> Parameter:
    value = float(config.set.get(variable.name, variable.start))
    low, high = (float(e) if e is not None else end for e, end in ((variable.min, -np.inf), (variable.max, np.inf)))
    if not low <= value <= high:
        raise UsageError(f"backend.set.{variable.name}: found {value}; expected a number in [{low}, {high}], as the FMU says")
    return Parameter(variable.name, value, d.unit(variable), low=low, high=high)
