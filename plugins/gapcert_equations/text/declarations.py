"""What a section declares, axes, sites and dimensions; and all that can be wrong with it: names, units, numbers, keys."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from gapcert_equations.config import Axes, Axis, EquationsConfig, MemoryConfig, ParameterConfig, Problem, PythonConfig

from . import grammar, units
from .grammar import name_problem, near, parse
from .units import NONE, SECOND, Dimension

Path = tuple[str | int, ...]


def axes(declared: Axes) -> dict[str, Axis]:
    """Short and long declarations alike, `rad` and `{unit: rad}`; an empty unit is 1."""
    long = {name: Axis(unit=a) if isinstance(a, str) else a for name, a in declared.items()}
    return {name: a if a.unit.strip() else a.model_copy(update={"unit": "1"}) for name, a in long.items()}


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


def substep(config: EquationsConfig) -> str:
    """The name of the sub-step in s: `h`, followed by as many _ as it takes where the model has an `h` of its own."""
    name, taken = "h", {*states(config), *config.inputs, *config.parameters, *config.memory}
    while name in taken:
        name += "_"
    return name


def shown(config: EquationsConfig) -> tuple[str, ...]:
    """Outputs that show inputs through the plant: what of inputs and numbers alone is made reports what was commanded."""
    texts = {y: o if isinstance(o, str) else o.expr for y, o in config.outputs.items()}
    return tuple(y for y, text in texts.items() if {n for n, _ in grammar.names(parse(text))} - set(config.inputs))


def parameter_dimension(value: float | str | ParameterConfig) -> Dimension:
    """The dimension of a stated value; none of a bare number."""
    return units.unit(units.quantity(value.value if isinstance(value, ParameterConfig) else value)[1])[0]


def agree(config: EquationsConfig, known: EquationsConfig) -> bool:
    """Does every name of another section mean the same in this one? Both are declared without problems."""
    sections = ("states", "coordinates", "inputs", "mass_matrix")
    if substep(config) != substep(known) or any(getattr(config, s) != getattr(known, s) for s in sections):
        return False
    memory = [(m.unit, own.unit if (own := config.memory.get(z)) else None) for z, m in known.memory.items()]
    stated = [(p, config.parameters.get(n)) for n, p in known.parameters.items()]
    return all(a == b for a, b in memory) and all(
        a is b or (b is not None and parameter_dimension(a) == parameter_dimension(b)) for a, b in stated
    )


def quantity_in(text: str, wanted: Dimension) -> float | None:
    """The coherent number of a quantity such as `12 ms`; None where the text is an expression of parameters."""
    try:
        number, given = units.quantity(text)
        dimension, factor = units.unit(given) if given else (NONE, 1.0)
    except ValueError:
        return None
    return units.convert(number, factor) if dimension == wanted else None


def problems(config: EquationsConfig) -> list[Problem]:
    """Problems of names, units, quantities and keys of an equations model."""
    base = config.coordinates or config.states
    found = list(_declarations(base, config.inputs, config.parameters, config.period, velocities(config), config.memory))
    return [*found, *_keys(config)]


def python_problems(config: PythonConfig) -> list[Problem]:
    """Problems of names, units and quantities of a python model."""
    return list(_declarations(config.states, config.inputs, config.parameters, config.period, {}, {}))


def _declarations(
    states_: Axes,
    inputs: Axes,
    parameters: Mapping[str, float | str | ParameterConfig],
    period: float | str | None,
    derived: Mapping[str, Axis],
    memory: Mapping[str, MemoryConfig],
) -> Iterator[Problem]:
    seen = dict.fromkeys(derived, "velocities")
    first = "coordinates" if derived else "states"
    named: Sequence[tuple[str, Mapping[str, Any]]]
    named = ((first, states_), ("inputs", inputs), ("parameters", parameters), ("memory", memory))
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
            yield from unit_problems(path, axis.unit)
    for name, m in memory.items():
        yield from unit_problems(("memory", name, "unit"), m.unit) or _start(("memory", name, "start"), m)
    for name, value in parameters.items():
        yield from _parameter(("parameters", name), value)
    if period is not None:
        yield from _period(period)


def unit_problems(path: Path, text: str) -> list[Problem]:
    """Why a unit cannot be used for a state, an input or an output."""
    try:
        units.coherent(text)
    except ValueError as error:
        return [(path, str(error), None)]
    return []


def _start(path: Path, memory: MemoryConfig) -> Iterator[Problem]:
    try:
        _, text = units.quantity(memory.start)
        if text and units.unit(text)[0] != units.unit(memory.unit)[0]:
            yield path, f"found '{memory.start}'; expected {memory.unit}", None
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
        if config.bodies is not None:
            yield from _tree(config)
        elif len(rows) != n or any(len(r) != n for r in rows):
            shape = f"{len(rows)} rows of {sorted({len(r) for r in rows})} entries"
            yield ("mass_matrix",), f"found {shape}; expected {n} x {n} for coordinates {', '.join(config.coordinates)}", None
        yield from _unknown("bias", config.bias, config.coordinates)
        for section in ("forces", "soft_friction", "implicit"):
            yield from _unknown(section, getattr(config, section), config.coordinates)
        if config.implicit and config.scheme == "rk4":
            yield ("implicit",), "rk4 takes no damping with the step; use semi_implicit or euler", None
    yield from _unknown("dry_friction", config.dry_friction, sites(config))
    yield from _unknown("input_delay", config.input_delay, config.inputs)
    yield from _unknown("output_delay", config.output_delay, config.outputs or states(config))
    yield from _unknown("tilt", config.tilt, config.coordinates)
    yield from _unknown("points", config.points, config.coordinates)
    for q in config.payload:
        if q not in config.points:
            yield ("payload", q), f"there is no point of {q}; add points: {{{q}: [x, y]}}, in m", None
    sizes = {len(p) for p in config.points.values()} | ({len(config.gravity)} if config.gravity else set())
    if len(sizes) > 1 or not sizes <= {2, 3}:
        found = " and ".join(map(str, sorted(sizes)))
        yield ("points",), f"found points and gravity of {found} components; expected 2 or 3, for all alike", None


def _tree(config: EquationsConfig) -> Iterator[Problem]:
    """Every coordinate moves one body, and a body stands after the one that carries it."""
    earlier: list[str] = []
    moved: dict[str, str] = {}
    for name, body in (config.bodies or {}).items():
        if body.on is not None and body.on not in earlier:
            yield ("bodies", name, "on"), f"'{body.on}' is no body above this one; {near(body.on, earlier)}", None
        if body.joint is None:
            pass
        elif body.joint not in config.coordinates:
            yield ("bodies", name, "joint"), f"'{body.joint}' is no coordinate; {near(body.joint, config.coordinates)}", None
        elif body.joint in moved:
            yield ("bodies", name, "joint"), f"{body.joint} moves '{moved[body.joint]}' already; give each body its own", None
        if body.joint is not None:
            moved.setdefault(body.joint, name)
        earlier.append(name)
    for q in config.coordinates:
        if q not in moved:
            yield ("bodies",), f"no body is moved by {q}; add one with joint: {q}", None
    if config.gravity is not None and len(config.gravity) != 3:
        yield ("gravity",), f"found {len(config.gravity)} components; expected 3", None


def _unknown(section: str, given: Iterable[str], known: Iterable[str]) -> Iterator[Problem]:
    known = list(known)
    for name in given:
        if name not in known:
            yield (section, name), f"'{name}' does not belong here; {near(name, known)}", None
