"""Basis functions over named axes: products of one-dimensional factors where they are such, else expressions."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Any

import numpy as np

from gapcert import Domain, UsageError
from gapcert_functions import Expression, Factor, Term

from .grammar import MalformedError, Node, read


def parse(text: str, axes: Sequence[str]) -> Term | Expression:
    """The function that `text` writes over named axes; UsageError where it is outside the grammar or names no axis."""
    try:
        node = read(text)
    except MalformedError as error:
        raise UsageError(f"gap.functions: '{text}': {error}") from None
    tree = _tree(node, text, axes)
    factors = [_factors(part, axes) for part in (node.parts if node.op == "*" else (node,))]
    if any(f is None for f in factors):
        return Expression(text.strip(), tree)
    return Term(text.strip(), _merged([f for part in factors for f in part or ()]))


def bounded(texts: Sequence[str], domain: Domain) -> list[Term | Expression]:
    """The functions that texts write; UsageError where one, or its slope, is not bounded on the domain's box."""
    terms = [parse(text, [a.name for a in domain.axes]) for text in texts]
    for term in terms:
        if not np.isfinite(term.error(domain.interval)):
            raise UsageError(
                f"gap.functions: '{term.text}' or a slope in it is unbounded on the domain's box, or not defined there "
                f"(sqrt and log need positive arguments); change the function, or make the domain smaller"
            )
    return terms


def _tree(node: Node, text: str, axes: Sequence[str]) -> Any:
    if node.op == "number":
        return node.number
    if node.op == "axis":
        if node.name not in axes:
            near = difflib.get_close_matches(node.name, axes, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(axes)}"
            raise UsageError(f"gap.functions: '{text}': '{node.name}' is no state or input; {hint}")
        return ["axis", list(axes).index(node.name)]
    parts = [_tree(part, text, axes) for part in node.parts]
    return [node.op, *parts, int(node.number)] if node.op == "^" else [node.op, *parts]


def _factors(node: Node, axes: Sequence[str]) -> list[Factor] | None:
    """axis^n, abs(axis)^n, sin(a axis)^n or cos(a axis)^n as factors, the number 1 as none; None for anything else."""
    if node.op == "number":
        return []
    power, base = (int(node.number), node.parts[0]) if node.op == "^" else (1, node)
    if base.op == "axis":
        return [Factor(axes.index(base.name), "power", power)]
    if base.op not in ("abs", "sin", "cos"):
        return None
    inner, scale = base.parts[0], 1.0
    if base.op != "abs" and inner.op == "*" and [p.op for p in inner.parts] == ["number", "axis"]:
        scale, inner = inner.parts[0].number, inner.parts[1]
    if inner.op != "axis" or scale < 0:
        return None
    axis = axes.index(inner.name)
    if base.op == "abs":
        return [Factor(axis, "abs", power)]
    return [Factor(axis, "sin" if base.op == "sin" else "cos", scale)] * power


def _merged(factors: Sequence[Factor]) -> tuple[Factor, ...]:
    """Powers of one axis as one power: x · x alone would range over negative numbers as well."""
    powers: dict[tuple[int, str], float] = {}
    waves = [f for f in factors if f.kind in ("sin", "cos")]
    for f in factors:
        if f.kind in ("power", "abs"):
            powers[f.axis, f.kind] = powers.get((f.axis, f.kind), 0) + f.number
    merged = [Factor(axis, "abs" if kind == "abs" else "power", n) for (axis, kind), n in powers.items()]
    return (*merged, *waves)
