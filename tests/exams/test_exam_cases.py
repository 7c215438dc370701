"""Exam cases are what they say: reproducible, clear or faint by their definitions, with classes that theory knows."""

from dataclasses import replace

import numpy as np
import pytest
from exams.hidden import draw
from exams.hidden.laws import Hidden, Tables
from exams.hidden.log import coloured, logged, soil
from exams.hidden.plants import PENDULUM, PLANTS, TOLERANCE
from exams.hidden.rig import EXCITATIONS, rig
from exams.hidden.truth import Truth

from gapcert import UsageError

SMALL = ("pendulum", "drive")


@pytest.mark.exam
def test_a_case_is_a_function_of_its_seed_and_index():
    a, b, c = (draw.single("t", seed, 3, SMALL) for seed in (1, 1, 2))
    assert a.hidden == b.hidden
    assert a.noise == b.noise
    one, other = (case.recording().trajectories[0].channels for case in (a, b))
    assert all(np.array_equal(one[n], other[n]) for n in (*one, *other))
    assert a.hidden[0].numbers != c.hidden[0].numbers


def test_true_parameters_are_within_half_the_tolerance_of_the_stated():
    for k in range(5):
        made = rig("arm", "chirp", 0.01, 3.0, np.random.default_rng(k))
        stated = np.array([v for v, _ in made.plant.stated.values()])
        assert (np.abs(made.parameters / stated - 1) <= TOLERANCE / 2).all()


@pytest.mark.exam
@pytest.mark.parametrize("name", PLANTS)
def test_excitations_stay_in_the_room_that_a_machine_has(name):
    for kind in EXCITATIONS:
        made = rig(name, kind, 0.01, 4.0, np.random.default_rng(1))
        x = made.play().x[:, : made.plant.n]
        assert np.isfinite(x).all()
        assert kind == "tracking" or (np.ptp(x, axis=0) <= made.plant.room).all()


@pytest.mark.exam
@pytest.mark.parametrize("faint", [False, True])
def test_labels_are_those_of_the_definition(faint):
    for index in range(3):
        case = draw.single("labels", 1, index, SMALL, faint=faint)
        truth = Truth(case.rig, case.hidden, case.noise.sigma)
        assert truth.strength() == pytest.approx(case.strength, rel=1e-6)
        assert truth.remains() == pytest.approx(case.remains, rel=1e-6)
        assert truth.share() == pytest.approx(case.share, rel=1e-6)
        assert (case.label == "clear") == (case.strength >= 5 and case.remains >= 1 and case.share >= 0.02)
        assert case.label == ("faint" if faint else "clear")


def test_the_share_of_the_effort_is_what_the_law_says():
    made, noise = draw.setting("drive", np.random.default_rng(4), ("multisine",))
    still = made.play()
    force = np.sqrt(np.mean(still.u**2))
    for hidden in (Hidden("constant-force", "q", {"force": 0.1 * force}), Hidden("input-gain", "F", {"gain": 1.1})):
        # The effort counts twice: what the mass takes and what the input gives.
        assert Truth(made, (hidden,), noise.sigma).share() == pytest.approx(0.1 / np.sqrt(2), rel=0.03)
    assert Truth(made, (Hidden("sensor-bias", "q", {"bias": 0.1}),), noise.sigma).share() == 1


def test_a_stronger_effect_is_clearer():
    made, noise = draw.setting("pendulum", np.random.default_rng(4), ("multisine",))
    sizes = [
        Truth(made, (Hidden("viscous-friction", "q", {"coefficient": c}),), noise.sigma).strength() for c in (0.05, 0.1, 0.2)
    ]
    assert sizes[0] < sizes[1] < sizes[2] < 4 * sizes[0]


@pytest.mark.exam
@pytest.mark.parametrize(
    ("plant", "hidden", "others"),
    [
        ("drive", Hidden("constant-force", "q", {"force": 2.0}), {("input-offset", "F"), ("gravity-tilt", "q")}),
        ("pendulum", Hidden("gravity-tilt", "q", {"angle": 0.2}), {("sensor-bias", "q")}),
        ("pendulum", Hidden("input-delay", "u", {"delay": 0.03}), {("sensor-delay", "q")}),
        ("pendulum", Hidden("coulomb-friction", "q", {"level": 0.15}), set()),
        ("drive", Hidden("parameter", "mass", {"value": 5.0}), {("payload", "q"), ("input-gain", "F"), ("sensor-scale", "q")}),
    ],
)
def test_classes_are_those_that_theory_knows(plant, hidden, others):
    made = rig(plant, "multisine", 0.01, 8.0, np.random.default_rng(2))
    # A delay is told from a lag by what is fast and small.
    noise = draw.noise(made, 0.003 if hidden.effect == "input-delay" else 0.01, both=False)
    (found,) = Truth(made, (hidden,), noise.sigma).classes(np.random.default_rng(0))
    assert found[0] == hidden.key
    assert set(found[1:]) == others


def test_noise_has_the_deviation_and_the_colour_that_it_should():
    made = rig("drive", "chirp", 0.002, 10.0, np.random.default_rng(1))
    motion, rng = made.play(), np.random.default_rng(0)
    noise = draw.noise(made, 0.01, both=True, colour=0.8)
    assert noise.sigma["q"] == pytest.approx(0.01 * np.std(motion.x[:, 0]), rel=1e-3)
    table = logged(made, motion, noise, {}, rng)
    for j, name in enumerate(("q", "q_dot")):
        assert np.std(table[name] - motion.x[:, j]) == pytest.approx(noise.sigma[name], rel=0.1)
    e = coloured(20_000, 0.8, rng)
    assert np.std(e) == pytest.approx(1, rel=0.05)
    assert np.corrcoef(e[1:], e[:-1])[0, 1] == pytest.approx(0.8, abs=0.03)


def test_dirt_is_dirt():
    made = rig("drive", "chirp", 0.01, 10.0, np.random.default_rng(1))
    table = logged(made, made.play(), draw.noise(made, 0.01, both=False), {}, np.random.default_rng(0))

    def dirty(kind):
        return soil(table, (kind,), ("F",), np.random.default_rng(2))

    assert len(dirty("dropouts")["t"]) < 0.99 * len(table["t"])
    assert np.diff(dirty("gap")["t"]).max() > 0.14
    assert np.isnan(dirty("nan")["q"]).sum() == len(table["t"]) // 50
    assert (np.diff(dirty("reset")["t"]) < 0).sum() == 1
    far = np.abs(dirty("outliers")["q"] - table["q"]) > 4 * np.std(table["q"])
    assert far.sum() == len(table["t"]) // 200


def test_jitter_moves_samples_and_inputs_alike():
    case = draw.single("jitter", 1, 0, SMALL, dirt=("jitter",))
    t = case.recording().trajectories[0].t
    steps = np.diff(t) / case.rig.period
    assert np.abs(steps - 1).max() > 0.2
    assert steps.min() > 0


@pytest.mark.exam
def test_pairs_are_two_clear_effects_of_different_kinds():
    case = draw.pair("pairs", 1, 0, SMALL)
    a, b = case.hidden
    assert draw.family(a.effect) != draw.family(b.effect)
    for h in case.hidden:
        assert replace(case, hidden=(h,)).label == "clear"
        assert Truth(case.rig, (h,), case.noise.sigma).strength() >= 5


def test_nothing_is_hidden_in_nothing():
    cases = [draw.nothing("nothing", 1, k) for k in range(40)]
    assert all(c.hidden == () for c in cases)
    assert len({(c.step, c.scheme) for c in cases}) == 3
    assert {c.noise.colour for c in cases} == {0.0, 0.5, 0.8, 0.9}
    assert {c.engine for c in cases} > {None}


def test_what_cannot_be_hidden_is_refused():
    tables = Tables.of(PENDULUM, np.ones(3))
    with pytest.raises(UsageError, match=r"cannot hide 'magic'; it knows viscous-friction"):
        tables.hide((Hidden("magic", "q", {}),))
    with pytest.raises(UsageError, match=r"viscous-friction cannot act at 'u'; there are q"):
        tables.hide((Hidden("viscous-friction", "u", {"coefficient": 1.0}),))
