"""A model printed: readable equations with the parameters' values, and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gapcert import Parameter
from gapcert_equations import checks
from gapcert_equations.config import EquationsConfig, OutputConfig
from gapcert_equations.symbolic import expression, symbol


def readable(config: EquationsConfig, parameters: Sequence[Parameter]) -> str:
    """One equation per line, then delays, outputs, parameter values, and how time is stepped."""
    lines = [f"{left} = {right}" for left, right in _equations(config)]
    lines += [f"|friction({site})| <= {bound}" for site, bound in config.dry_friction.items()]
    lines += [f"{u}(t) acts late by {delay}" for u, delay in config.input_delay.items()]
    lines += [f"{y} := {o.expr if isinstance(o, OutputConfig) else o}" for y, o in config.outputs.items()]
    lines += [_value(p) for p in parameters]
    how = f"period {_quantity(config.period)}"
    if config.scheme:
        how = f"{config.scheme}, {how}" + (f" in {config.substeps} sub-steps" if config.substeps > 1 else "")
    return "\n".join([*lines, f"[{how}]"])


def latex(config: EquationsConfig) -> str:
    """The equations of motion as rows of `align*`."""
    import sympy

    names = [*checks.states(config), *config.inputs, *config.parameters]
    symbols = {n: symbol(n) for n in names}

    def show(text: str) -> str:
        return str(sympy.latex(expression(text, symbols)))

    def name(x: str) -> str:
        return str(sympy.latex(symbols[x]))

    def friction(site: str) -> str:
        if site not in config.dry_friction:
            return ""
        force = f"f_{{{name(site)}}}"
        return rf" + {force}, \quad |{force}| \le {show(config.dry_friction[site])}"

    rows = []
    if config.form == "mechanical":
        for q, row in zip(config.coordinates, config.mass_matrix or [], strict=True):
            inertia = [(expression(e, symbols), rf"\ddot{{{name(p)}}}") for e, p in zip(row, config.coordinates, strict=True)]
            left = " + ".join(rf"\left({sympy.latex(e)}\right) {a}" for e, a in inertia if e != 0)
            left += f" + {show(config.bias[q])}" if q in config.bias else ""
            rows.append(f"{left} &= {show(config.forces.get(q, '0'))}{friction(q)}")
    else:
        mark = r"\dot{{{}}}" if config.form == "derivative" else "{}^{{+}}"
        rows = [
            f"{mark.format(name(x))} &= {show(t)}{friction(x)}" for x, t in ((config.derivative or config.next) or {}).items()
        ]
    return " \\\\\n".join(rows)


def _equations(config: EquationsConfig) -> list[tuple[str, str]]:
    def with_friction(right: str, site: str) -> str:
        return f"{right} + friction({site})" if site in config.dry_friction else right

    if config.form == "mechanical":
        out = []
        for q, row in zip(config.coordinates, config.mass_matrix or [], strict=True):
            terms = [f"({m})*{p}_ddot" for m, p in zip(row, config.coordinates, strict=True) if m.strip() not in ("0", "0.0")]
            left = " + ".join([*terms, *([f"({config.bias[q]})"] if q in config.bias else [])])
            out.append((left, with_friction(config.forces.get(q, "0"), q)))
        return out
    mark = "{}'" if config.form == "derivative" else "{}[k+1]"
    return [(mark.format(x), with_friction(t, x)) for x, t in ((config.derivative or config.next) or {}).items()]


def _value(p: Parameter) -> str:
    unit = "" if p.unit == "1" else f" {p.unit}"
    return f"{p.name} = {p.value:.10g}{unit}" + (f" ± {p.tolerance:.4g}{unit}" if p.tolerance else "")


def _quantity(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g} s"
