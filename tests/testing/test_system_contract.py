"""Each check of SystemContract passes on a good System, and fails on the fault that it is there for."""

import os
import pickle
import subprocess
import sys

import numpy as np
import pytest

from gapcert import Parameter, StateSpec, System, UsageError
from gapcert.plugin import Step
from gapcert.testing import SystemContract, ToyOscillator

CHECKS = sorted(name for name in vars(SystemContract) if name.startswith("test_"))


class TestToy(SystemContract):
    def system(self):
        return ToyOscillator()


class TestStochasticToy(SystemContract):
    def system(self):
        return ToyOscillator(noise=0.1)


class Plain(System):
    """x⁺ = 0.9 x + u, without any capability."""

    def __init__(self):
        self.states, self.inputs, self.period = (StateSpec("x"),), (StateSpec("u"),), 0.1

    def _step(self, x, u, **options):
        return 0.9 * x + u


class TestPlain(SystemContract):
    rows = 3

    def system(self):
        return Plain()

    test_another_process_gives_the_same_bits = None  # a class of a test module cannot be imported there


class Faulty(System):
    """A good oscillator inside; each fault below spoils one thing."""

    def __init__(self):
        self.inner = ToyOscillator()
        for name in ("states", "inputs", "period", "substeps", "hidden", "hidden_default", "parameters", "coordinates"):
            setattr(self, name, getattr(self.inner, name))
        self.capabilities = self.inner.capabilities
        self.calls = 0

    def digest(self):
        return self.inner.digest()

    def _step(self, x, u, **options):
        return self.inner._step(x, u, **options)


class NoPeriod(Faulty):
    def __init__(self):
        super().__init__()
        self.period = 0.0


class OneResolution(Faulty):
    def resolution(self, magnitude):
        return np.array([1e-16])


class Float32(Faulty):
    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        return Step(out.x.astype(np.float32), out.hidden)


class ChangesInput(Faulty):
    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        x += 1.0
        return out


class ReusesBuffer(Faulty):
    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        if not hasattr(self, "buffer"):
            self.buffer = np.empty_like(out.x)
        self.buffer[:] = out.x
        return Step(self.buffer, out.hidden)


class CountsCalls(Faulty):
    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        self.calls += 1
        return Step(out.x + 1e-16 * self.calls, out.hidden)


class Remembers(Faulty):
    """The same query twice agrees; only another one in between shows the trace."""

    def _step(self, x, u, **options):
        out, last = super()._step(x, u, **options), getattr(self, "last", None)
        self.last = x.tobytes()
        return Step(out.x + (0.0 if last in (None, self.last) else 1e-15), out.hidden)


class Sleeps(Faulty):
    """Whatever is close to the row before it, and is not that, hardly moves."""

    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        away = np.abs(np.diff(x, axis=0, prepend=x[:1] + 1)).max(axis=1, keepdims=True)
        return Step(out.x + 1e-13 * ((away > 0) & (away < 1e-3)), out.hidden)


class Sulks(Faulty):
    def _step(self, x, u, **options):
        out, self.far = super()._step(x, u, **options), getattr(self, "far", False) or bool((np.abs(x) > 100).any())
        return Step(out.x + 1e-13 * self.far, out.hidden)


class WarmStart(Faulty):
    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        return Step(out.x + 1e-13 * np.roll(out.x, 1, axis=0), out.hidden)


class SumsBatch(Faulty):
    """Equivariant under permutation, but a row sees the others."""

    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        return Step(out.x + 1e-9 * len(x), out.hidden)


class StopsEarly(Faulty):
    """A solver that starts from the last row's solution, and has nothing left to do where that is close."""

    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        close = np.abs(np.diff(x, axis=0, prepend=x[:1] + 1)).max(axis=1) < 1e-3
        return Step(out.x + 1e-9 * close[:, None], out.hidden)


class Dirty(Faulty):
    """What failed leaves its half-made state behind."""

    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        if np.abs(u).max() > 100:
            self.calls = 1
            raise ArithmeticError("no convergence")
        return Step(out.x + 1e-9 * self.calls, out.hidden)


class LongRollout(Faulty):
    """Right for a while: its buffer holds 32 steps."""

    def _rollout(self, x0, u_sequence, **options):
        out = super()._rollout(x0, u_sequence, **options)
        return Step(out.x + 1e-12 * (np.arange(out.x.shape[1]) > 32)[None, :, None], out.hidden)


class Draws(Faulty):
    rng = np.random.default_rng(0)

    def __init__(self):
        super().__init__()
        self.offset = float(self.rng.random())

    def _step(self, x, u, **options):
        out = super()._step(x, u, **options)
        return Step(out.x + self.offset, out.hidden)


class Pid(float):
    """A number that is another one wherever it is unpickled."""

    def __reduce__(self):
        return (os.getpid, ())


def elsewhere():
    toy = ToyOscillator()
    toy.period = Pid(os.getpid())
    return toy


class EmptyFails(Faulty):
    def step(self, x, u, **options):
        if len(x) == 0:
            return Step(np.empty(0))
        return super().step(x, u, **options)


class AcceptsNaN(Faulty):
    def step(self, x, u, **options):
        return super().step(np.nan_to_num(x), u, **options)


class AcceptsInfinity(Faulty):
    def step(self, x, u, **options):
        return super().step(np.where(np.isinf(x), 0.0, x), u, **options)


class Forgets(Faulty):
    def __getstate__(self):
        return {k: v for k, v in self.__dict__.items() if k != "inner"}

    def __setstate__(self, state):
        self.__dict__.update(state)
        self.inner = ToyOscillator(substeps=2)
        self.inner.period = 0.011


class DigestOfCache(Faulty):
    def digest(self):
        return str(self.calls)

    def _step(self, x, u, **options):
        self.calls += 1
        return super()._step(x, u, **options)


class FastRollout(Faulty):
    def _rollout(self, x0, u_sequence, **options):
        out = super()._rollout(x0, u_sequence, **options)
        return Step(out.x * (1 + 2.3e-16), out.hidden)


class DropsHiddenInRollout(Faulty):
    def _rollout(self, x0, u_sequence, **options):
        out = [x0]
        for k in range(u_sequence.shape[1]):
            forces = options["forces"][:, k]
            out.append(self.step(out[-1], u_sequence[:, k], parameters=options["parameters"], forces=forces).x)
        return Step(np.stack(out, axis=1))


class TakesAnything(Faulty):
    def step(self, x, u, **options):
        return super().step(x, u, **{k: v for k, v in options.items() if k in self.capabilities and k != "parameters"})


class NoInput(Faulty):
    def _step(self, x, u, **options):
        return super()._step(x, 0 * u, **options)


class IgnoresParameters(Faulty):
    def _step(self, x, u, **options):
        return super()._step(x, u, **{k: v for k, v in options.items() if k != "parameters"})


class OtherStatedValue(Faulty):
    def __init__(self):
        super().__init__()
        self.parameters = (Parameter("k", 2.5, "1/s^2"),)


class IgnoresForces(Faulty):
    def _step(self, x, u, **options):
        return super()._step(x, u, **{k: v for k, v in options.items() if k != "forces"})


class KeepsHidden(Faulty):
    def _step(self, x, u, **options):
        return Step(super()._step(x, u, **options).x)


class IgnoresHidden(Faulty):
    def _step(self, x, u, **options):
        return super()._step(x, u, **(options | {"hidden": np.zeros_like(options["hidden"])}))


class OtherDefault(Faulty):
    def _step(self, x, u, **options):
        self.calls += 1
        return super()._step(x, u, **(options | {"hidden": options["hidden"] + (self.calls == 1)}))


class IgnoresSeed(Faulty):
    def __init__(self):
        super().__init__()
        self.inner = ToyOscillator(noise=0.1)
        self.capabilities = self.inner.capabilities

    def _step(self, x, u, **options):
        return super()._step(x, u, **(options | {"seed": 0}))


FAULTS = [
    (NoPeriod, "test_describes_itself"),
    (OneResolution, "test_resolution_is_a_bound"),
    (Float32, "test_float64_and_shapes"),
    (ChangesInput, "test_inputs_are_not_changed"),
    (ReusesBuffer, "test_output_is_owned"),
    (CountsCalls, "test_repeats_bit_for_bit"),
    (Remembers, "test_repeats_bit_for_bit"),
    (WarmStart, "test_order_does_not_matter"),
    (SumsBatch, "test_batch_equals_singles"),
    (Sleeps, "test_company_does_not_matter"),
    (Sulks, "test_failures_leave_no_trace"),
    (StopsEarly, "test_company_does_not_matter"),
    (Dirty, "test_failures_leave_no_trace"),
    (Draws, "test_fresh_instance_gives_the_same_bits"),
    (elsewhere, "test_another_process_gives_the_same_bits"),
    (EmptyFails, "test_empty_batch"),
    (AcceptsNaN, "test_nan_is_refused"),
    (AcceptsInfinity, "test_nan_is_refused"),
    (Forgets, "test_pickles"),
    (DigestOfCache, "test_digest_names_the_physics"),
    (FastRollout, "test_rollout_equals_steps"),
    (LongRollout, "test_rollout_equals_steps"),
    (DropsHiddenInRollout, "test_rollout_equals_steps"),
    (TakesAnything, "test_undeclared_options_are_refused"),
    (NoInput, "test_input_matters"),
    (IgnoresParameters, "test_parameters_matter"),
    (OtherStatedValue, "test_parameters_matter"),
    (IgnoresForces, "test_forces_matter"),
    (KeepsHidden, "test_hidden_is_handed_on"),
    (IgnoresHidden, "test_hidden_is_handed_on"),
    (OtherDefault, "test_hidden_is_handed_on"),
    (IgnoresSeed, "test_seed_decides"),
]


def contract(factory):
    return type("Contract", (SystemContract,), {"system": lambda self: factory()})()


def test_every_check_has_a_fault():
    assert sorted({name for _, name in FAULTS}) == CHECKS


@pytest.mark.contract
@pytest.mark.parametrize(("fault", "check"), FAULTS, ids=[f.__name__ for f, _ in FAULTS])
def test_planted_fault_is_caught(fault, check):
    with pytest.raises(AssertionError):
        getattr(contract(fault), check)()


@pytest.mark.parametrize("check", [c for c in CHECKS if "another_process" not in c])
def test_the_wrapper_itself_is_no_fault(check):
    getattr(contract(Faulty), check)()


def test_an_error_of_the_system_is_not_taken_for_a_refusal():
    class Breaks(Faulty):
        def step(self, x, u, **options):
            if not np.isfinite(x).all():
                raise ValueError("deep inside")
            return super().step(x, u, **options)

    with pytest.raises(ValueError, match="deep inside"):
        contract(Breaks).test_nan_is_refused()


@pytest.mark.contract
def test_importing_the_kit_does_not_need_pytest():
    code = "import sys; import gapcert.testing; sys.exit('pytest' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_toy_pickles_by_value():
    assert pickle.loads(pickle.dumps(ToyOscillator())).digest() == ToyOscillator().digest()
    with pytest.raises(UsageError):
        ToyOscillator().step(np.zeros((1, 3)), np.zeros((1, 1)))
