"""The `equations` model: one text gives the step, its derivatives and its range over boxes."""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, Context, Interval, MissingDependency, Model, StateSpec, UsageError
from gapcert.plugin import Extension, Step, Values
from gapcert_equations.thresholds import THRESHOLDS

from .build import Definition, define
from .config import EquationsConfig
from .mechanics.dynamics import Prepared
from .programs.arithmetic import ARRAY, INTERVAL, SEEN, Dual, Seen, array_table, dual_table
from .programs.jets import JET, Jet
from .programs.rounding import Rounded, rounded
from .programs.tape import Columns, Table, Tape
from .programs.trace import Program, trace

if TYPE_CHECKING:
    from .programs.machine import Compiled

_CHUNK = 1 << 15


@final
class EquationsModel(Model):
    """x⁺ = f(x, u) from equation text, see EquationsConfig.

    States of kind angle are not wrapped by the step, so that f stays smooth; differences are taken through StateSpec.
    Inputs with a delay d are remembered as hidden states `u_delay_1` (the last period's input), `u_delay_2`, …, by default
    zero, and act as their exact mean over the period, which for d = (k + φ) T is (1 − φ) u₋ₖ + φ u₋₍ₖ₊₁₎. Then come the hidden
    states of the section's `memory`. `jacobian` and the enclosures are those of the step from this default. `forces` act at
    `coordinates`: those of a mechanical model, or the state equations of a `derivative` that are not merely another state, in
    their units.
    """

    def __init__(self, config: EquationsConfig, base: Definition | None = None) -> None:
        self.config = config
        d = self.definition = define(config, base)
        self.states, self.inputs, self.outputs, self.parameters = d.states, d.inputs, d.outputs, d.parameters
        self.period, self.substeps, self.coordinates = d.period, config.substeps, d.sites
        self.capabilities = frozenset({"parameters"})
        if d.sites:
            self.capabilities |= {"forces"}
        late = zip(d.delays.at, d.delays.memory, strict=True) if d.delays else ()
        delayed = [(d.inputs[i], k) for i, memory in late for k in range(1, memory + 1)]
        remembered = tuple(StateSpec(f"{s.name}_delay_{k}", s.unit, s.kind) for s, k in delayed)
        self.hidden, self.hidden_default = (*remembered, *d.memory), ((0.0,) * len(remembered) + d.start)
        self.capabilities |= {"hidden"} if d.delays or d.memory else set()
        self.remembers = any(m.name != "time" for m in d.memory)
        # A single row is computed with numbers: the same bits as with arrays in a fraction of the time, but for powers, whose
        # exponents 2 or 1/2 NumPy treats apart where they are numbers.
        self._plain = not any(name == "power" for part in d.recorder.code.values() for name, _, _ in part)
        self._constant: dict[tuple[np.float64, ...], Array] = {}

    @classmethod
    def from_config(cls, config: EquationsConfig, context: Context) -> EquationsModel:
        """Where the section has no period, that of the recording. What the context's model has recorded is shared."""
        if config.period is None and context.period is not None:
            # Nine digits: a difference of recorded times carries rounding that is no part of the period.
            config = config.model_copy(update={"period": f"{context.period:.9g} s"})
        return cls(config, context.model.definition if isinstance(context.model, EquationsModel) else None)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, EquationsModel) and self.digest() == other.digest()

    def __hash__(self) -> int:
        return hash(self.digest())

    def digest(self) -> str:
        """Of the section."""
        return hashlib.sha256(b"gapcert_equations\n" + json.dumps(self.to_spec(), ensure_ascii=False).encode()).hexdigest()

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        overrides, hidden, forces = options.get("parameters"), options.get("hidden"), options.get("forces")
        fixed = self._fix(ARRAY, overrides) if overrides else self._stated
        past = None if hidden is None else self._split(hidden)
        kicks: Any = None
        if forces is not None:
            kicks = forces[0] if self._lone(len(x)) else np.ascontiguousarray(np.moveaxis(forces, 0, -1))
        with np.errstate(all="ignore"):
            new, past = self._columns(ARRAY, fixed, self._split(x), self._split(u), past, kicks)
        return Step(_stacked(new, len(x)), None if past is None else _stacked(past, len(x)))

    def _lone(self, n: int) -> bool:
        return n == 1 and self._plain

    def _split(self, rows: Array) -> Columns:
        """(n, columns) as columns, or numbers."""
        return list(rows[0]) if self._lone(len(rows)) else _split(rows)

    def _rollout(self, x0: Array, u_sequence: Array, **options: Any) -> Step:
        n, steps, _ = u_sequence.shape
        if options["forces"] is not None or options["seed"] is not None or n == 0 or not np.isfinite(u_sequence).all():
            return super()._rollout(x0, u_sequence, **options)
        checked = self._options(n, {k: options[k] for k in ("hidden", "parameters")})
        fixed = self._fix(ARRAY, checked["parameters"]) if checked.get("parameters") else self._stated
        past = self._split(checked["hidden"]) if "hidden" in checked else None
        inputs = u_sequence[0] if self._lone(n) else np.ascontiguousarray(u_sequence.transpose(1, 2, 0))
        out = np.empty((steps + 1, self.nx, n))
        out[0], rows = x0.T, out[..., 0] if self._lone(n) else out
        with np.errstate(all="ignore"):
            for k in range(steps):
                new, past = self._columns(ARRAY, fixed, list(rows[k]), list(inputs[k]), past)
                for j, column in enumerate(new):
                    out[k + 1, j] = column
        if not np.isfinite(out).all():
            return super()._rollout(x0, u_sequence, **options)
        return Step(np.ascontiguousarray(out.transpose(2, 0, 1)), None if past is None else _stacked(past, n))

    def fast_rollout(
        self, x0: Array, u: Array, *, parameters: Values | None = None, hidden: Array | None = None, every: int = 1
    ) -> Step:
        """By the compiled interpreter where numba is installed, else as every model does it."""
        if (compiled := self._compiled) is None:
            return super().fast_rollout(x0, u, parameters=parameters, hidden=hidden, every=every)
        return compiled.rollout(x0, u, parameters or {}, hidden, every)

    def along(self, x: Array, u: Array, *, parameters: Values | None = None, hidden: Array | None = None) -> Array:
        """By the compiled interpreter where numba is installed, else as every model does it."""
        if not x.size or (compiled := self._compiled) is None:
            return super().along(x, u, parameters=parameters, hidden=hidden)
        return np.asarray(compiled.rollout(x[:, 0], u, parameters or {}, hidden, path=x).x[:, 1:])

    def fast_memories(self, path: Array, u: Array, stops: Sequence[int], parameters: Values, hidden: Array) -> Array | None:
        """By the compiled interpreter where numba is installed."""
        return None if (compiled := self._compiled) is None else compiled.memories(path, u, stops, parameters, hidden)

    def held_memories(self, x: Array, u: Array, steps: int, parameters: Values, hidden: Array) -> Array | None:
        """By the compiled interpreter where numba is installed."""
        return None if (compiled := self._compiled) is None else compiled.held(x, u, steps, parameters, hidden)

    @cached_property
    def _compiled(self) -> Compiled | None:
        if importlib.util.find_spec("numba") is None:
            return None
        from .programs.machine import Compiled

        return Compiled(self.program, self.nx, self.nu, self.substeps, self.parameters, self.hidden_default, self.late)

    @cached_property
    def program(self) -> Program:
        """One sub-step for the compiled interpreter."""
        d = self.definition
        known, key = d.recorder.programs, (d.texts, d.dynamics.stepping)
        program: Program = known.get(key) or trace(d.dynamics, len(self.parameters), self.nx, self.nu, len(d.memory))
        known[key] = program
        return program

    def jacobian(self, x: Array, u: Array) -> Array:
        """∂x⁺/∂(x, u) from the derivatives of the expressions, through the integrator."""
        x, u = self._batch("x", x, self.nx), self._batch("u", u, self.nu)
        out = np.zeros((len(x), self.nx, self.nx + self.nu))
        for i, row in enumerate(self._slopes(ARRAY, self._stated, _split(np.concatenate([x, u], axis=1)))):
            for j, slope in row.items():
                out[:, i, j] = slope
        return out

    def enclosure(self, z: Interval) -> Interval:
        """Natural extension; of boxes, intersected with the mean-value form f(c) + J(z) (z − c) where J is to be had."""
        return Interval.concatenate([self._enclose(z[k : k + _CHUNK]) for k in range(0, max(len(z), 1), _CHUNK)])

    def jacobian_enclosure(self, z: Interval) -> Interval:
        """The same derivatives in interval arithmetic."""
        if self.definition.dynamics.coupled_friction:
            raise UsageError(
                "model: dry friction at coordinates that the mass matrix couples has no bound on its derivative; "
                "use a diagonal mass_matrix, or a Lipschitz constant that is estimated or declared"
            )
        return Interval.concatenate([self._derivative(z[k : k + _CHUNK]) for k in range(0, max(len(z), 1), _CHUNK)])

    def constant_slopes(self, u: Array | None = None) -> Array | None:
        """Slopes that are no columns depend on parameters alone. They are kept with the model."""
        if self.definition.dynamics.coupled_friction:
            return None
        at, nz = () if u is None else tuple(np.asarray(u, dtype=np.float64)), self.nx + self.nu
        if at not in self._constant:
            rows = self._slopes(ARRAY, self._stated, [np.ones(1)] * (nz - len(at)) + list(at))
            found = [[v if np.ndim(v := row.get(j, 0.0)) == 0 else np.nan for j in range(nz)] for row in rows]
            self._constant[at] = np.array(found)
        return self._constant[at].copy()

    def unmoved(self, u: Array) -> npt.NDArray[np.bool_]:
        """By the zeros among the inputs; nothing is known where something is remembered, or where friction is."""
        if self.hidden or not self.definition.dynamics.frictionless:
            return super().unmoved(u)
        patterns, which = np.unique(u == 0, axis=0, return_inverse=True)
        found = np.empty((len(patterns), self.nx), dtype=bool)
        for row, zeros in zip(found, patterns, strict=True):
            x = [Seen() for _ in range(self.nx)]
            after = self._from_default(SEEN, self._stated, [*x, *(Seen(bool(zero)) for zero in zeros)])
            row[:] = [a is b for a, b in zip(after, x, strict=True)]
        return found[which.reshape(-1)]

    def repeats(self, angle: str) -> str:
        """By what a turn does to each operation of the step, through the integrator, to x⁺ and to what is remembered."""
        from .programs.winding import WINDING, Winding, unrepeated

        x = [Winding(float(s.name == angle)) for s in self.states]
        past = [Winding() for _ in self.hidden] if self.hidden else None
        new, kept = self._columns(WINDING, self._stated, x, [Winding() for _ in self.inputs], past)
        after = zip((*self.states, *self.hidden), [*new, *(kept or [])], strict=True)
        return next((why for spec, value in after if (why := unrepeated(spec, value, angle))), "")

    def curvature_enclosure(self, z: Interval, axis: int) -> Interval:
        """Derivatives of second order in interval arithmetic; the whole line where a box may hold a kink."""
        if self.definition.dynamics.coupled_friction:
            return super().curvature_enclosure(z, axis)
        return Interval.concatenate([self._bend(z[k : k + _CHUNK], axis) for k in range(0, max(len(z), 1), _CHUNK)])

    def rounding_over(self, z: Interval) -> Array | None:
        """A running error analysis of the step, whatever evaluates it; None where friction is found by sweeps."""
        if self.definition.dynamics.coupled_friction:
            return None
        parts = [z[k : k + _CHUNK] for k in range(0, max(len(z), 1), _CHUNK)]
        return np.concatenate([_stacked([c.error for c in self._rounded(part)], len(part)) for part in parts])

    def rounding_terms(self, z: Interval) -> tuple[str, ...]:
        """By the same analysis."""
        return tuple(c.cause[1] for c in self._rounded(z))

    def _rounded(self, z: Interval) -> list[Rounded]:
        parameters = [Rounded.exact(p.value, p.name) for p in self.parameters]
        axes = (*self.states, *self.inputs)
        columns = [Rounded.exact(z[:, j], s.name) for j, s in enumerate(axes)]
        past = [Rounded.exact(v) for v in self.hidden_default] if "hidden" in self.capabilities else None
        acting, _, known = self._acting(self._stated, columns[self.nx :], past)
        with np.errstate(all="ignore"):
            return rounded(self.definition.dynamics, parameters, columns[: self.nx], acting, known)

    def output(self, x: Array, u: Array, parameters: Values | None = None, hidden: Array | None = None) -> Array:
        """`outputs` of the section; by default the state. parameters: a number each, or one per row; hidden: default zero."""
        tape = self.definition.output
        if tape is None:
            return x
        with np.errstate(all="ignore"):
            known = [*self._values(parameters), self.definition.dynamics.substep(ARRAY)]
            count = len(self.definition.memory)
            seen = [np.float64(0)] * count if hidden is None else _split(hidden)[len(self.hidden) - count :]
            values = tape.run(ARRAY, tape.prepare(ARRAY, known), [*_split(np.concatenate([x, u], axis=1)), *seen])
        return _stacked([0.0 if v is None else v for v in values], len(x))

    def input_delays(self, parameters: Values | None = None) -> Array:
        """Of inputs that outputs show through what they drive; an output that reports a command is not late."""
        late = self.late(self._values(parameters)) if any(self.definition.shown) else []
        out = np.zeros((*np.broadcast_shapes(*(np.shape(d) for _, _, d in late)), self.nu))
        for i, _, periods in late:
            out[..., i] = periods * self.period if self.definition.shown[i] else 0.0
        return out

    def output_delays(self, parameters: Values | None = None) -> Array:
        """Seconds by which each output shows the past, at the given values of parameters: (ny,), or (n, ny)."""
        late, values = self.definition.output_delays, self._values(parameters)
        out = np.zeros((*np.broadcast_shapes(*map(np.shape, values)), len(self.outputs)))
        if late is not None:
            for y, seconds in zip(late.at, self._of_parameters(late.tape, values), strict=True):
                out[..., y] = 0.0 if seconds is None else np.maximum(seconds, 0.0)
        return out

    def _values(self, given: Values | None) -> Columns:
        """Of the parameters: as stated, or as given, a number each or one per row."""
        known = {k: np.asarray(v, dtype=np.float64) for k, v in (given or {}).items()}
        return [known.get(p.name, np.float64(p.value)) for p in self.parameters]

    def extend(self, extensions: Sequence[Extension]) -> EquationsModel:
        """A model whose section has the effects written into its expressions."""
        from .extend import extended

        return EquationsModel(extended(self.config, extensions), self.definition)

    def sites(self, kind: str) -> tuple[str, ...]:
        """Coordinates take forces; inputs, outputs and parameters are sites by name."""
        found = {
            "coordinate": self.coordinates,
            "input": tuple(u.name for u in self.inputs),
            "output": tuple(y.name for y in self.outputs),
            "parameter": tuple(p.name for p in self.parameters),
            "contact": (),
        }
        if kind not in found:
            raise UsageError(f"sites: unknown kind '{kind}'; expected one of {', '.join(found)}")
        return found[kind]

    def force_unit(self, site: str) -> str | None:
        """Of the force at a coordinate of a mechanical model."""
        from .text.expressions import force_unit

        return force_unit(self.config, site) if site in self.config.coordinates else None

    def equations(self) -> str:
        """The section as readable equations, with the values of the parameters."""
        from .text.printed import readable

        return readable(self.config, self.parameters)

    def latex(self) -> str:
        """The equations as a LaTeX `align*` body."""
        from .text.printed import latex

        return latex(self.config)

    def to_spec(self) -> dict[str, Any]:
        """The section, without defaults."""
        return self.config.model_dump(mode="json", exclude_defaults=True)

    def jax(self) -> Callable[[Any, Any], Any]:
        """(x, u) → x⁺ compiled by JAX in float64, which is switched on for the call only; MissingDependency without JAX."""
        if importlib.util.find_spec("jax") is None:
            raise MissingDependency("model: the JAX twin needs jax, which is not installed; run: pip install 'gapcert[jax]'")
        if self.hidden:
            raise UsageError("model: the JAX twin has no hidden state; remove input_delay and memory")
        import jax

        table = array_table(jax.numpy)

        def step(x: Any, u: Any) -> Any:
            columns, _ = self._columns(table, self._stated, list(x.T), list(u.T), None)
            return jax.numpy.stack([jax.numpy.broadcast_to(c, x.shape[:1]) for c in columns], axis=1)

        compiled = jax.jit(step)

        def call(x: Any, u: Any) -> Any:
            with jax.enable_x64(True):
                return compiled(jax.numpy.asarray(x, dtype="float64"), jax.numpy.asarray(u, dtype="float64"))

        return call

    @cached_property
    def _stated(self) -> _Fixed:
        return self._fix(ARRAY, None)

    def _fix(self, table: Table, overrides: Mapping[str, Array] | None) -> _Fixed:
        """What depends on parameters alone; parameters are (n,) arrays where overridden."""
        given = overrides or {}
        floats = [self._split(given[p.name][:, None])[0] if p.name in given else np.float64(p.value) for p in self.parameters]
        values = [Interval.exact(v) for v in floats] if table is INTERVAL else floats
        with np.errstate(all="ignore"):
            return _Fixed(values, self.definition.dynamics.prepare(table, values), self._weights(floats))

    def _of_parameters(self, tape: Tape, parameters: Columns) -> Columns:
        """The answers of a tape without columns."""
        return tape.run(ARRAY, tape.prepare(ARRAY, [*parameters, self.definition.dynamics.substep(ARRAY)]), [])

    def late(self, parameters: Columns) -> list[tuple[int, int, Any]]:
        """(input, remembered periods, delay in periods) of late inputs, at values of the parameters."""
        delays = self.definition.delays
        if delays is None:
            return []
        out = []
        for i, memory, delay in zip(delays.at, delays.memory, self._of_parameters(delays.tape, parameters), strict=True):
            ratio = np.maximum(0.0 if delay is None else delay, 0.0) / self.period
            ratio = np.where(np.abs(ratio - np.round(ratio)) < THRESHOLDS.whole_ratio, np.round(ratio), ratio)
            if not (ratio <= memory).all():
                longest = f"model.input_delay.{self.inputs[i].name}: {float(np.max(ratio)) * self.period:g} s"
                raise UsageError(f"{longest} is longer than {memory} periods; give its parameter a bound `high` that covers it")
            out.append((i, memory, ratio))
        return out

    def _weights(self, parameters: Columns) -> list[tuple[int, int, list[Any]]]:
        """(input, memory, weight of each remembered period) of late inputs: the hat function max(0, 1 − |k − d / T|)."""
        late = self.late(parameters)
        return [(i, memory, [np.maximum(0.0, 1.0 - np.abs(k - d)) for k in range(memory + 1)]) for i, memory, d in late]

    def _columns(
        self, table: Table, fixed: _Fixed, x: Columns, u: Columns, past: Columns | None, forces: Any = None
    ) -> tuple[Columns, Columns | None]:
        """One step of any number type: x⁺, and the hidden states to hand on: late inputs, then memories."""
        acting, remembered, known = self._acting(fixed, u, past)
        x, z = self.definition.dynamics.step(table, fixed.prepared, x, acting, known, forces)
        return x, None if past is None else [*remembered, *z]

    def _acting(self, fixed: _Fixed, u: Columns, past: Columns | None) -> tuple[Columns, Columns, Columns]:
        """(inputs as they act, late inputs to hand on, memories)."""
        acting, remembered, known = list(u), [], past or []
        for i, memory, weights in fixed.weights if past is not None else ():
            line, known = [u[i], *known[:memory]], known[memory:]
            remembered += line[:memory]
            terms = [w * v for w, v in zip(weights, line, strict=True)]
            acting[i] = sum(terms[1:], terms[0])
        return acting, remembered, known

    def _from_default(self, table: Table, fixed: _Fixed, z: Columns) -> Columns:
        past = [table["number"](v, 1) for v in self.hidden_default] if "hidden" in self.capabilities else None
        return self._columns(table, fixed, z[: self.nx], z[self.nx :], past)[0]

    def _slopes(self, base: Table, fixed: _Fixed, z: Columns) -> list[dict[int, Any]]:
        """∂x⁺_i/∂z_j that are not structurally zero."""
        one = base["number"](1, 1)
        with np.errstate(all="ignore"):
            new = self._from_default(dual_table(base), fixed, [Dual(c, {j: one}) for j, c in enumerate(z)])
        return [c.slopes if isinstance(c, Dual) else {} for c in new]

    def _enclose(self, z: Interval) -> Interval:
        n = len(z)
        natural = _boxes(self._from_default(INTERVAL, self._exact, [z[:, j] for j in range(z.shape[1])]), n)
        if self.definition.dynamics.coupled_friction or np.array_equal(z.lo, z.hi):
            return natural
        c = z.mid
        centre = _boxes(self._from_default(INTERVAL, self._exact, [Interval.exact(c[:, j]) for j in range(z.shape[1])]), n)
        return natural.intersect(centre + Interval.dot(self._derivative(z), (z - c)[:, None, :]))

    def _derivative(self, z: Interval) -> Interval:
        out = Interval(np.zeros((len(z), self.nx, z.shape[1])), np.zeros((len(z), self.nx, z.shape[1])))
        for i, row in enumerate(self._slopes(INTERVAL, self._exact, [z[:, j] for j in range(z.shape[1])])):
            for j, slope in row.items():
                out.lo[:, i, j], out.hi[:, i, j] = slope.lo, slope.hi
        return out

    def _bend(self, z: Interval, axis: int) -> Interval:
        columns: Columns = [z[:, j] for j in range(z.shape[1])]
        columns[axis] = Jet(columns[axis], INTERVAL["number"](1, 1))
        with np.errstate(all="ignore"):
            new = [c.bend if isinstance(c, Jet) else None for c in self._from_default(JET, self._exact, columns)]
        return _boxes([Interval.exact(0.0) if b is None else b for b in new], len(z))

    @cached_property
    def _exact(self) -> _Fixed:
        return self._fix(INTERVAL, None)


@final
@dataclass(frozen=True)
class _Fixed:
    """What a step needs that does not depend on states and inputs."""

    values: Columns
    prepared: Prepared
    weights: list[tuple[int, int, list[Any]]]


def _split(rows: Array) -> Columns:
    """(n, columns) as contiguous columns."""
    return list(np.ascontiguousarray(rows.T))


def _stacked(columns: Columns, n: int) -> Array:
    """Columns, some of them constant, as (n, columns)."""
    out = np.empty((n, len(columns)))
    for j, c in enumerate(columns):
        out[:, j] = c
    return out


def _boxes(columns: Columns, n: int) -> Interval:
    """Columns of Intervals."""
    return Interval(_stacked([c.lo for c in columns], n), _stacked([c.hi for c in columns], n))
