"""Plants of another hand: their integrator against the equations that a user would write, and cases that are what they say."""

from dataclasses import replace

import numpy as np
import pytest
from exams import plain, play, score, sit, store
from exams.hidden.laws import Hidden
from exams.hidden.plain import NAMES, RUN, plant

import gapcert as gc
from gapcert_diagnosis.testing import equations


def exact(name, excitation="multisine", seed=3):
    """A single run of a plant that is as it is stated."""
    for k in range(30):
        rng = np.random.default_rng([seed, k])
        r = plain.rig(plant(name, rng), excitation, rng)
        if (r.begins == RUN).sum() == 1:
            r = replace(r, stated=r.true)
            return replace(r, u=r.u[:400], noise=r.noise[:400], reference=r.reference[:400], begins=r.begins[:400])
    raise AssertionError


def simulated(r, u, found=None, hidden=None):
    model = equations({**r.section, "substeps": r.sub})
    if found is not None:
        numbers = dict(zip([p.name for p in found.named(hidden.site, model)], hidden.numbers.values(), strict=True))
        extension = found.extension(hidden.site, model)
        model = model.extend(
            [replace(extension, parameters=tuple(replace(p, value=numbers[p.name]) for p in extension.parameters))]
        )
    x = model.rollout(r.starts[:1], u[None, :-1, None]).x[0]
    return model.output(x, u[:, None])


@pytest.mark.parametrize("name", [n for n in NAMES if n != "strut"])
def test_plants_move_as_their_equations_say(name):
    r = exact(name)
    _, y, u = r.play()
    assert np.abs(simulated(r, u) - y).max() < 0.05 * r.noise.std(axis=0).min()


def test_a_strut_feels_the_speed_that_is_played():
    r = exact("strut")
    _, y, v = r.play()
    k, c, dry, soft = r.true
    x = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * r.period)])
    assert np.allclose(y[:, 0], x, atol=1e-9)
    assert np.allclose(y[:, 1], k * x + c * v + dry * np.tanh(v / soft), rtol=1e-6, atol=1e-6 * y[:, 1].std())
    late = r.play((Hidden("input-delay", "v", {"delay": 3 * r.period}),))[1]
    assert np.allclose(late[3:, 1], y[:-3, 1], atol=1e-3 * y[:, 1].std())


@pytest.mark.parametrize(
    ("name", "effect", "numbers"),
    [
        ("motor", "coulomb-friction", {"level": 40.0}),
        ("wheel", "quadratic-drag", {"coefficient": 0.5}),
        ("heater", "external-push", {"force": 0.02, "time": 300.0, "duration": 200.0}),
        ("rc", "input-delay", {"delay": 0.004}),
        ("rlc", "input-lag", {"time_constant": 0.02}),
        ("cylinder", "input-rate-limit", {"rate": 30.0}),
        ("twin", "supply-sag", {"sag": 3.0, "time_constant": 0.5}),
        ("tank", "sensor-scale", {"scale": 1.1}),
        ("tanks", "external-push", {"force": 1e-3, "time": 200.0, "duration": 100.0}),
        ("oven", "input-gain", {"gain": 1.2}),
    ],
)
def test_effects_act_as_the_library_writes_them(name, effect, numbers):
    r = exact(name)
    site = plain.places(effect, r.plant, r.view)[0]
    hidden = Hidden(effect, site, numbers)
    _, y, u = r.play((hidden,))
    still = r.play()[1]
    found = gc.registry().build("effect", effect)
    assert np.abs(simulated(r, u, found, hidden) - y).max() < 0.02 * np.abs(still - y).max()


def test_a_case_is_a_function_of_its_seed_and_index():
    a, b, other = (plain.single("t", seed, 3) for seed in (1, 1, 2))
    assert a.question() == b.question()
    one, two = (c.recording().trajectories[0].channels for c in (a, b))
    assert all(np.array_equal(one[n], two[n]) for n in one)
    assert a.hidden[0].numbers != other.hidden[0].numbers


@pytest.mark.exam
def test_of_a_pair_each_is_clear_beside_the_other():
    case = plain.pair("t", 1, 2)
    one, two = case.hidden
    assert case.label == "clear"
    assert two.key not in plain.alike(case.rig, one)
    judge = plain.Judge(case.rig, case.hidden)
    assert judge.fit(case.hidden)[0] - judge.own < 9
    for other in case.hidden:
        _, paid, remains = judge.fit((other,))
        assert remains >= case.remains
        assert remains >= 1 or paid >= 25
    assert len(case.question()["classes"]) == 2


def test_in_loops_a_controller_sees_what_it_holds_and_every_fifth_has_nothing():
    cases = [plain.looped("t", 1, 5 * k + 4) for k in range(10)]
    assert [c.index for c in cases] == list(range(4, 54, 5))
    assert {c.rig.plant.name for c in cases} == set(NAMES) - {"strut"}
    for c in cases:
        assert c.hidden == ()
        assert c.rig.excitation.startswith("feedback")
        assert c.rig.plant.shown[0] in c.rig.view


@pytest.mark.exam
def test_clear_cases_are_as_strong_as_they_say():
    for index in (3, 8, 14, 18):
        case = plain.single("t", 1, index)
        judge = plain.Judge(case.rig, case.hidden)
        assert case.label == "clear"
        assert judge.strength() == pytest.approx(case.strength)
        assert case.strength >= 5
        assert judge.fit(case.hidden)[0] - judge.own < 9
        assert case.remains >= 1 or judge.fit()[1] >= 25


def test_what_no_data_could_tell_apart_is_one_class():
    r = exact("wheel")
    keys = plain.alike(r, Hidden("input-gain", "u", {"gain": 1.3}))
    assert set(keys) == {("input-gain", "u"), ("sensor-scale", "v"), ("parameter", "K")}
    judge = plain.Judge(r, (Hidden("input-gain", "u", {"gain": 1.3}),))
    for said in (Hidden("sensor-scale", "v", {"scale": 1.2}), Hidden("parameter", "K", {"value": 1.2 * r.true[0]})):
        assert judge.stands((said,), 1)[0]
    assert not judge.stands((Hidden("input-offset", "u", {"offset": 1.0}),), 1)[0]


def test_under_feedback_the_input_comes_from_what_was_measured():
    r = exact("wheel", "feedback")
    _, y, u = r.play()
    column = r.view[0]
    proportional, _, _, middle, half, _ = r.law
    asked = middle + proportional * (r.reference[0] - y[0, r.plant.shown.index(column)] - r.noise[0, 0])
    assert u[0] == pytest.approx(np.clip(asked, middle - half, middle + half))
    assert not np.array_equal(u, r.play(noisy=False)[2])


def test_answers_keep_the_commit(tmp_path, capsys):
    kept = tmp_path / "answers.jsonl"
    kept.write_text('{"part": "plain", "seed": 1, "index": 0, "commit": "abc"}\n')
    assert [r["commit"] for r in store.sittings(print, [("plain", 1, 0, 1.0)], 1, kept)] == ["abc"]


def test_a_doubtful_case_is_played_on_from_a_start_under_a_held_input():
    case = plain.doubtful("t", 1, 0)
    assert case.label == "clear"
    assert case.rig.excitation in plain.POOR
    start, u = 0.5 * case.rig.play(case.hidden)[0].mean(axis=0), np.full((50, 1), 0.3 * case.rig.u.max())
    second = case.given(u, start, float(u[0, 0]), 10)
    x, _, played = second.rig.play(second.hidden)
    assert np.array_equal(x[0], start)
    assert np.array_equal(played, u[:, 0])
    assert np.allclose(second.rig.noise.std(axis=0), case.rig.noise.std(axis=0), rtol=0.5)
    assert not np.array_equal(second.rig.noise, case.given(u, start, 0.0, 11).rig.noise)


def test_an_experiment_has_resolved_what_it_promised_to_and_no_more():
    named = {"verdict": "causes", "causes": [{"effect": "a", "site": "q"}], "ambiguous_with": [[["c", "q"]]]}
    asked = {"hidden": [{"effect": "a", "site": "q"}], "members": [["a", "q"], ["b", "q"], ["c", "q"]], "designed": named}
    asked["apart"] = [{"rival": ["b", "q"]}]
    assert score.open_question(asked)
    assert not score.open_question(asked | {"apart": []})
    assert score.resolved(asked)
    assert not score.resolved(asked | {"apart": [{"rival": ["b", "q"]}, {"rival": ["c", "q"]}]})
    assert not score.resolved(asked | {"hidden": [{"effect": "b", "site": "q"}]})


def test_what_has_a_form_that_contains_a_hidden_effect_is_taken_out_with_it():
    rest = sit.without([["input-gain", "u"]])
    assert not {"input-gain", "input-nonlinearity"} & set(rest)
    assert {"input-dead-zone", "sensor-scale"} <= set(rest)


def test_of_a_pair_what_fits_as_well_with_as_few_numbers_may_be_named():
    hidden = [
        {"effect": "a", "site": "u", "numbers": {"level": 1.0, "soft": 1.0}},
        {"effect": "b", "site": "u", "numbers": {"w": 2.0}},
    ]
    said = [{"effect": n, "site": "u", "numbers": {"k": 1.0}} for n in ("a", "c")]
    r = {"hidden": hidden, "causes": said, "classes": [[["a", "u"]], [["b", "u"]]], "verdict": "causes", "stands": True}
    assert score.both_or_as_well(r)
    assert not score.both(r)
    assert not score.both_or_as_well(r | {"stands": False})
    assert not score.both_or_as_well(r | {"causes": [*said, said[1] | {"effect": "d"}]})
    assert not score.both_or_as_well(r | {"causes": [said[0], said[1] | {"numbers": {"k": 1.0, "l": 1.0}}]})


@pytest.mark.exam
def test_what_is_promised_of_an_experiment_is_found_when_it_is_played():
    r = play.experiment(2002, 7, 120.0)
    assert score.open_question(r)
    assert score.resolved(r)
    assert r["beyond"] < 0.02
    assert all(p["found"] == pytest.approx(p["promised"], rel=0.3) for p in r["apart"])


@pytest.mark.exam
def test_a_curve_gives_way_to_a_lag_that_no_screen_shows_beside_a_push():
    said = plain.ask(plain.pair("plain-pairs", 5103, 3), 300.0)
    assert said["verdict"] == "causes"
    assert {c["effect"] for c in said["causes"]} == {"external-push", "input-lag"}
