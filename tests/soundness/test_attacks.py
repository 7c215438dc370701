"""Attacks that once succeeded: each would print or build on something untrue."""

import importlib
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from faulty import Coasting
from rough_fields import Coarse

import gapcert as gc
from gapcert.certification import contradiction
from gapcert.certification.gates.augment import Augmented, AugmentedModel
from gapcert.certification.routes import Request
from gapcert.certification.samples.designs import GridSampling
from gapcert.certification.samples.executors import threads
from gapcert.contracts.controllers.goal import Goal
from gapcert.contracts.gaps.lipschitz import LipschitzProblem, Residual
from gapcert.contracts.systems.domain import Box, Domain
from gapcert.contracts.systems.region import Region
from gapcert.contracts.systems.system import Backend
from gapcert.run.build import Build
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert_bounds.testing.fields import Nothing, Waves
from gapcert_report.words.words import claim_sentence

RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}


def declared(x=0.03, u=0.08):
    return gc.registry().get("lipschitz", "declared").load()(values={"x0": {"x0": x, "u0": u}})


def equations(derivative, **parameters):
    data = {
        "kind": "equations",
        "states": {"x": "1", "v": "1"},
        "inputs": {"u": "1"},
        "parameters": {"T": "1 s", **parameters},
        "derivative": {"x": "v/T", "v": f"({derivative})/T"},
        "integrator": "euler",
        "period": "100 ms",
    }
    registry = gc.registry()
    return registry.build("model", "equations", registry.config("model", "equations")(**data))


@pytest.mark.parametrize("box", [(-3.0, 1.0), (-3.0, -1.0), (0.5, 2.0)])
@pytest.mark.parametrize("p", [1, 2, 3, 4])
def test_a_named_exponent_bounds_negative_bases(p, box):
    m = equations("x**p", p=p)
    z = gc.Interval(np.array([[box[0], -1.0, -1.0]]), np.array([[box[1], 1.0, 1.0]]))
    x = np.linspace(*box, 201)
    points = np.column_stack([x, np.zeros_like(x)])
    v = m.step(points, np.zeros((201, 1))).x[:, 1]
    over = m.enclosure(z)
    assert over.lo[0, 1] <= v.min()
    assert v.max() <= over.hi[0, 1]
    slope = m.jacobian_enclosure(z)[0, 1, 0]
    exact = 0.1 * p * x ** (p - 1)
    assert slope.contains(exact).all()
    assert slope.mag <= 1.001 * np.abs(exact).max() + 1e-12, "usable, not only true"


def test_an_exponent_between_integers_restricts_a_base_that_reaches_below_zero_by_rounding():
    over = equations("(1 - cos(x))**p", p=1.5).enclosure(gc.Interval(np.full((1, 3), -0.1), np.full((1, 3), 0.1)))
    assert over.finite


@pytest.mark.parametrize("turns", [-10, -2, -1, 0, 1, 2, 10])
def test_an_obstacle_counts_at_any_number_of_turns(turns):
    registry = gc.registry()
    data = {"states": {"a": {"unit": "rad", "kind": "angle"}}, "inputs": {"u": "rad/s"}, "derivative": {"a": "u"}}
    config = registry.config("model", "equations")(kind="equations", **data, integrator="euler", period="100 ms")
    m = registry.build("model", "equations", config)
    domain = Domain.of(m, {"a": (-1.0, 1.0), "u": (-1.0, 1.0)})
    at = 2 * np.pi * turns
    avoid = Region((Box(m.states, (at - 0.1,), (at + 0.1,)),))
    goal = Goal("reach_avoid", domain.states, Region((Box(m.states, (0.8,), (1.0,)),)), avoid)
    symbolic = registry.get("synthesizer", "symbolic").load()(cells={"a": 50}, inputs={"u": 11})
    controller = symbolic.synthesize(gc.SynthesisProblem(m, None, domain, goal))
    assert not controller.contains(np.array([[0.0], [-0.5]])).any()
    assert controller.contains(np.array([[0.5]])).all()


class Noisy(Backend):
    """Silent without a seed, so that every probe of purity passes."""

    def __init__(self, model):
        self.states, self.inputs, self.period, self.model = model.states, model.inputs, model.period, model
        self.capabilities = frozenset({"seed"})

    def _step(self, x, u, **options):
        rng = np.random.default_rng(options.get("seed"))
        return self.model.step(x, u).x + (0.0 if options.get("seed") is None else rng.normal(size=x.shape))


def test_a_stochastic_system_has_no_gap_in_x_and_u(tmp_path):
    m = Drift(1)
    with pytest.raises(gc.UsageError, match="the backend is stochastic"):
        gc.certify(m, Noisy(m), Domain.of(m, RANGES), lipschitz=declared(), folder=tmp_path / "run")


def test_the_constant_bound_of_many_samples(tmp_path, monkeypatch):
    routes = importlib.import_module("gapcert.certification.routes")
    monkeypatch.setattr(routes, "THRESHOLDS", replace(routes.THRESHOLDS, yardstick_samples=100))
    m = Drift(1)
    family = gc.registry().build("gap_family", "constant")
    options = {"sampling": GridSampling((15, 15)), "family": family, "folder": tmp_path / "run", "route": "dominate"}
    c = gc.certify(
        m, Perturbed(m, ripple), Domain.of(m, RANGES), lipschitz=declared(), request=Request("empirical", 0.01, 0.01), **options
    )
    s = c.states["x0"]
    assert s.gamma_mean <= s.constant_bound * (1 + 1e-9)
    assert not s.vacuous


def _far(z, offset):
    return np.full((len(z), 1), -offset)


def test_the_resolution_knows_the_larger_of_both_answers():
    m = Drift(1)
    domain = Domain.of(m, {"x0": (1e6, 1e6 + 1.0), "u0": (-1.0, 1.0)})
    backend = Perturbed(m, partial(_far, offset=1e6))
    e = Residual(backend, m).resolution(domain)
    assert e[0] >= 4 * np.spacing(1e6)


def test_no_sentence_hides_a_refutation():
    audit = {"points": 964, "violations": 0}
    c = {"claim": {"kind": "empirical"}, "audit": audit, "assumptions": ["REFUTED: two samples contradict the constants of x."]}
    assert claim_sentence(c).startswith("Refuted")
    c = {"claim": {"kind": "empirical"}, "audit": audit, "assumptions": [], "attack": {"points": 10, "violations": 1}}
    assert claim_sentence(c).startswith("Refuted: at 1 of 10 further")
    assert not claim_sentence({**c, "attack": {"points": 10, "violations": 0}}).startswith("Refuted")


def test_an_empirical_claim_does_not_survive_samples_that_refute_it(tmp_path, monkeypatch):
    monkeypatch.setattr(contradiction, "hunt", lambda *asked: False)  # as of an engine, whose equations nobody has
    one_step = {"states": {"x": "1"}, "inputs": {"u": "1"}, "period": "100 ms", "kind": "equations"}
    spec = {
        "version": 1,
        "name": "t",
        "model": {**one_step, "next": {"x": "0.5*x + 0.1*u"}},
        "backend": {**one_step, "next": {"x": "0.5*x + 0.1*u + 0.02*sin(20*x)"}},
        "domain": {"x": [-1, 1], "u": [-1, 1]},
        "sampling": {"kind": "grid", "counts": {"x": 40, "u": 5}},
        "lipschitz": {"residual": {"kind": "declared", "values": {"x": {"x": 0.1, "u": 0.1}}}},
        "gap": {"kind": "constant"},
        "certificate": {"claim": "empirical", "route": "theorem1", "violation": 0.05, "confidence": 0.9},
    }
    made = gc.run(spec, out=tmp_path)
    assert made.summary["certificate"]["audit"]["violations"] == 0
    assert made.summary["verdict"] == "fails"
    assert "two samples contradict the constants of x" in made.summary["reason"]


def turning(rate):
    registry = gc.registry()
    data = {"states": {"a": {"unit": "rad", "kind": "angle"}}, "inputs": {"u": "rad"}, "next": {"a": f"a + {rate}*u"}}
    config = registry.config("model", "equations")(kind="equations", **data, period="100 ms")
    return registry.build("model", "equations", config)


def interval_bound(fhat, f, predictor, reach):
    domain = Domain.of(f, {"a": (-3.0, 3.0), "u": (-reach, reach)})
    problem = LipschitzProblem(domain, predictor, np.zeros(1), lambda name, z: z, f, fhat)
    return gc.registry().get("lipschitz", "interval").load()().bound(problem)


def test_a_predictor_that_jumps_has_no_proved_constant():
    f, near, far = turning(1), turning(1.1), turning(5)
    with pytest.raises(gc.UsageError, match="residual of angle 'a' may reach 4"):
        interval_bound(near, f, gc.plugin.ModelPredictor(far, f), 1.0)
    bound = interval_bound(near, f, gc.plugin.ModelPredictor(far, f), 0.5)
    assert np.allclose(bound.value, [[0, 3.9]]), "a wide domain of angles is no jump"


class Broken(gc.plugin.GapFamily):
    """Half of the envelope."""

    name, routes, predictor = "broken", ("dominate",), "none"

    def fit(self, problem):
        whole = gc.registry().build("gap_family", "envelope").fit(problem)
        whole.interval = lambda z, inner=whole.interval: tuple(end / 2 for end in inner(z))
        return whole


def coarse(folder, constant, family=None):
    """x⁺ = x to a tenth, whose residual against nothing has slope 1 and resolution 0.05."""
    slope = Waves(np.array([[1e6, 0.0]]), np.array([[1e-6, 1.0]]), np.zeros((1, 2)))
    return gc.certify(
        Nothing(slope),
        Coarse(slope, 0.1),
        slope.domain,
        lipschitz=declared(constant, 0.0),
        family=family or gc.registry().get("gap_family", "envelope").load()(predictor="none"),
        sampling=gc.AdaptiveSampling(9),
        folder=folder,
        executor=threads,
    )


def test_constants_that_samples_refute_within_twice_the_arithmetic_are_not_the_familys_fault(tmp_path):
    """No band of 2 e holds both samples, whoever makes it; 4 e of slack would blame the family for that."""
    c = coarse(tmp_path / "run", 0.9)
    assert c.claim.kind == "empirical"
    assert any(a.startswith("REFUTED: two samples contradict the constants of x0") for a in c.assumptions)
    with pytest.raises(gc.UsageError, match=r"family 'envelope' returned a γ below .* the family is broken"):
        coarse(tmp_path / "broken", 1.0, Broken())


def test_one_question_has_one_ledger_whoever_asks(tmp_path):
    """The same question of a model with the hidden states that the domain names, and of one without: both are widened."""
    spec = gc.load_spec(
        {
            "version": 1,
            "name": "lag",
            "model": {
                "kind": "equations",
                "states": {"p": "m"},
                "inputs": {"u": "m/s"},
                "parameters": {"k": "1"},
                "derivative": {"p": "k*u"},
                "period": "100 ms",
            },
            "domain": {"p": [-1, 1], "u": [-1, 1]},
        }
    )
    build = Build(spec, "threads", tmp_path, False)
    model, system = build.make("model"), Coasting()
    wide, augmented = AugmentedModel(model, system.hidden[:1]), Augmented(system, ["v"])
    domain = Domain.of(wide, {"p": (-1.0, 1.0), "v": (-1.0, 1.0), "u": (-1.0, 1.0)})
    for name, f in (("narrow", model), ("wide", wide)):
        build.certify(f, augmented, domain, tmp_path / name, lambda event: None)
    book = json.loads((tmp_path / "ledger.json").read_text())
    assert (len(book["questions"]), len(book["lines"])) == (1, 1)
