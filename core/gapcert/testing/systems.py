"""The contract that every System keeps, as named checks, and a small System that keeps it."""

from __future__ import annotations

import contextlib
import itertools
import pickle
import subprocess
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, final

import numpy as np

from gapcert.certification.gates.purity import Queries, apart, contexts, held, laddered
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.systems.system import Parameter, StateSpec, Step, System, step_seed
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError
from gapcert.testing.checks import expect

_ELSEWHERE = """
import pickle, sys
sys.path[:] = pickle.load(sys.stdin.buffer)
system, x, u, options = pickle.load(sys.stdin.buffer)
out = system.step(x, u, **options)
sys.stdout.flush()
sys.__stdout__.buffer.write(b"\\0answer" + pickle.dumps((out.x, out.hidden, system.digest())))
"""


class SystemContract(ABC):
    """Subclass in a test module as `Test…` and supply `system`: pytest then runs every `test_…` below on it.

    `domain` says where to query (default: every number within ±1); override `points` where boxes do not fit the states.
    Checks of a capability that the System does not declare pass. A stochastic System is compared under one seed, and only
    in one order.
    """

    rows = 21

    @abstractmethod
    def system(self) -> System:
        """A new System, built as a user would build it."""

    def domain(self, system: System) -> Domain:
        """Where the System can be queried."""
        return Domain.of(system, dict.fromkeys((a.name for a in (*system.states, *system.inputs)), (-1.0, 1.0)))

    def points(self, system: System) -> tuple[Array, Array]:
        """x (rows, nx) and u (rows, nu) to query."""
        domain = self.domain(system)
        x, u = domain.split(domain.draw(self.rows, np.random.default_rng(7)))
        return np.ascontiguousarray(x), np.ascontiguousarray(u)

    def test_describes_itself(self) -> None:
        s = self.system()
        names = [a.name for a in (*s.states, *s.inputs)]
        expect(
            len(names) == len(set(names)) and bool(s.states), f"names of states and inputs are {names}; expected distinct ones"
        )
        expect(np.isfinite(s.period) and s.period > 0, f"period is {s.period}; expected a positive number of seconds")
        expect(isinstance(s.substeps, int) and s.substeps >= 1, f"substeps is {s.substeps}; expected a positive integer")
        nh = sum(h.size for h in s.hidden)
        expect(len(s.hidden_default) == nh, f"hidden_default has {len(s.hidden_default)} numbers; expected {nh}")
        for option, declared in (("hidden", s.hidden), ("parameters", s.parameters)):
            expect(
                (option in s.capabilities) == bool(declared), f"'{option}' is declared without anything in it, or the reverse"
            )
        expect("forces" not in s.capabilities or bool(s.coordinates), "'forces' is declared without coordinates")
        for p in s.parameters:
            expect(p.low <= p.value <= p.high, f"parameter {p.name} = {p.value} is outside [{p.low}, {p.high}]")

    def test_resolution_is_a_bound(self) -> None:
        s = self.system()
        e = s.resolution(np.ones(s.nx))
        expect(np.shape(e) == (s.nx,) and bool((e >= 0).all()), f"resolution is {e}; expected {s.nx} numbers ≥ 0")

    def test_float64_and_shapes(self) -> None:
        s, x, u, options = self._query()
        try:
            out = s.step(x, u, **options)
        except UsageError as error:  # `step` refuses what is neither
            raise AssertionError(str(error)) from error
        expect(out.x.dtype == np.float64, f"x has dtype {out.x.dtype}; expected float64")
        expect(out.x.shape == x.shape, f"x has shape {out.x.shape}; expected {x.shape}")
        expect(bool(np.isfinite(out.x).all()), "x is not finite")

    def test_inputs_are_not_changed(self) -> None:
        s, x, u, options = self._query()
        before = pickle.dumps((x, u, options))
        s.step(x, u, **options)
        expect(pickle.dumps((x, u, options)) == before, "step changed an array that it was given")

    def test_output_is_owned(self) -> None:
        s, x, u, options = self._query()
        first = s.step(x, u, **options)
        kept = first.x.copy()
        s.step(x[::-1], u[::-1], **_take(options, slice(None, None, -1)))
        expect(first.x.tobytes() == kept.tobytes(), "a later step changed an earlier result: return a new array")

    def test_repeats_bit_for_bit(self) -> None:
        s, x, u, options = self._query()
        first = s.step(x, u, **options)
        _same(first, s.step(x, u, **options), "the same query asked twice")
        s.step(x[:3], u[-3:], **_take(options, slice(0, 3)))
        _same(first, s.step(x, u, **options), "the same query asked again after another one")

    def test_order_does_not_matter(self) -> None:
        s, x, u, options = self._query()
        if "seed" in s.capabilities:
            return
        order = np.random.default_rng(1).permutation(len(x))
        first, permuted = s.step(x, u, **options), s.step(x[order], u[order], **_take(options, order))
        _same(_rows(first, order), permuted, "rows in another order")

    def test_batch_equals_singles(self) -> None:
        s, x, u, options = self._query()
        if "seed" in s.capabilities:
            return
        out = s.step(x, u, **options)
        for k in range(len(x)):
            row = slice(k, k + 1)
            _same(_rows(out, row), s.step(x[row], u[row], **_take(options, row)), f"row {k} asked alone")

    def test_company_does_not_matter(self) -> None:
        s, x, u, options = self._query()
        if "seed" in s.capabilities:
            return
        rows = laddered(s, Queries(x, u, options.get("hidden")))
        first = apart(s, rows, 0)
        for how, index, answer in itertools.chain(contexts(s, rows, 0), held(s, rows, first)):
            _same(_rows(first, index), answer, f"rows {how}")

    def test_failures_leave_no_trace(self) -> None:
        s, x, u, options = self._query()
        first = s.step(x, u, **options)
        with contextlib.suppress(Exception):  # far away an engine may fail as it likes
            s.step(1e3 * x, 1e3 * u, **options)
        _same(first, s.step(x, u, **options), "the same query after one far outside")

    def test_fresh_instance_gives_the_same_bits(self) -> None:
        s, x, u, options = self._query()
        _same(s.step(x, u, **options), self.system().step(x, u, **options), "a fresh instance")

    def test_another_process_gives_the_same_bits(self) -> None:
        s, x, u, options = self._query()
        job = pickle.dumps(sys.path) + pickle.dumps((s, x, u, options))
        done = subprocess.run([sys.executable, "-c", _ELSEWHERE], input=job, capture_output=True, timeout=120, check=False)
        expect(done.returncode == 0, f"it does not run in another process: {done.stderr.decode(errors='replace')[-800:]}")
        there, hidden, digest = pickle.loads(done.stdout.rpartition(b"\0answer")[2])
        _same(s.step(x, u, **options), Step(there, hidden), "another process")
        expect(digest == s.digest(), "its digest is another one in another process")

    def test_empty_batch(self) -> None:
        s, x, u, options = self._query()
        out = s.step(x[:0], u[:0], **_take(options, slice(0, 0)))
        expect(out.x.shape == (0, s.nx) and out.x.dtype == np.float64, f"no rows gave x of shape {out.x.shape}")

    def test_nan_is_refused(self) -> None:
        s, x, u, options = self._query()
        for bad in (np.nan, np.inf):
            _refused(f"x with {bad}", s.step, _poisoned(x, bad), u, **options)
            if s.nu:
                _refused(f"u with {bad}", s.step, x, _poisoned(u, bad), **options)
            for name, value in options.items():
                if name != "seed":
                    poisoned: Any = (
                        {k: _poisoned(v, bad) for k, v in value.items()} if name == "parameters" else _poisoned(value, bad)
                    )
                    _refused(f"{name} with {bad}", s.step, x, u, **{**options, name: poisoned})

    def test_pickles(self) -> None:
        s, x, u, options = self._query()
        first, copy = s.step(x, u, **options), pickle.loads(pickle.dumps(s))
        _same(first, copy.step(x, u, **options), "a pickled and restored copy")
        expect(copy.digest() == s.digest(), "a pickled and restored copy has another digest")

    def test_digest_names_the_physics(self) -> None:
        s, x, u, options = self._query()
        before = s.digest()
        expect(before == self.system().digest(), "two equal instances have different digests")
        s.step(x, u, **options)
        expect(s.digest() == before, "a step changed the digest: leave caches out of it")

    def test_rollout_equals_steps(self) -> None:
        s, x, u, options = self._query()
        self._rolled(s, x, u, options, 4)
        few = slice(0, 2)
        self._rolled(s, x[few], u[few], _take(options, few), 40)

    def _rolled(self, s: System, x: Array, u: Array, options: dict[str, Any], steps: int) -> None:
        sequence = np.stack([np.roll(u, k, axis=0) for k in range(steps)], axis=1)
        whole = dict(options)
        if "forces" in options:
            whole["forces"] = np.repeat(options["forces"][:, None], steps, axis=1)
        rollout = s.rollout(x, sequence, **whole)
        expect(rollout.x.shape == (len(x), steps + 1, s.nx), f"rollout has shape {rollout.x.shape}")
        here, each = Step(x, options.get("hidden")), dict(options)
        for k in range(steps):
            expect(rollout.x[:, k].tobytes() == here.x.tobytes(), f"rollout differs from repeated steps at step {k}")
            each.update({"hidden": here.hidden} if "hidden" in options else {})
            each.update({"seed": step_seed(options["seed"], k)} if "seed" in options else {})
            here = s.step(here.x, sequence[:, k], **each)
        _same(Step(rollout.x[:, -1], rollout.hidden), here, "the end of a rollout against repeated steps")

    def test_undeclared_options_are_refused(self) -> None:
        s, x, u, _ = self._query()
        n = len(x)
        values: dict[str, Any] = {
            "hidden": np.zeros((n, max(1, len(s.hidden_default)))),
            "parameters": {"no such parameter": 1.0},
            "forces": np.zeros((n, s.substeps, max(1, len(s.coordinates)))),
            "seed": 1,
        }
        for name, value in values.items():
            if name not in s.capabilities or name == "parameters":
                _refused(f"'{name}', which is not declared,", s.step, x, u, **{name: value})

    def test_input_matters(self) -> None:
        s, x, u, options = self._query()
        if s.nu:
            expect(_differs(s.step(x, u, **options), s.step(x, -u, **options)), "x⁺ does not depend on u anywhere")

    def test_parameters_matter(self) -> None:
        s, x, u, options = self._query()
        if "parameters" not in s.capabilities:
            return
        rest = {k: v for k, v in options.items() if k != "parameters"}
        stated = s.step(x, u, **rest)
        _same(
            stated,
            s.step(x, u, parameters={p.name: p.value for p in s.parameters}, **rest),
            "parameters at their stated values",
        )
        expect(_differs(stated, s.step(x, u, **options)), "no parameter changes x⁺")

    def test_forces_matter(self) -> None:
        s, x, u, options = self._query()
        if "forces" in s.capabilities:
            rest = {k: v for k, v in options.items() if k != "forces"}
            without, none = s.step(x, u, **rest), s.step(x, u, forces=np.zeros_like(options["forces"]), **rest)
            expect(bool(np.allclose(without.x, none.x, rtol=1e-9, atol=1e-12)), "forces of zero change x⁺")
            expect(_differs(without, s.step(x, u, **options)), "forces do not change x⁺")

    def test_hidden_is_handed_on(self) -> None:
        s, x, u, options = self._query()
        if "hidden" not in s.capabilities:
            return
        rest = {k: v for k, v in options.items() if k != "hidden"}
        out, default = s.step(x, u, **rest), np.tile(np.asarray(s.hidden_default, dtype=np.float64), (len(x), 1))
        expect(out.hidden is not None and out.hidden.shape == default.shape, "step does not return the hidden state")
        _same(out, s.step(x, u, hidden=default, **rest), "the declared default given as hidden state")
        expect(_differs(out, s.step(x, u, hidden=_shifted(s.hidden, default), **rest)), "the hidden state changes nothing")

    def test_seed_decides(self) -> None:
        s, x, u, options = self._query()
        if "seed" in s.capabilities:
            other = {**options, "seed": options["seed"] + 1}
            expect(_differs(s.step(x, u, **options), s.step(x, u, **other)), "another seed gives the same answer")

    def _query(self) -> tuple[System, Array, Array, dict[str, Any]]:
        """A System, rows of its domain, and every option that it declares."""
        s, rng = self.system(), np.random.default_rng(11)
        x, u = self.points(s)
        n = len(x)
        options: dict[str, Any] = {}
        if "parameters" in s.capabilities:
            options["parameters"] = {p.name: _varied(p, n, rng) for p in s.parameters}
        if "forces" in s.capabilities:
            options["forces"] = rng.uniform(-1, 1, (n, s.substeps, len(s.coordinates)))
        if "seed" in s.capabilities:
            options["seed"] = 5
        if "hidden" in s.capabilities:
            options["hidden"] = np.tile(np.asarray(s.hidden_default, dtype=np.float64), (n, 1))
        return s, x, u, options


def _differs(a: Step, b: Step) -> bool:
    return a.x.tobytes() != b.x.tobytes() or (a.hidden is not None and a.hidden.tobytes() != np.asarray(b.hidden).tobytes())


def _same(a: Step, b: Step, what: str) -> None:
    if a.x.shape == b.x.shape and a.x.tobytes() != b.x.tobytes():
        row = int(np.flatnonzero((a.x != b.x).any(axis=-1))[0]) if (a.x != b.x).any() else 0
        worst = float(np.abs(a.x - b.x).max())
        raise AssertionError(
            f"{what} gave other bits: row {row}, {a.x[row].tolist()} and {b.x[row].tolist()}, worst {worst:.3g}"
        )
    expect(not _differs(a, b), f"{what} gave other bits in the hidden state, or another shape: {a.x.shape} and {b.x.shape}")


def _refused(what: str, call: Callable[..., object], *args: Any, **options: Any) -> None:
    try:
        call(*args, **options)
    except UsageError:
        return
    raise AssertionError(f"{what} was accepted; expected UsageError")


def _poisoned(a: Array, bad: float) -> Array:
    a = a.copy()
    a.flat[-1] = bad
    return a


def _rows(out: Step, index: Any) -> Step:
    return Step(out.x[index], None if out.hidden is None else out.hidden[index])


def _take(options: dict[str, Any], index: Any) -> dict[str, Any]:
    """The options of some of the rows."""
    taken = {k: v if k == "seed" else v[index] for k, v in options.items() if k != "parameters"}
    if "parameters" in options:
        taken["parameters"] = {k: v[index] for k, v in options["parameters"].items()}
    return taken


def _varied(p: Parameter, n: int, rng: np.random.Generator) -> Array:
    """Three values near the stated one, inside the parameter's bounds, over n rows."""
    values = np.clip(p.value + (abs(p.value) or 1.0) * np.array([0.0, 0.1, -0.1]), p.low, p.high)
    return np.asarray(values[rng.integers(3, size=n)])


def _shifted(specs: Sequence[StateSpec], hidden: Array) -> Array:
    """Another admissible hidden state: every number moved by 0.1, quaternions left alone."""
    move = np.concatenate([np.zeros(4) if h.kind == "quaternion" else np.full(1, 0.1) for h in specs])
    return np.asarray(hidden + move)


@final
class ToyOscillator(System):
    """θ″ = −k sin θ + y + forces, y a filtered input (hidden), by semi-implicit Euler; every capability, seed on request."""

    def __init__(self, *, noise: float = 0.0, substeps: int = 2) -> None:
        self.states = (StateSpec("theta", "rad", "angle"), StateSpec("omega", "rad/s"))
        self.inputs = (StateSpec("torque", "N*m"),)
        self.period, self.substeps = 0.01, substeps
        self.hidden, self.hidden_default = (StateSpec("lag", "N*m"),), (0.0,)
        self.parameters = (Parameter("k", 2.0, "1/s^2", low=0.0),)
        self.coordinates = ("theta",)
        self.noise = noise
        self.capabilities = frozenset(
            {"hidden", "parameters", "forces", "seed"} if noise else {"hidden", "parameters", "forces"}
        )

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        theta, omega, lag = x[:, 0].copy(), x[:, 1].copy(), options["hidden"][:, 0]
        k = options.get("parameters", {}).get("k", np.full(len(x), self.parameters[0].value))
        forces = options.get("forces", np.zeros((len(x), self.substeps, 1)))
        h = self.period / self.substeps
        for i in range(self.substeps):
            lag = lag + 0.5 * (u[:, 0] - lag)
            omega += h * (-k * np.sin(theta) + lag + forces[:, i, 0])
            theta += h * omega
        if "seed" in options:
            omega += self.noise * np.random.default_rng(options["seed"]).standard_normal(len(x))
        return Step(np.stack([theta, omega], axis=1), lag[:, None])
