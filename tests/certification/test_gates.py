"""The gates before a certificate: impure systems are refused with the difference, and inputs that do not arrive are told."""

from __future__ import annotations

import numpy as np
import pytest
from faulty import PerProcess, Sleeping, WarmStart

import gapcert as gc
from gapcert.certification.gates.entry import responses
from gapcert.certification.gates.purity import Queries, _same, purity
from gapcert.certification.samples.executors import processes, threads
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.systems.system import Step
from gapcert.testing.systems import ToyOscillator
from gapcert.testing.toys import Drift, Perturbed, ripple

RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}


def probed(system, executor=threads, seed=0):
    return purity("backend", system, gc.Domain.of(Drift(1), RANGES), executor, seed)


def test_a_pure_system_passes_here_and_in_other_workers():
    pure = Perturbed(Drift(1), ripple)
    for executor in (threads, processes):
        assert probed(pure, executor).endswith("another worker agreed bit for bit")


@pytest.mark.parametrize(
    ("system", "how"),
    [
        (WarmStart(Drift(1)), "in another order"),
        (WarmStart(Drift(1), 1e-15), "in another order"),
        (Sleeping(Drift(1)), "many times in a row"),
    ],
)
def test_planted_impurities_are_refused_with_the_difference(system, how):
    with pytest.raises(gc.UsageError) as told:
        probed(system)
    text = str(told.value)
    assert text.startswith("certify: the backend is not a function of (x, u): the same ")
    assert f"queries {how} differ by up to" in text
    assert "x0 by" in text
    assert "of its mean move" in text
    assert "worst at (x, u) = [" in text


def test_the_difference_told_is_the_one_that_was_planted():
    # The mean move of x0 is τ mean |u| ≈ 0.1; two orders of 64 queries differ by up to 2 leaks.
    with pytest.raises(
        gc.UsageError, match=r"differ by up to (1\.\d+|2)e-06: x0 by .*e-06 \(\d(\.\d)?e-0[56] of its mean move\)"
    ):
        probed(WarmStart(Drift(1), 1e-6))


def test_another_process_is_asked_where_chunks_go_to_processes():
    system = PerProcess(Drift(1))
    assert "bit for bit" in probed(system, threads)
    with pytest.raises(gc.UsageError, match="in another worker differ by up to 1e-07"):
        probed(system, processes)


def test_an_impure_system_is_refused_before_a_sample_is_drawn(tmp_path):
    domain = gc.Domain.of(Drift(1), RANGES)
    with pytest.raises(gc.UsageError, match="the model is not a function"):
        gc.certify(Impure(), Drift(1), domain, folder=tmp_path / "run")
    with pytest.raises(gc.UsageError, match="the backend is not a function"):
        gc.certify(Drift(1), WarmStart(Drift(1)), domain, folder=tmp_path / "run")
    assert not list(tmp_path.rglob("chunk-*"))


class Impure(gc.Model):
    """Drift that counts its calls."""

    def __init__(self):
        self.inner = Drift(1)
        self.states, self.inputs, self.outputs = self.inner.states, self.inner.inputs, self.inner.outputs
        self.period, self.calls = self.inner.period, 0

    def _step(self, x, u, **options):
        self.calls += 1
        return self.inner.step(x, u).x + 1e-12 * self.calls

    def jacobian(self, x, u):
        return self.inner.jacobian(x, u)

    def enclosure(self, z):
        return self.inner.enclosure(z)

    def jacobian_enclosure(self, z):
        return self.inner.jacobian_enclosure(z)

    def extend(self, extensions):
        return self

    def equations(self):
        return ""

    def to_spec(self):
        return {}

    def sites(self, kind):
        return ()


def scaled(z, factor):
    """f̂ whose input acts `factor` times as strongly."""
    return 0.1 * (factor - 1) * z[:, 1:]


def locked(z):
    return -0.1 * z[:, 1:]


class Scaled:
    def __init__(self, factor):
        self.factor = factor

    def __call__(self, z):
        return scaled(z, self.factor)


@pytest.mark.parametrize(("factor", "told"), [(1.0, False), (0.95, False), (1.05, False), (0.833, True), (1.3, True)])
def test_inputs_that_act_otherwise_are_told(factor, told):
    m = Drift(1)
    found = responses(Residual(Perturbed(m, Scaled(factor)), m), gc.Domain.of(m, RANGES), 0)
    assert bool(found) == told
    if told:
        assert f"u0 moves x0 of f̂ {factor:.2g} times as far" in found[0]


def test_an_input_that_does_not_arrive_is_told_and_kept(tmp_path):
    m, heard = Drift(1), []
    c = gc.certify(m, Locked(), gc.Domain.of(m, RANGES), folder=tmp_path / "run", emit=heard.append)
    (warning,) = c.summary()["warnings"]
    assert warning.startswith("x0 of f̂ does not answer to u0 at all")
    assert [e.data["message"] for e in heard if (e.name, e.stage) == ("warning", "gates")] == [warning]


class Locked(gc.Backend):
    """A joint that its default motor holds."""

    def __init__(self):
        m = Drift(1)
        self.states, self.inputs, self.period = m.states, m.inputs, m.period

    def _step(self, x, u, **options):
        return np.array(x)


def test_a_trace_in_the_hidden_state_alone_is_a_trace():
    system = ToyOscillator()
    rows = Queries(np.zeros((2, system.nx)), np.zeros((2, system.nu)), np.tile(system.hidden_default, (2, 1)))
    first = rows.of(system)
    _same("backend", system, rows, first, slice(None), rows.of(system), "asked again")
    with pytest.raises(gc.UsageError, match=r"\(in the hidden state, by 0\.001\)"):
        _same("backend", system, rows, first, slice(None), Step(first.x, first.hidden + 1e-3), "asked again")
