"""What a section declares: axes in their long form, velocities, sites of forces, dimensions of numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from gapcert_equations.config import Axis, EquationsConfig, ParameterConfig

from . import units
from .units import NONE, Dimension

if TYPE_CHECKING:
    from gapcert_equations.config import Axes


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


def substep(config: EquationsConfig) -> str:
    """The name of the sub-step in s: `h`, followed by as many _ as it takes where the model has an `h` of its own."""
    name, taken = "h", {*states(config), *config.inputs, *config.parameters, *config.memory}
    while name in taken:
        name += "_"
    return name


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
