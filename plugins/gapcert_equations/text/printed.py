"""A model printed: readable equations with the parameters' values, and LaTeX."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy

from gapcert import Parameter
from gapcert_equations.config import EquationsConfig, OutputConfig, Softness
from gapcert_equations.mechanics.rigid import Terms, terms
from gapcert_equations.thresholds import THRESHOLDS

from .sympy_text import expression, symbol, written


def readable(config: EquationsConfig, parameters: Sequence[Parameter]) -> str:
    """One equation per line, then memories, delays, outputs, parameter values, and how time is stepped."""
    config, carried = _printable(config)
    lines = [f"{left} = {right}" for left, right in _equations(config)] + carried
    lines += [f"|friction({site})| <= {bound}" for site, bound in config.dry_friction.items()]
    lines += [f"friction({q}) gives way: compliance {s.compliance:.6g}, rate {s.rate:.6g}/s" for q, s in _soft(config)]
    lines += [f"damping {d} at {q} is solved with the step" for q, d in config.implicit.items()]
    lines += [f"{z}⁺ = {m.next}" + (f", at first {m.start}" if m.start else "") for z, m in config.memory.items()]
    lines += [f"{u}(t) acts late by {delay}" for u, delay in config.input_delay.items()]
    lines += [f"{y} := {o.expr if isinstance(o, OutputConfig) else o}" for y, o in config.outputs.items()]
    lines += [f"{y}(t) is seen late by {delay}" for y, delay in config.output_delay.items()]
    lines += [_value(p) for p in parameters]
    how = f"period {_quantity(config.period)}"
    if config.scheme:
        how = f"{config.scheme}, {how}" + (f" in {config.substeps} sub-steps" if config.substeps > 1 else "")
    return "\n".join([*lines, f"[{how}]"])


def latex(config: EquationsConfig) -> str:
    """The equations of motion as rows of `align*`."""
    config, carried = _printable(config)

    def show(text: str) -> str:
        return str(sympy.latex(expression(text)))

    def name(x: str) -> str:
        return str(sympy.latex(symbol(x)))

    def friction(site: str) -> str:
        if site not in config.dry_friction:
            return ""
        force = f"f_{{{name(site)}}}"
        return rf" + {force}, \quad |{force}| \le {show(config.dry_friction[site])}"

    rows = []
    if config.bodies is not None:
        for i, q in enumerate(config.coordinates, 1):
            left = rf"\left(M \ddot{{q}} + c\right)_{{{i}}}"
            rows.append(f"{left} &= {show(config.forces.get(q, '0'))}{friction(q)}")
    elif config.form == "mechanical":
        m = _terms(config)
        for q, row, bias, force in zip(config.coordinates, m.mass, m.bias, m.forces, strict=True):
            inertia = [(e, rf"\ddot{{{name(p)}}}") for e, p in zip(row, config.coordinates, strict=True)]
            left = " + ".join(rf"\left({sympy.latex(e)}\right) {a}" for e, a in inertia if e != 0)
            left += f" + {sympy.latex(bias)}" if bias != 0 else ""
            rows.append(f"{left} &= {sympy.latex(force)}{friction(q)}")
    else:
        mark = r"\dot{{{}}}" if config.form == "derivative" else "{}^{{+}}"
        rows = [
            f"{mark.format(name(x))} &= {show(t)}{friction(x)}" for x, t in ((config.derivative or config.next) or {}).items()
        ]
    rows += [rf"& \text{{{line}}}" for line in carried]
    rows += [f"{name(z)}^{{+}} &= {show(m.next)}" for z, m in config.memory.items()]
    return " \\\\\n".join(rows)


def _terms(config: EquationsConfig) -> Terms:
    return terms(config, lambda _, text: expression(text))


def _printable(config: EquationsConfig) -> tuple[EquationsConfig, list[str]]:
    """Payloads and tilts worked into the text of the equations, or as sentences where that would fill pages."""
    if not config.payload and not config.tilt:
        return config, []
    if config.bodies is not None:
        bare: dict[str, Any] = {"tilt": {}}
        return config.model_copy(update=bare), [f"gravity is turned by {angle} along {q}" for q, angle in config.tilt.items()]
    m = _terms(config)
    bare = {"payload": {}, "tilt": {}}
    if sympy.count_ops([*m.bias, *m.forces, *(e for row in m.mass for e in row)]) > THRESHOLDS.printed_operations:
        lines = [f"{m} is carried at ({', '.join(config.points[q])}), the point of {q}" for q, m in config.payload.items()]
        lines += [f"gravity is turned by {angle} along {q}" for q, angle in config.tilt.items()]
        return config.model_copy(update=bare), lines
    texts = {k: dict(zip(config.coordinates, map(written, getattr(m, k)), strict=True)) for k in ("bias", "forces")}
    bias = {q: b for q, b in texts["bias"].items() if b != "0"}
    mass = [[written(e) for e in row] for row in m.mass]
    return config.model_copy(update={**bare, **texts, "bias": bias, "mass_matrix": mass}), []


def _equations(config: EquationsConfig) -> list[tuple[str, str]]:
    def with_friction(right: str, site: str) -> str:
        return f"{right} + friction({site})" if site in config.dry_friction else right

    if config.bodies is not None:
        moved = f"(M({', '.join(config.coordinates)})*ddot + bias)"
        return [(f"{moved}[{q}]", with_friction(config.forces.get(q, "0"), q)) for q in config.coordinates]
    if config.form == "mechanical":
        out = []
        for q, row in zip(config.coordinates, config.mass_matrix or [], strict=True):
            terms = [f"({m})*{p}_ddot" for m, p in zip(row, config.coordinates, strict=True) if m.strip() not in ("0", "0.0")]
            left = " + ".join([*terms, *([f"({config.bias[q]})"] if q in config.bias else [])])
            out.append((left, with_friction(config.forces.get(q, "0"), q)))
        return out
    mark = "{}'" if config.form == "derivative" else "{}[k+1]"
    return [(mark.format(x), with_friction(t, x)) for x, t in ((config.derivative or config.next) or {}).items()]


def _soft(config: EquationsConfig) -> list[tuple[str, Softness]]:
    return [(q, s) for q, s in config.soft_friction.items() if q in config.dry_friction]


def _value(p: Parameter) -> str:
    unit = "" if p.unit == "1" else f" {p.unit}"
    return f"{p.name} = {p.value:.10g}{unit}" + (f" ± {p.tolerance:.4g}{unit}" if p.tolerance else "")


def _quantity(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:g} s"
