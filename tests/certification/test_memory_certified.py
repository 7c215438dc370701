"""A model that remembers is certified over a declared range of its memory, or refused in a sentence."""

import numpy as np
import pytest

import gapcert as gc
from gapcert.certification.gates.augment import unmeasured

CART = {
    "kind": "equations", "coordinates": {"q": "m"}, "inputs": {"F": "N"}, "parameters": {"mass": "2 kg"},
    "mass_matrix": [["mass"]], "forces": {"q": "F"}, "integrator": "semi_implicit", "period": "20 ms",
}  # fmt: skip
LAG = gc.plugin.Memory("slow", "N", "slow + ({u} - slow)*{h}/tau")
RANGES = {"slow": ["-1 N", "1 N"]}


def lagging():
    config = gc.registry().config("model", "equations").model_validate(CART)
    model = gc.registry().build("model", "equations", config, gc.Context())
    tau = gc.Parameter("tau", 0.1, "s")
    return model.extend([gc.plugin.Extension("input-lag", "F", (tau,), input="slow", memory=(LAG,))])


def spec(hidden=None, **more):
    made = {"version": 1, "name": "lag", "model": lagging().to_spec(), "backend": CART}
    made |= {"domain": {"q": [-1, 1], "q_dot": [-1, 1], "F": [-1, 1]}, "sampling": {"kind": "adaptive", "budget": 60}}
    made |= {"certificate": {"claim": "statistical", "violation": 0.01, "confidence": 0.99}, "report": {"rerun": False}}
    return made | ({"hidden": hidden} if hidden else {}) | more


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    return gc.run(spec({"sample": {"ranges": RANGES}}), out=tmp_path_factory.mktemp("runs"))


def residual(memory):
    """|f̂ − f(·, z)| of q_dot and its (x, u), at random points, for memories drawn within ± `memory`."""
    rng, model = np.random.default_rng(5), lagging()
    cart = gc.registry().build(
        "model", "equations", gc.registry().config("model", "equations").model_validate(CART), gc.Context()
    )
    x, u, z = rng.uniform(-1, 1, (400, 2)), rng.uniform(-1, 1, (400, 1)), rng.uniform(-memory, memory, (400, 1))
    return np.abs(cart.step(x, u).x - model.step(x, u, hidden=z).x), np.hstack([x, u])


def test_the_pair_errs_by_what_its_three_steps_do():
    """x⁺ = f(x, u, z₀) + f̂(x, u) − f(x, u, z): two answers of the model, and one of the backend."""
    model, size = lagging(), np.array([1.0, 3.0])
    resting, pair = unmeasured(model, model, ["slow"])
    assert pair.resolution(size) == pytest.approx(3 * model.resolution(size), rel=1e-12, abs=0)
    assert resting.resolution(size).tolist() == model.resolution(size).tolist()


def test_gamma_covers_every_memory_in_its_range(certified):
    assert certified.summary["verdict"] == "holds"
    assert certified.summary["certificate"]["hidden"]["names"] == ["slow"]
    assert any("slow" in a for a in certified.summary["certificate"]["assumptions"])
    inside, z = residual(1.0)
    gamma = certified.certificate.gap.gamma(z)
    assert (inside <= gamma).all()
    assert inside[:, 1].max() > 0.5 * gamma[:, 1].max()


def test_a_memory_outside_its_range_breaks_it(certified):
    """The planted fault: the range is what the claim rests on."""
    beyond, z = residual(3.0)
    assert (beyond > certified.certificate.gap.gamma(z)).any()


def test_at_its_default_it_is_certified_for_that_alone(tmp_path):
    """`slow` starts at 0: γ holds for a cart that begins there, says so, and is refuted by other memories."""
    made = gc.run(spec("default", certificate={"claim": "statistical", "violation": 0.01, "attack": 200}), out=tmp_path)
    assert made.summary["certificate"]["hidden"]["distribution"] == ", hidden state at its default"
    assert made.summary["certificate"]["hidden"]["names"] == ["slow"]
    inside, z = residual(0.0)
    assert (inside <= made.certificate.gap.gamma(z)).all()
    assert made.summary["verdict"] == "fails"
    assert made.summary["certificate"]["hidden"]["attack"]["violations"] > 0


@pytest.mark.parametrize("hidden", [None, {"sample": {"visited": {}}}])
def test_without_a_range_it_is_refused(hidden, tmp_path):
    with pytest.raises(gc.UsageError, match=r"model has hidden state \(slow\).*ranges: \{slow: \[low, high\]\}"):
        gc.run(spec(hidden), out=tmp_path)


def test_no_deterministic_claim_and_no_controller(tmp_path):
    claim = {"certificate": {"claim": "deterministic"}, "lipschitz": {"residual": {"kind": "interval"}}}
    with pytest.raises(gc.UsageError, match="deterministic cannot be had with hidden: sample"):
        gc.run(spec({"sample": {"ranges": RANGES}}, **claim), out=tmp_path)
    controller = {"kind": "symbolic", "goal": {"invariance": {"q": [-1, 1]}}, "cells": {"q": 4, "q_dot": 4}, "inputs": {"F": 3}}
    with pytest.raises(gc.UsageError, match="the model remembers slow, and a controller knows the state alone"):
        gc.run(spec({"sample": {"ranges": RANGES}}, controller=controller), out=tmp_path)
