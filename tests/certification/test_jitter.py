"""Round-off that an engine amplifies: it is measured a few ulp from points of Z, and e covers it; smooth ones keep theirs."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from impure import CONSTANTS, Circumstantial, domain, nominal

import gapcert as gc
from gapcert.certification.gates import entry
from gapcert.contracts.systems.arithmetic import Arithmetic
from gapcert_bounds.constants.declared_constants import Declared

LOST = {
    "of all bits": lambda z: _hashed(z),
    "of the input's bits": lambda z: _hashed(z[:, 2:]),
    "of a state's last byte": lambda z: (z[:, :1].copy().view(np.uint64) % 256 / 128.0).astype(float) - 1,
    "of a difference": lambda z: _hashed(z[:, :1] - z[:, 1:2]),
}
"""Pseudo-random numbers in [−1, 1], (n, 1), that change with the last bits of z."""


def _hashed(z):
    bits = np.ascontiguousarray(z).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    mixed = np.bitwise_xor.reduce(bits ^ bits >> np.uint64(29), axis=1) * np.uint64(0xBF58476D1CE4E5B9)
    return ((mixed >> np.uint64(11)) / 2.0**52 - 1)[:, None]


class Amplifying(gc.Backend):
    """x⁺ = f(x, u) + small waves + size · lost(z)."""

    def __init__(self, lost, size):
        self.inner, self.lost, self.size = Circumstantial("first row", clean=True, size=0.0), lost, size
        self.states, self.inputs, self.period = self.inner.states, self.inner.inputs, 0.1

    def digest(self):
        return f"{self.lost} {self.size}"

    def _step(self, x, u, **options):
        z = np.hstack([x, u])
        return self.inner.law(z) + self.size * LOST[self.lost](z)


class Cancelling(gc.Backend):
    """The same sum, added to a large number and taken from it again."""

    def __init__(self, large):
        self.inner, self.large = Circumstantial("first row", clean=True, size=0.0), large
        self.states, self.inputs, self.period = self.inner.states, self.inner.inputs, 0.1

    def _step(self, x, u, **options):
        return (self.inner.law(np.hstack([x, u])) + self.large) - self.large


def certified(engine, folder, seed=0, emit=lambda event: None):
    return gc.certify(
        nominal(),
        engine,
        domain(),
        sampling=gc.GridSampling((5, 5, 5)),
        lipschitz=Declared(CONSTANTS),
        predictor="none",
        request=gc.Request("deterministic", epsilon=0.05),
        seed=seed,
        folder=folder / "c",
        executor=functools.partial(ThreadPoolExecutor, 1),
        emit=emit,
    )


def outside(certificate, engine, seed, ulps=500):
    """How many of 60,000 points within some ulp of samples leave [l, u]."""
    rng, z = np.random.default_rng([seed, 9]), certificate.problem.samples.z
    near = np.clip(z + np.spacing(np.abs(z)) * rng.integers(-ulps, ulps + 1, (480, *z.shape)), z.min(axis=0), z.max(axis=0))
    near = near.reshape(-1, z.shape[1])
    low, high = certificate.gap.interval(near)
    r = engine.step(*domain().split(near)).x - nominal().step(*domain().split(near)).x
    return int(((r < low) | (r > high)).any(axis=1).sum())


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize("size", [4e-14, 3e-11, 2e-7])
def test_what_jitters_is_found_and_covered_and_said(lost, size, tmp_path):
    engine, told = Amplifying(lost, size), []
    c = certified(engine, tmp_path, emit=lambda e: told.append(e.data.get("message", "")) if e.name == "warning" else None)
    fhat, _ = c.problem.arithmetics
    assert (fhat.jitter >= 0.5 * size).all()
    assert (fhat.jitter <= 1.01 * size).all()
    assert c.claim.kind == "deterministic"
    assert outside(c, engine, 1) == 0
    said = next(a for a in c.assumptions if "within e" in a)
    assert "of f̂ it is measured, not proved: it covers four times what close answers leave a parabola by, " in said
    assert "e(x) of f̂ is four times its jitter, which is more than is stated." in said
    assert "e(x) of f̂ is four times its jitter, which is more than is stated." in told


@pytest.mark.parametrize("large", [1e3, -2e5])
def test_what_cancels_is_found(large, tmp_path):
    engine = Cancelling(large)
    c = certified(engine, tmp_path)
    assert (c.problem.arithmetics[0].jitter > 0.3 * np.spacing(abs(large))).all()
    assert outside(c, engine, 2) == 0


class Waving(gc.Backend):
    """Waves that a probe over more than a few ulp would take for jitter, far out on an axis."""

    def __init__(self):
        self.inner = Circumstantial("first row", clean=True, size=0.0)
        self.states, self.inputs, self.period = self.inner.states, self.inner.inputs, 0.1

    def _step(self, x, u, **options):
        return self.inner.law(np.hstack([x, u])) + 2.0 * np.sin(400.0 * x)


def test_bends_are_no_jitter():
    wide = gc.Domain.of(nominal(), {"x": (-900, 900), "y": (-900, 900), "u": (-1, 1)})
    # sin errs by as much as its argument rounds, 400 · 900 of which half an ulp is 2.9e-11.
    assert (entry.jitter(Waving(), wide, 0) < 2.0 * 3e-11 + 1e-13).all()


@pytest.mark.parametrize("lost", ["of all bits", "of a difference"])
def test_without_the_look_deterministic_claims_are_false(lost, tmp_path, monkeypatch):
    monkeypatch.setattr(entry, "jitter", lambda *given: None)
    engine = Amplifying(lost, 3e-11)
    assert outside(certified(engine, tmp_path), engine, 1) > 0


@pytest.mark.parametrize("seed", range(4))
def test_a_smooth_engine_keeps_its_e(seed, tmp_path):
    told = []
    engine = Circumstantial("first row", clean=True, size=0.0)
    c = certified(engine, tmp_path, seed, emit=lambda e: told.append(e) if e.name == "warning" else None)
    fhat, _ = c.problem.arithmetics
    assert (4 * fhat.jitter < fhat.e).all()
    assert not any("jitter" in str(e.data) for e in told)
    data = c.problem.arithmetics[0].to_data()
    assert data["jitter"] == fhat.jitter.tolist()
    assert "jitter" not in c.problem.arithmetics[1].to_data()


def test_text_is_proved_and_not_measured():
    assert entry.jitter(nominal(), domain(), 0) is None


class Single(gc.Backend):
    """The same law in single precision: all of it, or what a step adds."""

    def __init__(self, increments):
        self.inner, self.increments = Circumstantial("first row", clean=True, size=0.0), increments
        self.states, self.inputs, self.period = self.inner.states, self.inner.inputs, 0.1

    def digest(self):
        return f"{self.increments}"

    def _step(self, x, u, **options):
        z = np.hstack([x, u]).astype(np.float32)
        after = np.asarray(self.inner.law(z), dtype=np.float32)
        return x + (after - z[:, :2]) if self.increments else after.astype(float)


@pytest.mark.parametrize("increments", [True, False])
def test_single_precision_is_seen_through(increments, tmp_path, monkeypatch):
    engine = Single(increments)
    c = certified(engine, tmp_path)
    z = domain().draw(30_000, np.random.default_rng(5))
    off = np.abs(engine.step(*domain().split(z)).x - engine.inner.law(z)).max(axis=0)
    assert (off > 1e3 * engine.resolution(np.ones(2))).all()
    assert (c.problem.arithmetics[0].e >= off).all()
    assert (c.problem.arithmetics[0].e < 20 * off).all()
    assert c.claim.kind == "deterministic"
    assert outside(c, engine, 3, ulps=10**9) == 0
    monkeypatch.setattr(entry, "jitter", lambda *given: None)
    assert outside(certified(engine, tmp_path / "without"), engine, 3, ulps=10**9) > 100


class Arm(gc.Backend):
    """Many joints, each pushed by a motor."""

    def __init__(self, joints):
        states = [gc.StateSpec(f"q{k}", "rad") for k in range(joints)] + [gc.StateSpec(f"w{k}", "rad/s") for k in range(joints)]
        self.states, self.inputs = tuple(states), tuple(gc.StateSpec(f"m{k}", "N*m") for k in range(joints))
        self.period = 0.01

    def _step(self, x, u, **options):
        q, w = np.split(x, 2, axis=1)
        return np.hstack([q + 0.01 * w, w + 0.01 * (u - 9.81 * np.sin(q))])


@pytest.mark.parametrize("joints", [3, 9])
def test_what_an_engine_states_is_asked_at_the_ends_of_many_axes(joints):
    arm = Arm(joints)
    ranges = {s.name: (-1, 1) for s in arm.states} | {s.name: (-30, 30) for s in arm.inputs}
    found = Arithmetic.of(arm, gc.Domain.of(arm, ranges))
    # The largest speed after a step is 1 + 0.01 (30 + 9.81 sin 1) = 1.38, and every end of one axis is among the corners drawn.
    largest = np.concatenate([np.full(joints, 1.01), np.full(joints, 1 + 0.01 * (30 + 9.81 * np.sin(1)))])
    assert not found.proved
    assert (arm.resolution(0.99 * largest) <= found.e).all()
    assert (found.e <= arm.resolution(largest) * (1 + 1e-12)).all()
