"""Everything that can be wrong with a model's text, found in one pass: names, expressions, units."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import TypeVar, final

from gapcert_equations.config import EquationsConfig, OutputConfig, ParameterConfig, Problem

from . import declarations, units
from .declarations import Path, agree, axes, parameter_dimension, quantity_in, states, substep, velocities
from .grammar import ExpressionError, check_names, constant, name_problem, parse
from .units import ACCELERATION, INERTIA, KILOGRAM, METRE, NONE, SECOND, Checker, Dimension, times

PER_SECOND = times(NONE, SECOND, -1)
POWERS = [Fraction(sign * n, d) for n, d in ((1, 1), (1, 2), (2, 1), (1, 3), (3, 1)) for sign in (1, -1)]
"""Of what a term lacks, in the unit of a parameter that stands in it once, by the square, under a root, or in a divisor."""
T = TypeVar("T")


def problems(config: EquationsConfig, known: EquationsConfig | None = None) -> list[Problem]:
    """All problems of a model section beside those of `known`; expressions are read once names and units are right."""
    if found := declarations.problems(config):
        return found
    reader = _Expressions(config, known if known is not None and agree(config, known) else None)
    return [*reader.problems(), *_misstated(reader)]


def _misstated(reader: _Expressions) -> Iterator[Problem]:
    """The one parameter, if it is one, with which in another unit all units would agree: it may be its own that is wrong."""
    c, fitting = reader.config, list[tuple[str, Dimension]]()
    for name, own in reader.parameters.items() if reader.lacking else ():
        for power in POWERS:
            other = times(own, reader.lacking[0], power)
            trial = _Expressions(c, None, reader.parameters | {name: other})
            trial.problems()
            if not trial.lacking:
                fitting.append((name, other))
                break
        if len(fitting) > 1:
            return
    for name, other in fitting:
        given = c.parameters[name]
        long = isinstance(given, ParameterConfig)
        stated = units.quantity(given.value if isinstance(given, ParameterConfig) else given)[1] or "no unit"
        told = f"found {stated}; with {reader.checker.text(other)} the units of {reader.disagreeing} would agree"
        yield ("parameters", name, "value") if long else ("parameters", name), told, None


def force_unit(config: EquationsConfig, q: str) -> str:
    """Of the generalised force at a coordinate: the diagonal entry of the mass matrix times the acceleration decides it."""
    reader, i = _Expressions(config, config), list(config.coordinates).index(q)
    if config.bodies is not None:
        force = reader._effort(q)
    elif (inertia := reader._inertia(i, (config.mass_matrix or [])[i][i]) or NONE) == NONE:
        return f"{velocities(config)[f'{q}_dot'].unit}**2"  # V/s**2 says more than the same in kg, m, s and A
    else:
        force = times(times(inertia, reader.checker.names[q]), SECOND, -2)
    usual = {"rad": "N*m", "m": "N"}.get(states(config)[q].unit, "1")
    return usual if units.unit(usual)[0] == force else reader.checker.text(force)


def _texts(config: EquationsConfig) -> Iterator[tuple[Path, str]]:
    """Every expression with its path."""
    by_force = ("derivative", "next", "bias", "forces", "dry_friction", "implicit")
    for section in (*by_force, "input_delay", "output_delay", "payload", "tilt"):
        yield from (((section, name), text) for name, text in (getattr(config, section) or {}).items())
    for section, rows in (("mass_matrix", enumerate(config.mass_matrix or [])), ("points", config.points.items())):
        yield from (((section, i, j), text) for i, row in rows for j, text in enumerate(row))
    yield from ((("memory", z, "next"), m.next) for z, m in config.memory.items())


@final
class _Expressions:
    """Reads every expression of a model whose names and units are right, and keeps what is wrong."""

    def __init__(
        self,
        config: EquationsConfig,
        known: EquationsConfig | None,
        parameters: Mapping[str, Dimension] | None = None,
    ) -> None:
        """parameters: their dimensions, where these are not the stated ones."""
        self.config = config
        self.known = set(_texts(known)) if known is not None else set()
        self.bodies = known.bodies if known is not None else None
        self.found: list[Problem] = []
        self.lacking: list[Dimension] = []
        self.disagreeing = ""
        declared = {**states(config), **axes(config.inputs)}
        stated = parameters or {n: parameter_dimension(p) for n, p in config.parameters.items()}
        self.parameters = dict(stated)
        names = {n: units.unit(a.unit)[0] for n, a in declared.items()}
        shown = {a.unit: names[n] for n, a in declared.items() if names[n]}
        self.measurable = {**names, **self.parameters}
        self.places = {n: d for n, d in self.measurable.items() if n in config.coordinates or n in self.parameters}
        hidden = {n: units.unit(m.unit)[0] for n, m in config.memory.items()} | {substep(config): SECOND}
        self.checker = Checker({**self.measurable, **hidden}, {"1": NONE, **shown})

    def problems(self) -> list[Problem]:
        c = self.config
        if c.form == "mechanical":
            self._mechanical()
        else:
            per, what = (-1, "the unit of {} per second") if c.form == "derivative" else (0, "the unit of {}")
            for section, texts in ((c.form, (c.derivative or c.next) or {}), ("dry_friction", c.dry_friction)):
                for name, text in texts.items():
                    self._expect((section, name), text, times(self.checker.names[name], SECOND, per), what.format(name))
        for name, m in c.memory.items():
            self._expect(("memory", name, "next"), m.next, self.checker.names[name], f"the unit of {name}")
        for section, texts in (("input_delay", c.input_delay), ("output_delay", c.output_delay)):
            for name, text in texts.items():
                self._delay((section, name), text)
        for name, output in c.outputs.items():
            self._output(("outputs", name), output if isinstance(output, OutputConfig) else OutputConfig(expr=output))
        return self.found

    def _mechanical(self) -> None:
        c = self.config
        if c.bodies is not None:
            self._bodies()
            return
        for i, (q, row) in enumerate(zip(c.coordinates, c.mass_matrix or [], strict=True)):
            texts: list[tuple[Path, str | None]] = [(("mass_matrix", i, j), text) for j, text in enumerate(row)]
            texts += [((k, q), getattr(c, k).get(q)) for k in ("bias", "forces", "dry_friction", "implicit")]
            if all(text is None or (path, text) in self.known for path, text in texts):
                continue
            diagonal = self._inertia(i, row[i])
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
            if (text := c.implicit.get(q)) is not None:
                self._expect(
                    ("implicit", q), text, times(diagonal, SECOND, -1), f"the unit of mass_matrix[{i}][{i}] per second"
                )
        self._gravity()

    def _bodies(self) -> None:
        c = self.config
        for name, body in (c.bodies or {}).items() if c.bodies != self.bodies else ():
            straight = body.joint is not None and self.checker.names[body.joint] == METRE
            own: list[tuple[str, Sequence[str], Dimension, str]] = [("mass", (body.mass,), KILOGRAM, "a mass")]
            own += [("at", body.at, METRE, "a place"), ("com", body.com, METRE, "a place")]
            own += [("inertia", body.inertia, INERTIA, "an inertia")]
            own += [("armature", (body.armature,), KILOGRAM if straight else INERTIA, "an inertia")]
            own += [("lifted", (body.lifted,), NONE, "a share")]
            for section, texts, wanted, what in own:
                for i, text in enumerate(texts):
                    path: Path = ("bodies", name, section) if len(texts) == 1 else ("bodies", name, section, i)
                    if constant(parse(text)) is None:
                        self._expect(path, text, wanted, what, self.parameters)
            for section, squared in (("linear", times(NONE, METRE, -1)), ("angular", NONE)):
                for i, (text, wanted) in enumerate(zip(getattr(body.drag, section), (PER_SECOND, squared), strict=True)):
                    if constant(parse(text)) is None:
                        what = ("a rate", "drag by the square")[i]
                        self._expect(("bodies", name, "drag", section, i), text, wanted, what, self.parameters)
        for section in ("forces", "dry_friction"):
            for q, text in getattr(c, section).items():
                self._expect((section, q), text, self._effort(q), f"a force, or a torque, at {q}")
        for q, text in c.implicit.items():
            inertia = KILOGRAM if self.checker.names[q] == METRE else INERTIA
            self._expect(("implicit", q), text, times(inertia, SECOND, -1), f"a damping at {q}")
        self._gravity()

    def _effort(self, q: str) -> Dimension:
        """Of a force along a length, or a torque about an angle."""
        return times(times(KILOGRAM if self.checker.names[q] == METRE else INERTIA, self.checker.names[q]), SECOND, -2)

    def _inertia(self, i: int, text: str) -> Dimension | None:
        """Of a diagonal entry; where it was checked before, of the first of its terms."""
        path = ("mass_matrix", i, i)
        if (path, text) not in self.known:
            return self._infer(path, text)
        first = parse(text)
        while isinstance(first, ast.BinOp) and isinstance(first.op, ast.Add | ast.Sub) and constant(first.left) is None:
            first = first.left
        return self.checker.infer(first) or NONE

    def _gravity(self) -> None:
        c = self.config
        for q, point in c.points.items():
            for i, text in enumerate(point):
                self._expect(("points", q, i), text, METRE, "a place", self.places)
        for i, text in enumerate(c.gravity or []):
            if quantity_in(text, ACCELERATION) is None:
                self._expect(("gravity", i), text, ACCELERATION, "an acceleration", self.parameters)
        for q, text in c.payload.items():
            self._expect(("payload", q), text, KILOGRAM, "a mass", self.parameters)
        for q, text in c.tilt.items():
            self._expect(("tilt", q), text, NONE, "an angle", self.parameters)
            if (d := self.checker.names[q]) not in (NONE, METRE):
                found = self.checker.text(d)
                self.found.append((("tilt", q), f"{q} is in {found}; gravity can be turned along angles and lengths", None))

    def _delay(self, path: Path, text: str) -> None:
        seconds = quantity_in(text, SECOND)
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
        elif bad := declarations.unit_problems((*path, "unit"), output.unit):
            self.found += bad
        else:
            self._expect(where, output.expr, units.unit(output.unit)[0], f"the unit of {path[-1]}")

    def _expect(self, path: Path, text: str, wanted: Dimension, what: str, known: Iterable[str] | None = None) -> None:
        if (path, text) not in self.known:
            self._guarded(path, text, lambda tree: self.checker.require(tree, wanted, what), known)

    def _infer(self, path: Path, text: str, known: Iterable[str] | None = None) -> Dimension | None:
        return self._guarded(path, text, lambda tree: self.checker.infer(tree) or NONE, known)

    def _guarded(self, path: Path, text: str, use: Callable[[ast.expr], T], known: Iterable[str] | None = None) -> T | None:
        try:
            tree = parse(text)
            check_names(tree, self.checker.names if known is None else known)
            return use(tree)
        except ExpressionError as error:
            if error.lacking is not None:
                self.lacking.append(error.lacking)
                self.disagreeing = self.disagreeing or ".".join(map(str, path))
            self.found.append((path, str(error), error.offset))
            return None
