"""Parameters that are learned: the truth stays in Θ, tubes tighten, every promise is kept, and lies are told of."""

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from gapcert import Domain, Goal, Interval, SynthesisProblem, UsageError, closed_loop, load_controller, load_spec
from gapcert_cells.testing import Band, Rod, rod_problem
from gapcert_closed_loop.closed_loop import compare_loops
from gapcert_closed_loop.prediction import summary
from gapcert_figures.data import loop_figure
from gapcert_mpc.controller import MpcController
from gapcert_mpc.synthesizer import Mpc
from gapcert_mpc.task import STARTS
from gapcert_mpc.variants.adaptive import Levels
from gapcert_mpc.variants.parameters import Family, Membership, built
from gapcert_report.pictures.control import learned_pictures
from gapcert_report.words.words import learned_sentence

SPEC = Path(__file__).parents[2] / "specs" / "pendulum_adaptive.yaml"
WIDE = np.array([1e-4, 3e-3])
SECTION = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "parameters": {"m": {"value": "1 kg", "tolerance": "30 %"}, "l": "1 m", "g": "9.81 m/s^2"},
    "derivative": {"theta": "omega", "omega": "-3*g/(2*l)*sin(theta) + 3*torque/(m*l**2)"},
    "integrator": "semi_implicit",
    "period": "20 ms",
}


@cache
def rods():
    return built(SECTION)


def problem(gap=None):
    ranges = {"theta": (-0.3, 0.3), "omega": (-1.0, 1.0), "torque": (-2.0, 2.0)}
    domain = Domain.of(rods(), ranges)
    stay = Domain.of(rods(), ranges | {"theta": (-0.2, 0.2)}).states
    return SynthesisProblem(rods(), Band(-WIDE, WIDE) if gap is None else gap, domain, Goal("invariance", stay))


@pytest.fixture(scope="module")
def controller():
    return Mpc(horizon=10, reference={"theta": 0.05}, solver="osqp", adapt={"m": [0.7, 1.4]}).synthesize(problem())


def vertices(x, u, truth, rng):
    return rng.choice([-1.0, 1.0], size=x.shape) * WIDE


def hidden(x, u, truth, rng):
    """As much as γ allows towards the motion of a rod of 0.9 kg, so that the step says least."""
    other = rods().step(x, u, parameters={"m": np.full(len(x), 0.9)}).x - rods().step(x, u, parameters={"m": truth}).x
    return np.clip(other, -WIDE, WIDE)


def played(c, truth, steps, gap, seed=0, extra=1.0):
    """Runs of plants with these masses: (Θ per step, memory, steps that broke the promise)."""
    rng = np.random.default_rng(seed)
    stay = c.goal.stay
    x = np.asarray(stay.low) + (np.asarray(stay.high) - np.asarray(stay.low)) * rng.random((2 * len(truth), 2))
    x = x[c.contains(x)][: len(truth)]
    memory, thetas, broken = c.start(x), [], 0
    for k in range(steps):
        memory = c.advance(x, memory) if k else memory
        broken += int((~c.keeps(x, memory) | ~c.goal.holds(x)).sum())
        thetas.append(c.theta(memory))
        u = c.respond(x, memory, "first")
        # The float that the plant gives is within γ of f as it is computed; both are rounded.
        after = rods().step(x, u, parameters={"m": truth}).x + extra * (1 - 1e-12) * gap(x, u, truth, rng)
        broken += int((~c.kept(x, u, after, memory)).sum())
        x = after
    return thetas, memory, broken


@pytest.mark.exam
@pytest.mark.parametrize("gap", [vertices, hidden])
def test_the_truth_stays_the_range_shrinks_and_no_promise_breaks(controller, gap):
    truth = np.repeat([0.7, 1.13, 1.4], 8)
    thetas, memory, broken = played(controller, truth, 8, gap)
    assert broken == 0
    assert controller.evidence["terminal_margin"] > 0
    for before, after in pairwise(thetas):
        assert (before.lo <= after.lo).all()
        assert (after.hi <= before.hi).all()
    assert all((t.lo[:, 0] <= truth).all() and (truth <= t.hi[:, 0]).all() for t in thetas)
    width = (thetas[-1].hi - thetas[-1].lo)[:, 0]
    assert np.median(width) < (0.05 if gap is vertices else 0.4)
    assert not any("refuted" in controller.told(int(n)) for n in memory)
    # Plans are of the levels, and a run's Θ lies in its level's box.
    boxes = [controller.levels.box(controller.runs[int(n)].key) for n in memory]
    assert all((b.lo <= t.lo).all() and (t.hi <= b.hi).all() for b, t in zip(boxes, thetas[-1], strict=False))
    assert len({controller.runs[int(n)].key for n in memory}) > 2


@pytest.mark.exam
def test_an_update_without_the_width_of_the_gap_loses_the_truth(controller):
    narrow = Membership(replace(controller.levels.family, problem=problem(Band(-0.3 * WIDE, 0.3 * WIDE))))
    x, u, rng = np.array([[0.05, 0.1]] * 50), np.full((50, 1), 0.8), np.random.default_rng(1)
    truth = rng.uniform(0.8, 1.3, 50)
    after = rods().step(x, u, parameters={"m": truth}).x + vertices(x, u, truth, rng)
    theta = Interval(np.full((50, 1), 0.7), np.full((50, 1), 1.4))

    def held(membership):
        found, refuted = membership.updated(x, u, after, theta)
        return ((found.lo[:, 0] <= truth) & (truth <= found.hi[:, 0]) & ~refuted).mean()

    assert held(narrow) == 0.0
    assert held(Membership(controller.levels.family)) == 1.0


def test_a_tube_without_the_parameters_is_broken(controller):
    family = controller.levels.family
    frozen = Mpc(horizon=10, reference={"theta": 0.05}).synthesize(
        replace(problem(), model=family.at(family.centre(family.range)))
    )
    x = np.random.default_rng(7).uniform([-0.15, -0.5], [0.15, 0.5], (20, 2))
    truth = np.where(np.arange(20) % 2 == 0, 0.7, 1.4)

    def kept(c):
        memory = c.start(x)
        u = c.respond(x, memory, "first")
        return c.kept(x, u, rods().step(x, u, parameters={"m": truth}).x, memory)

    assert not kept(frozen).all()
    assert kept(controller).all()


def test_a_gap_that_lies_is_told_of(controller):
    _, memory, _ = played(controller, np.full(10, 1.0), 6, vertices, extra=4.0)
    told = [controller.told(int(n)) for n in memory]
    lies = [t for t in told if "refuted" in t]
    assert lies
    assert all("the gap or the range is wrong" in t["refuted"] for t in lies)
    # From there on the range stays as it was.
    held = [controller.runs[int(n)] for n in memory]
    assert all(h.theta.lo <= h.theta.hi for h in held)


def test_a_plant_outside_the_range_is_told_of(controller):
    _, memory, _ = played(controller, np.full(10, 2.0), 3, vertices)
    assert all("refuted" in controller.told(int(n)) for n in memory)


def test_the_domain_grows_as_less_is_unknown():
    def fraction(low, high):
        plain = Mpc(horizon=10, reference={"theta": 0.1}, solver="osqp", majorant="constant")
        made = plain.synthesize(family.within(Interval(np.array([low]), np.array([high]))))
        return made.evidence["domain_fraction"]

    p = problem()
    stay = Domain.of(rods(), {"theta": (0.0, 0.2), "omega": (-1.0, 1.0), "torque": (-2.0, 2.0)}).states
    family = Family.of(replace(p, goal=Goal("invariance", stay)), {"m": [0.6, 1.4]})
    found = [fraction(*ends) for ends in ((0.6, 1.4), (1.25, 1.35))]
    assert found == sorted(found)
    assert found[-1] > found[0] + 0.05


@pytest.mark.parametrize("asked", [{"m": [0.7, 1.4]}, {"m": [0.7, 1.4], "l": [0.9, 1.2]}])
def test_the_difference_over_boxes_holds_at_points_nobody_sampled(asked):
    p = problem()
    family, rng = Family.of(p, asked), np.random.default_rng(2)
    size = p.domain.high - p.domain.low
    low = p.domain.low + size * 0.98 * rng.random((40, 3))
    boxes, whole = Interval(low, low + 0.02 * size), family.range
    centre = family.centre(whole)
    over, model = family.moved(boxes, centre, whole), family.at(centre)
    beyond = 0
    for k in range(60):
        z = boxes.lo + (boxes.hi - boxes.lo) * rng.random(boxes.shape)
        ends = np.where(rng.random((40, len(asked))) < 0.5, whole.lo, whole.hi)
        theta = ends if k % 2 else rng.uniform(whole.lo, whole.hi, (40, len(asked)))
        given = dict(zip(asked, theta.T, strict=True))
        moved = rods().step(z[:, :2], z[:, 2:], parameters=given).x - model.step(z[:, :2], z[:, 2:]).x
        assert ((over.lo <= moved + 1e-12) & (moved - 1e-12 <= over.hi)).all()
        beyond += int(((0.75 * over.lo > moved) | (moved > 0.75 * over.hi)).sum())
    # With one parameter it is not much wider than need be: less would not hold.
    assert beyond > 0 or len(asked) > 1


def test_hundreds_of_plants_keep_their_truth_to_rounding(controller):
    membership, rng = Membership(controller.levels.family), np.random.default_rng(6)
    truth = np.concatenate([[0.7, 1.4], rng.uniform(0.7, 1.4, 298)])
    theta = Interval(np.full((300, 1), 0.7), np.full((300, 1), 1.4))
    for k in range(12):
        x, u = rng.uniform([-0.3, -1.0], [0.3, 1.0], (300, 2)), rng.uniform(-2.0, 2.0, (300, 1))
        kick = hidden(x, u, truth, rng) if k % 3 == 2 else vertices(x, u, truth, rng)
        after = rods().step(x, u, parameters={"m": truth}).x + (1 - 1e-12) * kick
        theta, refuted = membership.updated(x, u, after, theta)
        assert not refuted.any()
        assert ((theta.lo[:, 0] <= truth) & (truth <= theta.hi[:, 0])).all()
    assert np.median(theta.hi - theta.lo) < 1e-6


def test_two_parameters_and_turns_of_the_angle():
    family = Family.of(problem(), {"m": None, "l": "20 %"})
    assert family.range.lo.tolist() == pytest.approx([0.7, 0.8])
    assert family.range.hi.tolist() == pytest.approx([1.3, 1.2])
    membership, rng = Membership(family), np.random.default_rng(3)
    truth = rng.uniform(family.range.lo, family.range.hi, (60, 2))
    theta = Interval(np.tile(family.range.lo, (60, 1)), np.tile(family.range.hi, (60, 1)))
    for _ in range(8):
        x, u = rng.uniform([-0.3, -1.0], [0.3, 1.0], (60, 2)), rng.uniform(-2.0, 2.0, (60, 1))
        after = rods().step(x, u, parameters={"m": truth[:, 0], "l": truth[:, 1]}).x + (1 - 1e-12) * vertices(x, u, truth, rng)
        turn = 2 * np.pi * np.array([1.0, 0.0])
        turned, _ = membership.updated(x + turn, u, after - turn, theta)
        theta, refuted = membership.updated(x, u, after, theta)
        assert not refuted.any()
        assert ((theta.lo <= truth) & (truth <= theta.hi)).all()
        assert np.abs(turned.lo - theta.lo).max() < 1e-6
        assert ((turned.lo <= truth) & (truth <= turned.hi)).all()
    assert (np.median(theta.hi - theta.lo, axis=0) < 0.7 * (family.range.hi - family.range.lo)).all()


def test_outside_the_domain_nothing_is_learned(controller):
    membership, theta = Membership(controller.levels.family), Interval(np.array([[0.7]]), np.array([[1.4]]))
    x, u = np.array([[0.5, 0.0]]), np.array([[1.0]])
    found, refuted = membership.updated(x, u, x + 10.0, theta)
    assert not refuted.any()
    assert found.lo == 0.7
    assert found.hi == 1.4


def test_levels_hold_what_they_are_for():
    levels = Levels(Family.of(problem(), {"m": [0.7, 1.4]}), {}, 6, Mpc().for_box)
    rng, whole = np.random.default_rng(4), levels.family.range
    for _ in range(200):
        key, theta = levels.first, whole
        for _ in range(8):
            ends = np.sort(rng.uniform(theta.lo, theta.hi, 2))
            theta = Interval(np.maximum(theta.lo, ends[:1]), np.minimum(theta.hi, ends[1:]))
            key = levels.key(theta, key)
            box = levels.box(key)
            assert (box.lo <= theta.lo).all()
            assert (theta.hi <= box.hi).all()
            assert (whole.lo <= box.lo).all()
            assert (box.hi <= whole.hi).all()
            if 0 < key[0][0] < 6:
                assert (box.hi - box.lo < 1.3 * (whole.hi - whole.lo) / 2 ** key[0][0]).all()


def test_saved_and_loaded_it_learns_alike(controller, tmp_path):
    """Bit by bit over runs that come to levels of their own; the evidence and the digest are the same."""
    controller.save(tmp_path)
    loaded = load_controller(tmp_path)
    assert loaded.digest() == controller.digest()
    assert dict(loaded.evidence) == dict(controller.evidence)
    x = controller.draw(5, np.random.default_rng(4))[:5]
    first, then = (closed_loop(rod(1.2), c, x, 6) for c in (controller, loaded))
    assert len(loaded.levels.made) > 1
    for part in ("x", "u", "fallbacks"):
        assert np.array_equal(getattr(first, part), getattr(then, part))
    assert np.array_equal(first.learned["m"], then.learned["m"])
    assert (np.ptp(then.learned["m"][:, -1], axis=1) < 0.35).all()


@pytest.mark.exam
def test_with_lines_along_its_plans_it_is_saved_and_loaded_too(tmp_path, monkeypatch):
    monkeypatch.setitem(STARTS, "successive", 8)
    options = {"linearisation": "successive", "solver": "piqp", "reference": {"theta": 0.05}, "adapt": {"m": [0.8, 1.3]}}
    made = Mpc(horizon=8, **options).synthesize(problem())
    made.save(tmp_path)
    loaded = load_controller(tmp_path)
    x = made.draw(3, np.random.default_rng(0))[:2]
    first, then = (closed_loop(rod(1.2), c, x, 5) for c in (made, loaded))
    assert len(loaded.levels.made) > 1
    assert np.array_equal(first.u, then.u)
    assert np.array_equal(first.learned["m"], then.learned["m"])


def test_a_saved_controller_with_other_options_is_refused(controller, tmp_path):
    controller.save(tmp_path)
    data = json.loads((tmp_path / "controller.json").read_text())
    data["adapt"]["options"]["horizon"] = 11
    (tmp_path / "controller.json").write_text(json.dumps(data))
    with pytest.raises(UsageError, match="do not belong together"):
        load_controller(tmp_path)


@pytest.mark.parametrize(
    ("forged", "told"),
    [
        ({"object": "subprocess:Popen", "has": {"args": {"list": ["true"]}}}, "names subprocess:Popen"),
        ({"object": "gapcert.__main__:sys", "has": {}}, "names gapcert.__main__"),
        ({"object": "gapcert_dask.plugin:Hooks", "has": {}}, "names gapcert_dask"),
        ({"object": "gapcert.intervals:Interval", "has": {}}, "its gap is no GapFunction"),
    ],
)
def test_a_file_names_no_other_class(controller, tmp_path, forged, told):
    controller.save(tmp_path)
    data = json.loads((tmp_path / "controller.json").read_text())
    data["kept"] = {"items": [["gap", forged] if key == "gap" else [key, value] for key, value in data["kept"]["items"]]}
    (tmp_path / "controller.json").write_text(json.dumps(data))
    with pytest.raises(UsageError, match=told):
        load_controller(tmp_path)


def test_what_is_no_data_is_loaded_without_learning(controller, tmp_path, monkeypatch):
    monkeypatch.setattr("gapcert_mpc.variants.adaptive.pair", lambda *_, **__: None)
    controller.save(tmp_path)
    loaded = load_controller(tmp_path)
    assert isinstance(loaded, MpcController)
    assert loaded.digest() == controller.first.digest()
    assert loaded.learned(loaded.start(np.zeros((1, 2)))) is None


def test_a_run_tells_what_it_has_learned(controller):
    x = np.array([0.05, 0.0])
    u, info = controller.step(x)
    assert controller.told(int(info.memory[0]))["parameters"]["m"] == [0.7, 1.4]
    after = rods().step(x[None], u[None], parameters={"m": 1.3}).x
    _, info = controller.step(after[0], info.memory)
    low, high = controller.told(int(info.memory[0]))["parameters"]["m"]
    assert info.feasible
    assert 0.7 < low <= 1.3 <= high <= 1.4
    # What is foreseen begins at the state and stays in the goal.
    at, least, most = controller.predicted(after[0], info.memory)
    assert np.array_equal(at[0], after[0])
    assert controller.goal.holds(least).all()
    assert controller.goal.holds(most).all()
    with pytest.raises(UsageError, match="no plan begins"):
        controller.respond(x[None], np.array([0]), "first")


def rod(m):
    return built(SECTION | {"parameters": SECTION["parameters"] | {"m": f"{m} kg"}})


def test_a_closed_loop_tells_what_its_runs_have_learned(controller):
    """Step by step in the trace, in the summary in words, and as a picture with the model's own value."""
    loop = compare_loops(rod(1.2), controller, controller, starts=6, steps=4, policies=["first"])
    ends = loop.with_gamma.learned["m"]
    assert ends.shape == (6, 5, 2)
    assert (ends[:, 0] == [0.7, 1.4]).all()
    memory = controller.start(loop.with_gamma.x[:, 0])
    for k in range(1, 5):
        memory = controller.advance(loop.with_gamma.x[:, k], memory)
        assert np.array_equal(ends[:, k, 0], controller.theta(memory).lo[:, 0])
        assert np.array_equal(ends[:, k, 1], controller.theta(memory).hi[:, 0])
    told = loop.summary()["learned"]["m"]
    assert told["first"] == [0.7, 1.4]
    assert told["last"] == [ends[:, -1, 0].min(), ends[:, -1, 1].max()]
    assert told["left"] == pytest.approx(np.diff(ends[:, -1]).mean() / 0.7)
    assert (told["left"] < 0.5, told["refuted"]) == (True, 0)
    assert "m was 0.7 to 1.4 at first and" in learned_sentence(loop.summary())
    figure = loop_figure(loop, rod(1.2), controller, controller)
    (known,) = figure.learned
    assert (known.name, known.unit, known.stated) == ("m", "kg", 1.2)
    assert (known.hull[-1] == told["last"]).all()
    (picture,) = learned_pictures(figure)
    assert "0.7 to 1.4 kg when one run began" in picture.caption
    assert "m [kg]" in picture.svg


@pytest.mark.exam
def test_runs_that_refute_the_range_are_counted(controller):
    x = closed_loop(rod(1.2), controller, controller.draw(4, np.random.default_rng(2))[:4], 3).x[:, 0]
    trace = closed_loop(rod(2.0), controller, x, 3, workers=2)
    assert np.isnan(trace.learned["m"]).any()
    told = summary(trace.x, trace.learned)
    assert told["m"]["refuted"] == 4
    said = learned_sentence({"learned": told})
    assert "In 4 runs no value makes all steps that were seen: γ or the range is wrong" in said


def test_without_a_gap_nothing_is_learned():
    made = Mpc(horizon=10, reference={"theta": 0.05}, adapt={"m": [0.7, 1.4]}).synthesize(replace(problem(), gap=None))
    assert isinstance(made, MpcController)
    assert made.wins


def test_a_range_that_is_too_wide_says_so():
    made = Mpc(horizon=10, adapt={"m": [0.05, 5.0]}).synthesize(problem())
    assert isinstance(made, MpcController)
    assert not made.wins
    assert made.evidence["reason"]


@pytest.mark.parametrize(
    ("adapt", "words"),
    [
        ({"mass": None}, "'mass' is no parameter; expected some of m, l, g"),
        ({"g": None}, "expected a range of some width"),
        ({"m": [1.4, 0.7]}, "found 1.4 to 0.7 kg"),
        ({"m": "1 s"}, "controller.adapt.m: unit 's' does not fit"),
        ({"m": "few %"}, "controller.adapt.m"),
    ],
)
def test_what_cannot_be_learned_is_refused(adapt, words):
    p = problem()
    with pytest.raises(UsageError, match=words):
        Mpc(adapt=adapt).check(p.model, p.domain, p.goal)


def test_a_model_without_equations_is_refused():
    p = rod_problem()
    with pytest.raises(UsageError):
        Mpc(adapt={"m": None}).check(Rod(), p.domain, p.goal)


@pytest.mark.exam
def test_a_rod_in_bullet_that_is_heavier_than_its_data_sheet(tmp_path):
    pytest.importorskip("pybullet")
    from gapcert.contracts.plugins.events import silent
    from gapcert.run.build import Build

    spec = load_spec(SPEC, ["certificate.attack=0", "sampling.executor=threads", "sampling.budget=150", "gap.kind=constant"])
    build = Build(spec, None, tmp_path, False)
    model = build.make("model")
    backend, domain = build.against(model)
    gap = build.certify(model, backend, domain, tmp_path, silent).gap
    c = build.make("controller").synthesize(SynthesisProblem(model, gap, domain, spec.goal(domain)))
    x = c.draw(20, np.random.default_rng(0))[:10]
    trace = closed_loop(backend, c, x, 25)
    assert not trace.violation.any()
    assert not trace.broken.any()
    theta = c.theta(np.array(list(c.runs.kept)[-10:]))
    assert ((theta.lo <= 1.3) & (theta.hi >= 1.3) & (theta.hi - theta.lo < 0.15)).all()
