"""Everything that can be wrong with a model's text, found in one pass: names, expressions, units."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, TypeVar, final

from gapcert_equations import units
from gapcert_equations.config import Axis, EquationsConfig, OutputConfig, ParameterConfig, Problem, PythonConfig
from gapcert_equations.grammar import ExpressionError, check_names, constant, name_problem, near, parse
from gapcert_equations.units import NONE, SECOND, Checker, Dimension, times

if TYPE_CHECKING:
    from gapcert_equations.config import Axes

Path = tuple[str | int, ...]
T = TypeVar("T")


def axes(declared: Axes) -> dict[str, Axis]:
    """Short and long declarations alike: `rad` and `{unit: rad}`."""
    return {name: Axis(unit=a) if isinstance(a, str) else a for name, a in declared.items()}


def velocities(config: EquationsConfig) -> dict[str, Axis]:
    """The velocity `q_dot` of each coordinate, in the unit of q per second."""
    return {f"{q}_dot": Axis(unit="1/s" if a.unit == "1" else f"{a.unit}/s") for q, a in axes(config.coordinates).items()}


def states(config: EquationsConfig) -> dict[str, Axis]:
    """All states in order: coordinates, then their velocities; or the declared ones."""
    return {**axes(config.states), **axes(config.coordinates), **velocities(config)}


def positions(derivative: Mapping[str, str]) -> dict[str, str]:
    """States of a plain derivative that merely integrate another state: θ' = ω gives {θ: ω}; circles are left out."""
    source = {x: text.strip() for x, text in derivative.items() if text.strip() in derivative}

    def grounded(x: str) -> bool:
        seen = set()
        while x in source and x not in seen:
            seen.add(x)
            x = source[x]
        return x not in source

    return {x: s for x, s in source.items() if grounded(x)}


def sites(config: EquationsConfig) -> tuple[str, ...]:
    """Where forces act: coordinates, or the equations of a derivative that are not merely another state."""
    if config.form == "mechanical":
        return tuple(config.coordinates)
    derivative = config.derivative or {}
    pure = positions(derivative)
    return tuple(x for x in config.states if x in derivative and x not in pure)


def problems(config: EquationsConfig) -> list[Problem]:
    """All problems of a model section; expressions are read once names and units are right."""
    base = config.coordinates or config.states
    found = list(_declarations(base, config.inputs, config.parameters, config.period, velocities(config)))
    found += _keys(config)
    return found or _Expressions(config).problems()


def declaration_problems(config: PythonConfig) -> list[Problem]:
    """Problems of names, units and quantities of a python model."""
    return list(_declarations(config.states, config.inputs, config.parameters, config.period, {}))


def parameter_dimension(value: float | str | ParameterConfig) -> Dimension:
    """The dimension of a stated value; none of a bare number."""
    return units.unit(units.quantity(value.value if isinstance(value, ParameterConfig) else value)[1])[0]


def delay_seconds(text: str) -> float | None:
    """Seconds of a quantity such as `12 ms`; None where the text is an expression of parameters."""
    try:
        number, given = units.quantity(text)
        dimension, factor = units.unit(given) if given else (NONE, 1.0)
    except ValueError:
        return None
    return units.convert(number, factor) if dimension == SECOND else None


def _declarations(
    states_: Axes,
    inputs: Axes,
    parameters: Mapping[str, float | str | ParameterConfig],
    period: float | str | None,
    derived: Mapping[str, Axis],
) -> Iterator[Problem]:
    seen = dict.fromkeys(derived, "velocities")
    named = (("coordinates" if derived else "states", states_), ("inputs", inputs), ("parameters", parameters))
    for section, names in named:
        for name in names:
            if (message := name_problem(name)) is not None:
                yield (section, name), message, None
            if name in seen:
                yield (section, name), f"'{name}' is already among the {seen[name]}; choose another name", None
            seen[name] = section
    for section, declared in named[:2]:
        for name, axis in axes(declared).items():
            path: Path = (section, name) if isinstance(declared[name], str) else (section, name, "unit")
            yield from _unit(path, axis.unit)
    for name, value in parameters.items():
        yield from _parameter(("parameters", name), value)
    if period is not None:
        yield from _period(period)


def _unit(path: Path, text: str) -> Iterator[Problem]:
    try:
        units.coherent(text)
    except ValueError as error:
        yield path, str(error), None


def _period(value: float | str) -> Iterator[Problem]:
    try:
        number, text = units.quantity(value)
        dimension, _ = units.unit(text or "s")
    except ValueError as error:
        yield ("period",), str(error), None
        return
    if dimension != SECOND or number <= 0:
        yield ("period",), f"found '{value}'; expected a positive time such as 5 ms", None


def _parameter(path: Path, value: float | str | ParameterConfig) -> Iterator[Problem]:
    parts = value if isinstance(value, ParameterConfig) else ParameterConfig(value=value)
    try:
        dimension = parameter_dimension(parts)
    except ValueError as error:
        yield (*path, "value") if isinstance(value, ParameterConfig) else path, str(error), None
        return
    for name in ("tolerance", "low", "high"):
        if (other := getattr(parts, name)) is None:
            continue
        try:
            number, text = units.quantity(other)
            relative = name == "tolerance" and text in ("%", "percent")
            if text and not relative and units.unit(text)[0] != dimension:
                yield (*path, name), f"found '{other}'; expected {units.base_text(dimension)}", None
            if name == "tolerance" and number < 0:
                yield (*path, name), f"found '{other}'; expected a tolerance of at least 0", None
        except ValueError as error:
            yield (*path, name), str(error), None


def _keys(config: EquationsConfig) -> Iterator[Problem]:
    """Keys that must name a state, a coordinate, a site or an input."""
    if config.form != "mechanical":
        given = config.derivative if config.form == "derivative" else config.next
        yield from _unknown(config.form, given or {}, config.states)
        for name in config.states:
            if name not in (given or {}):
                yield (config.form,), f"no equation for state '{name}'; add {name}: expression", None
    else:
        n = len(config.coordinates)
        rows = config.mass_matrix or []
        if len(rows) != n or any(len(r) != n for r in rows):
            shape = f"{len(rows)} rows of {sorted({len(r) for r in rows})} entries"
            yield ("mass_matrix",), f"found {shape}; expected {n} x {n} for coordinates {', '.join(config.coordinates)}", None
        yield from _unknown("bias", config.bias, config.coordinates)
        yield from _unknown("forces", config.forces, config.coordinates)
    yield from _unknown("dry_friction", config.dry_friction, sites(config))
    yield from _unknown("input_delay", config.input_delay, config.inputs)


def _unknown(section: str, given: Iterable[str], known: Iterable[str]) -> Iterator[Problem]:
    known = list(known)
    for name in given:
        if name not in known:
            yield (section, name), f"'{name}' does not belong here; {near(name, known)}", None


@final
class _Expressions:
    """Reads every expression of a model whose names and units are right, and keeps what is wrong."""

    def __init__(self, config: EquationsConfig) -> None:
        self.config = config
        self.found: list[Problem] = []
        declared = {**states(config), **axes(config.inputs)}
        self.parameters = {n: parameter_dimension(p) for n, p in config.parameters.items()}
        names = {n: units.unit(a.unit)[0] for n, a in declared.items()}
        shown = {a.unit: names[n] for n, a in declared.items() if names[n]}
        self.checker = Checker({**names, **self.parameters}, {"1": NONE, **shown})

    def problems(self) -> list[Problem]:
        c = self.config
        if c.form == "mechanical":
            self._mechanical()
        else:
            per, what = (-1, "the unit of {} per second") if c.form == "derivative" else (0, "the unit of {}")
            for section, texts in ((c.form, (c.derivative or c.next) or {}), ("dry_friction", c.dry_friction)):
                for name, text in texts.items():
                    self._expect((section, name), text, times(self.checker.names[name], SECOND, per), what.format(name))
        for name, text in c.input_delay.items():
            self._delay(("input_delay", name), text)
        for name, output in c.outputs.items():
            self._output(("outputs", name), output if isinstance(output, OutputConfig) else OutputConfig(expr=output))
        return self.found

    def _mechanical(self) -> None:
        c = self.config
        for i, (q, row) in enumerate(zip(c.coordinates, c.mass_matrix or [], strict=True)):
            diagonal = self._infer(("mass_matrix", i, i), row[i])
            if diagonal is None:
                continue
            if constant(parse(row[i])) == 0:
                self.found.append((("mass_matrix", i, i), f"the inertia of {q} is 0; expected a positive one", 0))
                continue
            # The diagonal entry times the acceleration decides the unit of the whole row.
            force = times(times(diagonal, self.checker.names[q]), SECOND, -2)
            for j, p in enumerate(c.coordinates):
                inertia = times(force, times(self.checker.names[p], SECOND, -2), -1)
                self._expect(("mass_matrix", i, j), row[j], inertia, f"to fit mass_matrix[{i}][{i}]")
            for section in ("bias", "forces", "dry_friction"):
                if (text := getattr(c, section).get(q)) is not None:
                    self._expect((section, q), text, force, f"the unit of mass_matrix[{i}][{i}] times {q}_dot per second")

    def _delay(self, path: Path, text: str) -> None:
        seconds = delay_seconds(text)
        if seconds is None:
            self._expect(path, text, SECOND, "a time", self.parameters)
        elif seconds < 0:
            self.found.append((path, f"found '{text}'; expected a time of at least 0", 0))

    def _output(self, path: Path, output: OutputConfig) -> None:
        if (message := name_problem(str(path[-1]))) is not None:
            self.found.append((path, message, None))
        where = path if isinstance(self.config.outputs[str(path[-1])], str) else (*path, "expr")
        if output.unit is None:
            self._infer(where, output.expr)
        elif bad := list(_unit((*path, "unit"), output.unit)):
            self.found += bad
        else:
            self._expect(where, output.expr, units.unit(output.unit)[0], f"the unit of {path[-1]}")

    def _expect(self, path: Path, text: str, wanted: Dimension, what: str, known: Iterable[str] | None = None) -> None:
        self._guarded(path, text, lambda tree: self.checker.require(tree, wanted, what), known)

    def _infer(self, path: Path, text: str) -> Dimension | None:
        return self._guarded(path, text, lambda tree: self.checker.infer(tree) or NONE)

    def _guarded(self, path: Path, text: str, use: Callable[[ast.expr], T], known: Iterable[str] | None = None) -> T | None:
        try:
            tree = parse(text)
            check_names(tree, self.checker.names if known is None else known)
            return use(tree)
        except ExpressionError as error:
            self.found.append((path, str(error), error.offset))
            return None
