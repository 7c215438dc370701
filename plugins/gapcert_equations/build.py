"""A checked config → coherent numbers, named columns, and tapes."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

from gapcert import Interval, Parameter, StateSpec, UsageError
from gapcert_equations.thresholds import THRESHOLDS

from .config import Axis, EquationsConfig, MemoryConfig, OutputConfig, ParameterConfig, Problem, PythonConfig
from .mechanics import bodies, rigid
from .mechanics.dynamics import Dynamics
from .programs.arithmetic import INTERVAL
from .programs.tape import Recorder, Tape
from .text import declarations, units
from .text.grammar import ExpressionError, names, parse
from .text.sympy_text import expression, symbol
from .text.units import SECOND, Checker

_STEPPED = ("integrator", "substeps", "soft_friction", "friction_after_damping")


@final
@dataclass(frozen=True)
class Delays:
    """Seconds by which inputs, or outputs, come late (`tape`, of parameters alone); memory: past periods that inputs keep."""

    tape: Tape
    at: tuple[int, ...]
    memory: tuple[int, ...] = ()


@final
@dataclass(frozen=True)
class Definition:
    """All that an EquationsModel computes with."""

    config: EquationsConfig
    texts: str
    recorder: Recorder
    states: tuple[StateSpec, ...]
    inputs: tuple[StateSpec, ...]
    outputs: tuple[StateSpec, ...]
    parameters: tuple[Parameter, ...]
    period: float
    sites: tuple[str, ...]
    dynamics: Dynamics
    memory: tuple[StateSpec, ...]
    start: tuple[float, ...]
    output: Tape | None
    delays: Delays | None
    output_delays: Delays | None
    shown: tuple[bool, ...]


def refuse(problems: Sequence[Problem]) -> None:
    """One UsageError that tells all problems of a model section."""
    if problems:
        lines = [
            "model." + ".".join(map(str, path)) + ": " + text + (f" (column {at + 1})" if at else "")
            for path, text, at in problems
        ]
        raise UsageError("\n".join(lines))


def define(config: EquationsConfig, base: Definition | None = None) -> Definition:
    """UsageError with every problem of the section, else its columns, numbers and tapes.

    base: of another model, such as one that this one extends; what was checked and recorded there is not done again.
    """
    refuse(config.check(base and base.config))
    states, inputs = declarations.states(config), declarations.axes(config.inputs)
    parameters = tuple(parameter(n, p) for n, p in config.parameters.items())
    if config.period is None:
        raise UsageError("model.period: missing; give the sampling period, such as 5 ms (a diagnosis takes its recording's)")
    period = seconds(config.period)
    recorder, texts = Recorder() if base is None else base.recorder, _texts(config)
    if (same := recorder.defined.get(texts)) is not None:
        return _stepped(config, same, parameters, period)
    text = _Reader(config, [*states, *inputs, *config.memory], recorder)
    outputs, late, seen = _outputs(config, states, inputs), config.input_delay, config.output_delay
    shown = [y.name for y in outputs]
    out = text.recorder.defined[texts] = Definition(
        config=config,
        texts=texts,
        recorder=text.recorder,
        states=specs(states),
        inputs=specs(inputs),
        outputs=outputs,
        parameters=parameters,
        period=period,
        sites=declarations.sites(config),
        dynamics=_dynamics(config, text, list(states), period),
        memory=tuple(StateSpec(n, m.unit) for n, m in config.memory.items()),
        start=tuple(_start(m) for m in config.memory.values()),
        output=text.tape(_output_texts(config)) if config.outputs else None,
        delays=_delays(config, _delay_tape(text, "input_delay", late), parameters, period) if late else None,
        output_delays=Delays(_delay_tape(text, "output_delay", seen), tuple(map(shown.index, seen))) if seen else None,
        shown=_shown(config),
    )
    return out


def _texts(config: EquationsConfig) -> str:
    """Digest of what tapes rest on: neither values of parameters nor how time is stepped."""
    named = [(n, units.quantity(p.value if isinstance(p, ParameterConfig) else p)[1]) for n, p in config.parameters.items()]
    text = config.model_dump_json(exclude={"parameters", "period", *_STEPPED}) + repr(named)
    return hashlib.sha256(text.encode()).hexdigest()


def _stepped(config: EquationsConfig, same: Definition, parameters: tuple[Parameter, ...], period: float) -> Definition:
    """The same tapes, of which other values are asked, or which are stepped otherwise."""
    how, dynamics = _how(config, period), same.dynamics
    if any(getattr(dynamics, k) != v for k, v in how.items()):
        dynamics = replace(dynamics, **how)
    delays = same.delays and _delays(config, same.delays.tape, parameters, period)
    return replace(same, config=config, parameters=parameters, period=period, dynamics=dynamics, delays=delays)


def _start(memory: MemoryConfig) -> float:
    number, text = units.quantity(memory.start)
    return units.convert(number, units.unit(text)[1]) if text else number


def specs(axes: Mapping[str, Axis]) -> tuple[StateSpec, ...]:
    """Name, unit and kind of every axis."""
    return tuple(StateSpec(n, a.unit, a.kind) for n, a in axes.items())


def seconds(value: float | str) -> float:
    """A time in s; bare numbers are in s."""
    number, text = units.quantity(value)
    return units.convert(number, units.unit(text or "s")[1])


def parameter(name: str, value: float | str | ParameterConfig) -> Parameter:
    """In the coherent unit of its dimension; bare tolerances and bounds are in the unit of the value."""
    p = value if isinstance(value, ParameterConfig) else ParameterConfig(value=value)
    number, text = units.quantity(p.value)
    dimension, factor = units.unit(text)

    def coherent(other: float | str) -> float:
        n, given = units.quantity(other)
        return units.convert(n, units.unit(given)[1] if given else factor)

    stated, tolerance = units.convert(number, factor), 0.0
    if p.tolerance is not None:
        n, given = units.quantity(p.tolerance)
        tolerance = abs(stated) * n / 100 if given in ("%", "percent") else coherent(p.tolerance)
    low = -math.inf if p.low is None else coherent(p.low)
    high = math.inf if p.high is None else coherent(p.high)
    unit = (text or "1") if factor == 1.0 else units.base_text(dimension, text)
    return Parameter(name, stated, unit, tolerance, low, high)


def declared(config: PythonConfig) -> tuple[tuple[StateSpec, ...], tuple[StateSpec, ...], tuple[Parameter, ...], float]:
    """States, inputs, parameters and period of a python model."""
    refuse(config.check())
    parameters = tuple(parameter(n, p) for n, p in config.parameters.items())
    return specs(declarations.axes(config.states)), specs(declarations.axes(config.inputs)), parameters, seconds(config.period)


@final
class _Reader:
    """Texts of one model → tapes over its parameters and its columns."""

    def __init__(self, config: EquationsConfig, columns: Sequence[str], recorder: Recorder) -> None:
        self.parameters = [symbol(n) for n in (*config.parameters, declarations.substep(config))]
        self.columns = [symbol(n) for n in columns]
        self.recorder = recorder.knowing(self.parameters, self.columns)

    def tape(self, texts: Mapping[str, str], columns: bool = True) -> Tape:
        return self.record([self.read(path, text) for path, text in texts.items()], columns)

    def record(self, expressions: Sequence[Any], columns: bool = True) -> Tape:
        return self.recorder.tape(expressions, self.parameters, self.columns if columns else [])

    def read(self, path: str, text: str) -> Any:
        try:
            return expression(text)
        except ExpressionError as error:
            raise ExpressionError(f"model.{path}: {error}", error.offset) from None


def _dynamics(config: EquationsConfig, text: _Reader, states: list[str], period: float) -> Dynamics:
    memory = text.tape({f"memory.{z}.next": m.next for z, m in config.memory.items()})
    if config.form == "next":
        equations = config.next or {}
        return Dynamics(text.tape({f"next.{x}": equations[x] for x in states}), memory, **_how(config, period))
    sites = declarations.sites(config)
    friction = [text.read(f"dry_friction.{s}", config.dry_friction.get(s, "0")) for s in sites]
    if config.form == "derivative":
        derivative = config.derivative or {}
        rates = [text.read(f"derivative.{s}", derivative[s]) for s in sites]
        rows = tuple(states.index(s) for s in sites)
        moves = tuple((states.index(q), states.index(v)) for q, v in declarations.positions(derivative).items())
    else:
        n = len(sites)
        if config.bodies is not None:
            mass, rates = bodies.terms(config, text.recorder, text.read)
        else:
            m = rigid.terms(config, text.read)
            mass, rates = m.mass, [f - b for f, b in zip(m.forces, m.bias, strict=True)]
        rates = [e for row in mass for e in row] + rates
        friction += [text.read(f"implicit.{s}", config.implicit.get(s, "0")) for s in sites if config.implicit]
        rows, moves = tuple(range(n, 2 * n)), tuple((i, n + i) for i in range(n))
    return Dynamics(text.record(rates + friction), memory, rows, moves, config.form == "mechanical", **_how(config, period))


def _how(config: EquationsConfig, period: float) -> dict[str, Any]:
    """How Dynamics step in time."""
    if config.form == "next":
        return {"period": period}
    soft = [(s.compliance, s.rate) if (s := config.soft_friction.get(q)) else None for q in declarations.sites(config)]
    how = {"integrator": config.scheme, "substeps": config.substeps, "period": period, "softness": tuple(soft)}
    return how | {"late": config.friction_after_damping}


def _output_texts(config: EquationsConfig) -> dict[str, str]:
    return {f"outputs.{y}": o.expr if isinstance(o, OutputConfig) else o for y, o in config.outputs.items()}


def _outputs(config: EquationsConfig, states: Mapping[str, Axis], inputs: Mapping[str, Axis]) -> tuple[StateSpec, ...]:
    """Declared units and kinds, else those of the column that an output shows, else what its expression gives."""
    columns = {**states, **inputs}
    if not config.outputs:
        return specs(states)
    known = {n: units.unit(a.unit)[0] for n, a in columns.items()}
    known |= {n: declarations.parameter_dimension(p) for n, p in config.parameters.items()}
    known |= {n: units.unit(m.unit)[0] for n, m in config.memory.items()} | {declarations.substep(config): SECOND}
    out = []
    for y, given in config.outputs.items():
        o = given if isinstance(given, OutputConfig) else OutputConfig(expr=given)
        shown = columns.get(o.expr.strip())
        unit = shown.unit if shown else units.base_text(Checker(known, {}).infer(parse(o.expr)) or {})
        out.append(StateSpec(y, o.unit or unit, o.kind or (shown.kind if shown else "real")))
    return tuple(out)


def _shown(config: EquationsConfig) -> tuple[bool, ...]:
    """Per input, is what outputs show of it what acts? Not where one of them reports it."""
    texts, through = _output_texts(config), {f"outputs.{y}" for y in declarations.shown(config)}
    held = [{n for y, t in texts.items() if (y in through) == acts for n, _ in names(parse(t))} for acts in (True, False)]
    return tuple(u in held[0] and u not in held[1] for u in config.inputs)


def _delay_tape(text: _Reader, section: str, delays: Mapping[str, str]) -> Tape:
    """Of quantities, and of expressions of parameters."""
    constants = {n: declarations.quantity_in(given, SECOND) for n, given in delays.items()}
    texts = {n: given if constants[n] is None else repr(constants[n]) for n, given in delays.items()}
    return text.tape({f"{section}.{n}": t for n, t in texts.items()}, columns=False)


def _delays(config: EquationsConfig, tape: Tape, parameters: Sequence[Parameter], period: float) -> Delays:
    """Memory covers the longest delay that the parameters' bounds, else tolerances, allow."""
    low = [p.low if math.isfinite(p.low) else p.value - p.tolerance for p in parameters]
    high = [p.high if math.isfinite(p.high) else p.value + p.tolerance for p in parameters]
    ranges = [*(Interval.hull(a, b) for a, b in zip(low, high, strict=True)), Interval.exact(period / config.substeps)]
    longest = [0.0 if t is None else float(t.hi) for t in tape.run(INTERVAL, tape.prepare(INTERVAL, ranges), [])]
    memory = [0 if t <= 0 else max(1, math.ceil(t / period - 1e-9)) for t in longest]
    for u, count in zip(config.input_delay, memory, strict=True):
        if count > THRESHOLDS.delays:
            raise UsageError(
                f"model.input_delay.{u}: {count} periods are longer than {THRESHOLDS.delays}; shorten the delay or its bounds"
            )
    names = list(config.inputs)
    return Delays(tape, tuple(names.index(u) for u in config.input_delay), tuple(memory))
