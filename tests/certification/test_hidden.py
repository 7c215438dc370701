"""Hidden state: probed, and then refused, left at its default under attack, drawn and bounded over, or made a state."""

from __future__ import annotations

import json

import numpy as np
import pytest
from faulty import Coasting

import gapcert as gc
from gapcert.certification.gates.augment import Augmented, AugmentedModel
from gapcert.certification.gates.hidden_distribution import HiddenDraws, Paired, Pool, Ranges, Visited, inputs, moved, visited
from gapcert.certification.gates.hidden_state import HiddenPlan, open_gate, spread
from gapcert.certification.routes import Request
from gapcert.certification.samples.executors import threads
from gapcert.numerics.intervals import Interval
from gapcert.testing import SystemContract
from gapcert.testing.systems import ToyOscillator
from gapcert_closed_loop.closed_loop import closed_loop
from gapcert_verify.verify import verify_run

MODEL = {
    "kind": "equations",
    "states": {"p": "m"},
    "inputs": {"u": "m/s"},
    "parameters": {"k": "1"},
    "derivative": {"p": "k*u"},
    "integrator": "euler",
    "period": "0.1 s",
}
RANGES = {"p": (-1.0, 1.0), "u": (-1.0, 1.0)}
SHARE = 0.05  # τ (1 − a) of Coasting: the residual against p⁺ = p + τ u is SHARE · (v − u)


@pytest.fixture(scope="module")
def model():
    return gc.load_spec({"version": 1, "name": "m", "model": MODEL}).build("model")


@pytest.fixture
def certify(tmp_path, model):
    def call(plan=None, ranges=RANGES, claim="statistical", **options):
        names = [n for n in ranges if n not in ("p", "u")]
        system = Augmented(Coasting(), names) if names else Coasting()
        wide = AugmentedModel(model, [s for s in system.states if s.name in names]) if names else model
        domain = gc.Domain.of(wide, ranges)
        options = {"request": Request(claim, 1e-2, 1e-3), "folder": tmp_path / "run", "executor": threads, **options}
        return gc.certify(model, Coasting(), domain, hidden=plan, **options)

    return call


# --- refuse


def test_hidden_state_that_matters_is_refused_with_two_answers_to_one_question(certify, model):
    with pytest.raises(gc.UsageError) as told:
        certify()
    text = str(told.value)
    assert "the backend depends on hidden state (v), so its gap is no function of (x, u): v moves p by 0.005" in text
    assert "as visited in rollouts they move p by" in text
    assert "wear" not in text
    for setting in ("hidden: augment", "{sample: {ranges: {v: [low, high]}}}", "{sample: {visited: {}}}"):
        assert setting in text
    # The witness is true: one (x, u), two hidden velocities, two answers.
    numbers = text[text.index("From (x, u)") :].replace("[", "").replace("]", "").replace(",", "").replace(";", "").split()
    values = [float(w) for w in numbers if w.lstrip("-").replace(".", "", 1).replace("e-", "").isdigit()]
    p, u, rest, v0, after, v1 = values[:6]
    for v, x in ((v0, rest), (v1, after)):
        out = Coasting().step(np.array([[p]]), np.array([[u]]), hidden=np.array([[v, 0.0]])).x[0, 0]
        assert out == pytest.approx(x, abs=1e-6)
    assert v0 != v1


class Worn(gc.Backend):
    """Carries a hidden number that nothing depends on."""

    def __init__(self):
        self.states, self.inputs, self.period = Coasting().states, Coasting().inputs, 0.1
        self.hidden, self.hidden_default, self.capabilities = (gc.StateSpec("wear"),), (0.0,), frozenset({"hidden"})

    def _step(self, x, u, **options):
        return gc.plugin.Step(x + 0.1 * u + 0.01 * u**2, options["hidden"] + 1)


def test_harmless_hidden_state_is_no_obstacle_and_is_told(model, tmp_path):
    c = gc.certify(model, Worn(), gc.Domain.of(model, RANGES), folder=tmp_path / "run", executor=threads)
    hidden = c.summary()["hidden"]
    assert (hidden["mode"], hidden["names"], hidden["harmless"]) == ("refuse", ["wear"], True)
    assert hidden["spread"] == {"p": 0.0}
    assert any("hidden state (wear) that does not matter" in a for a in c.assumptions)
    assert "distribution" not in c.claim.summary()


class Jammed(gc.Backend):
    """Sticks once a hidden counter has passed three: no small move of it alone shows that, rollouts do."""

    def __init__(self):
        self.states, self.inputs, self.period = Coasting().states, Coasting().inputs, 0.1
        self.hidden, self.hidden_default, self.capabilities = (gc.StateSpec("count"),), (0.0,), frozenset({"hidden"})

    def _step(self, x, u, **options):
        return gc.plugin.Step(np.where(options["hidden"] > 3, x, x + 0.1 * u), options["hidden"] + 1)


def test_hidden_state_that_matters_only_in_motion_is_found_in_rollouts(model, tmp_path):
    with pytest.raises(gc.UsageError, match=r"\(count\), so its gap .*: as visited in rollouts they move p by 0\.\d+\."):
        gc.certify(model, Jammed(), gc.Domain.of(model, RANGES), folder=tmp_path / "run", executor=threads)


# --- default: certified at rest, attacked in motion


def test_a_certificate_from_rest_is_refuted_in_motion_with_a_witness(certify):
    c = certify(HiddenPlan("default"))
    attack = c.summary()["hidden"]["attack"]
    assert not c.holds
    assert c.claim.kind == "empirical"
    assert attack["share"] > 0.3
    w = attack["witness"]
    (p, u), (v, _) = w["z"], w["hidden"]
    assert w["residual"] == pytest.approx(SHARE * (v - u), abs=1e-12)
    assert abs(w["residual"]) > w["gamma"] == pytest.approx(c.gamma(np.array([p]), np.array([u]))[0, 0])


def test_a_certificate_from_rest_holds_where_the_hidden_state_only_helps(certify):
    # |v − u| ≤ u for 0 ≤ v ≤ 1 and u ≥ 1/2.
    c = certify(HiddenPlan("default", {"v": (0.0, 0.0)}), {"p": (-1.0, 1.0), "u": (0.5, 1.0)})
    assert c.summary()["hidden"]["attack"]["violations"] == 0
    assert c.claim.summary()["distribution"] == "uniform on X × U, hidden state at its default"


# --- sample


def test_drawn_hidden_state_is_bounded_over(certify, tmp_path):
    c = certify(HiddenPlan("sample", {"v": (-1.0, 1.0)}, safety=1.0))
    hidden = c.summary()["hidden"]
    # sup over v of the half difference: SHARE · (1 − (−1)) / 2, attained at the vertices that are tried.
    assert hidden["bound"]["p"] == pytest.approx(SHARE, rel=1e-9)
    assert hidden["names"] == ["v"]
    assert c.claim.summary()["distribution"] == "uniform on X × U, hidden state uniform on v ∈ [-1, 1]"
    rng = np.random.default_rng(5)
    p, u, v = rng.uniform(-1, 1, (3, 20_000, 1))
    assert (np.abs(SHARE * (v - u)) <= c.gamma(p, u)).all()
    # Without the spread in the bound, the same samples and constants would be refuted at once.
    assert (np.abs(SHARE * (v - u)) > c.gamma(p, u) - 2 * SHARE).any()
    c.save(tmp_path / "run")
    assert verify_run(tmp_path / "run")["verdict"] == "holds"


def test_resolved_is_judged_against_arithmetic_alone(certify, tmp_path):
    c = certify(HiddenPlan("sample", {"v": (-1.0, 1.0)}))
    state = c.states["p"]
    assert c.problem.resolution[0] > state.gap_mean / 10 > 10 * c.problem.arithmetic[0]
    assert state.resolved
    assert state.tightness is not None


def test_constants_are_those_under_a_common_hidden_state(certify):
    # |∂r/∂p| = 0 and |∂r/∂u| = SHARE for every v; between two draws, slopes of up to 2 SHARE over 1 % of the width would show.
    value = certify(HiddenPlan("sample", {"v": (-1.0, 1.0)}), predictor="none").lipschitz.value[0]
    assert value[0] < 1e-9
    assert value[1] == pytest.approx(1.2 * SHARE, rel=1e-6)


def test_a_spread_that_is_too_small_is_found_by_the_audit(certify, monkeypatch):
    import gapcert.certification.gates.hidden_state as room

    monkeypatch.setattr(room, "spread", lambda *_: np.array([1e-3]))
    c = certify(HiddenPlan("sample", {"v": (-1.0, 1.0)}))
    assert c.audit.violations > 0
    assert c.claim.kind == "empirical"


def test_estimates_give_no_deterministic_claim(certify):
    declared = gc.registry().get("lipschitz", "declared").load()(values={"p": {"p": 0.0, "u": 0.05}})
    for plan in (HiddenPlan("sample", {"v": (-1.0, 1.0)}), HiddenPlan("default")):
        with pytest.raises(gc.UsageError, match=f"deterministic cannot be had with hidden: {plan.mode}"):
            certify(plan, claim="deterministic", lipschitz=declared)


def test_hidden_states_that_matter_need_ranges(certify):
    with pytest.raises(gc.UsageError, match=r"hidden.sample.ranges: no range for v, which matter"):
        certify(HiddenPlan("sample", {"wear": (0.0, 1.0)}))
    with pytest.raises(gc.UsageError, match=r"'w' is no hidden state of the backend; there are v, wear"):
        certify(HiddenPlan("sample", {"w": (0.0, 1.0)}))


def test_visited_states_are_those_of_rollouts(certify, model):
    c = certify(HiddenPlan("sample"))
    law = c.gate.law
    assert isinstance(law, Visited)
    # v⁺ = v/2 + u/2 from rest stays below 1, and is never again at rest.
    assert 0 < np.abs(law.pool.h[:, 0]).max() < 1
    assert (law.pool.h[:, 0] != 0).all()
    assert "8 nearest of" in c.claim.summary()["distribution"]
    assert len(law.extremes(law.pool.x[:3], 16)) == 8


def test_a_visited_law_takes_near_states_and_ignores_symmetric_axes():
    x = np.stack([np.repeat(np.linspace(0, 1, 10), 10), np.tile(np.linspace(0, 1, 10), 10)], axis=1)
    pool = Pool(x, x.copy())
    key = np.arange(50, dtype=np.uint64) * np.uint64(2**58)
    at = np.tile([[0.5, 0.95]], (50, 1))
    near = Visited(pool, np.ones(2), 3, ["a", "b"]).draw(key, at)
    assert np.abs(near - at).max() < 0.2
    assert len(np.unique(near, axis=0)) == 3
    free = Visited(pool, np.ones(2), 10, ["a", "b"], ("a",)).draw(key, at)
    assert (free[:, 1] > 0.85).all()
    assert np.ptp(free[:, 0]) > 0.5


def test_inputs_of_rollouts_keep_the_relations(model):
    wide = AugmentedModel(model, Coasting().hidden[:1])
    domain = gc.Domain.of(wide, {**RANGES, "v": (-1.0, 1.0)}, ["abs(u - v) <= 0.5 m/s"])
    x = domain.split(domain.draw(500, np.random.default_rng(0)))[0]
    u, inside = inputs(domain, np.vstack([x, [[0.0, 5.0]]]), np.random.default_rng(1))
    assert inside.tolist() == [True] * 500 + [False]
    assert (np.abs(u[:-1, 0] - x[:, 1]) <= 0.5).all()
    pool = visited(Augmented(Coasting(), ["v"]), domain, 30, 12, 0)
    assert domain.states.contains(pool.x).all()


def test_a_draw_depends_on_its_own_point_alone():
    system = Coasting()
    draws = HiddenDraws(system, Ranges(system, {"v": (-1.0, 1.0)}), 3)
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1, 1, (2, 5000, 1))
    h = draws.hidden_at(x, u)
    order = rng.permutation(len(x))
    np.testing.assert_array_equal(draws.hidden_at(x[order], u[order]), h[order])
    np.testing.assert_array_equal(draws.hidden_at(x[:1], u[:1]), h[:1])
    assert len(np.unique(h[:, 0])) == len(h)
    assert (h[:, 1] == 0).all()
    # Uniform on [−1, 1], and another one with another seed: 5000 draws, five standard deviations.
    assert abs(h[:, 0].mean()) < 5 / np.sqrt(3 * 5000)
    assert abs((h[:, 0] ** 2).mean() - 1 / 3) < 5 * np.sqrt(4 / 45 / 5000)
    other = HiddenDraws(system, draws.law, 4)
    assert abs(np.corrcoef(other.hidden_at(x, u)[:, 0], h[:, 0])[0, 1]) < 5 / np.sqrt(5000)
    assert other.digest() != draws.digest()


def test_pairs_have_one_hidden_state(model):
    system = Coasting()
    draws = HiddenDraws(system, Ranges(system, {"v": (-1.0, 1.0)}), 0)
    both = np.random.default_rng(0).uniform(-1, 1, (200, 4))
    np.testing.assert_allclose(Paired(model, draws)(both)[:, 0], -SHARE * (both[:, 3] - both[:, 1]), atol=1e-15)


def test_the_spread_is_half_the_largest_difference(model):
    system = Coasting()
    domain = gc.Domain.of(model, RANGES)
    for low, high in ((-1.0, 1.0), (0.2, 0.4), (0.0, 0.0)):
        found = spread(HiddenDraws(system, Ranges(system, {"v": (low, high)}), 0), domain, 0)
        assert found[0] == pytest.approx(SHARE * (high - low) / 2, abs=1e-12)


def test_audits_of_one_question_are_counted_over_all_plans(certify, tmp_path):
    plans = (HiddenPlan("sample", {"v": (-1.0, 1.0)}), HiddenPlan("sample", {"v": (-1.0, 1.0)}, safety=2.0))
    numbers = [certify(p, folder=tmp_path / str(i), ledger=tmp_path / "book.json").audit.k for i, p in enumerate(plans)]
    assert numbers == [1, 2]


def test_attacks_from_other_hidden_states_are_counted_and_draw_afresh(certify, tmp_path):
    made = [
        certify(HiddenPlan("default"), seed=seed, folder=tmp_path / str(i), ledger=tmp_path / "book.json")
        for i, seed in enumerate((0, 0, 1))
    ]
    attacks = [c.gate.attack for c in made]
    assert [(a["number"], a["book"]["kind"]) for a in attacks] == [(k, "hidden state") for k in (1, 1, 2)]
    assert attacks[0] == attacks[1]
    assert attacks[0]["witness"] != attacks[2]["witness"]


def test_another_law_is_another_audit_even_of_the_same_function(certify, tmp_path):
    laws = ({"v": (-1.0, 1.0)}, {"v": (-1.0, 1.0), "wear": (0.0, 1.0)})
    made = [
        certify(HiddenPlan("sample", law), folder=tmp_path / str(i), ledger=tmp_path / "book.json")
        for i, law in enumerate(laws)
    ]
    assert all(np.array_equal(v, made[1].gap.arrays()[k]) for k, v in made[0].gap.arrays().items())
    assert [c.audit.k for c in made] == [1, 2]


class Shadow(gc.Backend):
    """p⁺ = p + τ u + sin(3 h) / 50, h⁺ = p⁺: a hidden state that is known from x, all but."""

    def __init__(self):
        self.states, self.inputs = (gc.StateSpec("p", "m"),), (gc.StateSpec("u", "m/s"),)
        self.period, self.hidden, self.hidden_default = 0.1, (gc.StateSpec("h", "m"),), (0.0,)
        self.capabilities = frozenset({"hidden"})

    def _step(self, x, u, **options):
        p = x + 0.1 * u + 0.02 * np.sin(3 * options["hidden"])
        return gc.plugin.Step(p, p + 0.01 * u)


def test_visited_states_that_follow_x_are_told_and_refute_what_they_break(model, tmp_path):
    """Under a common hidden state nothing changes along x, and among near ones little: only the way from one to the other."""
    c = gc.certify(
        model,
        Shadow(),
        gc.Domain.of(model, RANGES),
        hidden=HiddenPlan("sample"),
        predictor="none",
        request=Request("statistical", 1e-2, 1e-3),
        folder=tmp_path / "run",
        executor=threads,
    )
    assert c.claim.kind == "empirical"
    assert not c.holds
    assert any("how the visited ones change with x has to lie within" in a for a in c.assumptions)
    assert any(a.startswith("REFUTED") for a in c.assumptions)


# --- augment


def test_augmented_states_are_states_everywhere(certify):
    c = certify(ranges={**RANGES, "v": (-1.0, 1.0)})
    hidden = c.summary()["hidden"]
    assert (hidden["mode"], hidden["names"], hidden["harmless"]) == ("augment", ["v"], True)
    assert list(c.states) == ["p", "v"]
    p, v, u = np.random.default_rng(0).uniform(-1, 1, (3, 5000, 1))
    gamma = c.gamma(np.hstack([p, v]), u)
    assert (np.abs(SHARE * (v - u))[:, 0] <= gamma[:, 0]).all()
    assert (np.abs(0.5 * (u - v))[:, 0] <= gamma[:, 1]).all()
    # p⁺ − f and v⁺ − v are affine: what is known exactly has no excess.
    assert c.states["p"].tightness < 1.001


def test_what_is_left_hidden_must_be_harmless(model, tmp_path):
    domain = gc.Domain.of(AugmentedModel(model, Coasting().hidden[1:]), {**RANGES, "wear": (0.0, 1.0)})
    with pytest.raises(gc.UsageError, match=r"domain: no range for v: add v: \[low, high\]"):
        gc.certify(model, Coasting(), domain, hidden=HiddenPlan("augment"), folder=tmp_path / "run", executor=threads)


def test_the_augmented_model_keeps_the_contracts_of_a_model(model):
    wide = AugmentedModel(model, Coasting().hidden)
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-1, 1, (50, 3)), rng.uniform(-1, 1, (50, 1))
    z = np.hstack([x, u])
    out = wide.step(x, u).x
    np.testing.assert_array_equal(out[:, 1:], x[:, 1:])
    slope = wide.jacobian(x, u)
    for j in range(4):
        step = z + 1e-6 * np.eye(4)[j]
        np.testing.assert_allclose((wide.step(step[:, :3], step[:, 3:]).x - out) / 1e-6, slope[:, :, j], atol=1e-8)
    box = Interval(z - 0.1, z + 0.1)
    inner = wide.step(*np.split(z + rng.uniform(-0.1, 0.1, z.shape), [3], axis=1)).x
    over = wide.enclosure(box)
    assert ((over.lo <= inner) & (inner <= over.hi)).all()
    slopes = wide.jacobian_enclosure(box)
    assert ((slopes.lo <= slope) & (slope <= slopes.hi)).all()
    assert "v⁺ = v" in wide.equations()


# --- contracts of the wrappers


class TestHiddenDraws(SystemContract):
    def system(self):
        system = ToyOscillator()
        return HiddenDraws(system, Ranges(system, {"lag": (-1.0, 1.0)}), 0)


class TestAugmented(SystemContract):
    def system(self):
        return Augmented(ToyOscillator(), ["lag"])


class TestPartlyAugmented(SystemContract):
    def system(self):
        return Augmented(Coasting(), ["wear"])


class TestAugmentedModel(SystemContract):
    def system(self):
        inner = gc.load_spec({"version": 1, "name": "m", "model": MODEL}).build("model")
        return AugmentedModel(inner, Coasting().hidden)


def test_probe_sizes_follow_ranges_units_and_rotations():
    class Free(gc.Backend):
        def __init__(self):
            self.states = self.inputs = ()
            self.hidden = (
                gc.StateSpec("q", "1", "quaternion"),
                gc.StateSpec("v", "m/s"),
                gc.StateSpec("n"),
                gc.StateSpec("w", "m"),
            )
            self.hidden_default = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

        def _step(self, x, u, **options):
            return x

    h = moved(Free(), 40, np.random.default_rng(0), {"w": (0.3, 0.7)})
    np.testing.assert_allclose(np.linalg.norm(h[:, :4], axis=1), 1)
    np.testing.assert_allclose(2 * np.arccos(h[:, 0]), 0.1)
    assert set(np.abs(h[:, 4])) == {0.1}
    assert set(np.abs(h[:, 5])) == {1.0}
    assert set(h[:, 6]) == {0.3, 0.7}
    assert (moved(Free(), 5, np.random.default_rng(0), only=("v",))[:, [0, 5, 6]] == [1, 0, 0]).all()


# --- closed loops


def test_loops_run_with_the_true_hidden_state_and_count_what_was_not_covered(model, tmp_path):
    domain = gc.Domain.of(model, RANGES)
    symbolic = gc.registry().get("synthesizer", "symbolic").load()(cells={"p": 40}, inputs={"u": 5})
    goal = gc.Goal("invariance", gc.Box(model.states, (-1.0,), (1.0,)))
    controller = symbolic.synthesize(gc.SynthesisProblem(model, None, domain, goal))
    system = Coasting()
    trace = {}
    for reach in (2.0, 0.1):
        law = Ranges(system, {"v": (-reach, reach)})
        trace[reach] = closed_loop(system, controller, np.zeros((20, 1)), 30, "random", 0, law)
    assert trace[2.0].visited > 100
    assert trace[2.0].strange == 0
    assert 0.3 < trace[0.1].strange / trace[0.1].visited <= 1
    # Beginning with a drawn velocity, not with that of rest.
    first = trace[2.0].x[:, 1, 0] - 0.05 * trace[2.0].u[:, 0, 0]
    assert len(np.unique(first)) == 20
    assert closed_loop(system, controller, np.zeros((20, 1)), 30, "random", 0).visited == 0
    gate = open_gate(model, system, domain, HiddenPlan("sample", {"v": (-1.0, 1.0)}), 0)
    assert json.dumps(gate.summary())


# --- what verification makes of it


def change(folder, **values):
    path = folder / "certificate.json"
    data = json.loads(path.read_text())
    for key, value in values.items():
        data[key] = {**data[key], **value}
    path.write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("values", "detail"),
    [
        ({"hidden": {"distribution": ""}}, "and the claim states 'uniform on X × U, hidden state uniform on v"),
        ({"claim": {"kind": "deterministic"}}, "a deterministic claim rests on drawn hidden states"),
        ({"hidden": {"attack": {"violations": 1}}}, "a statistical claim is refuted by its own evidence"),
    ],
)
def test_claims_that_forget_the_hidden_state_are_found_out(certify, tmp_path, values, detail):
    certify(HiddenPlan("sample", {"v": (-1.0, 1.0)})).save(tmp_path / "run")
    change(tmp_path / "run", **values)
    failed = [c["detail"] for c in verify_run(tmp_path / "run")["checks"] if not c["passed"]]
    assert any(detail in text for text in failed)
