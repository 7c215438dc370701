"""What a search must not fall for: each case here once gave a wrong name, an extra one, or none."""

import math
from dataclasses import replace

import numpy as np
import pytest
from exams.hidden.draw import single

import gapcert as gc
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.experiment import Limits, told_apart
from gapcert_diagnosis.fitting.fit import fit, followed
from gapcert_diagnosis.search import alternatives, gains
from gapcert_diagnosis.search import screening as screen
from gapcert_diagnosis.search.alternatives import answered, flags
from gapcert_diagnosis.search.candidates import Library
from gapcert_diagnosis.search.criterion import keys, richer
from gapcert_diagnosis.search.fitted_sets import FittedSets
from gapcert_diagnosis.search.moves import spared, swaps
from gapcert_diagnosis.search.stepwise import EquationSearch, drop_unconfirmed, search_windows
from gapcert_diagnosis.search.visible import smallest
from gapcert_diagnosis.testing import ROD, equations

T, PERIOD = 1400, 0.01
LOOSE = {**ROD, "parameters": {**ROD["parameters"], "m": {"value": "1 kg", "tolerance": "2 %"}}}
TWO = {
    "kind": "equations",
    "coordinates": {"a": {"unit": "rad", "kind": "angle"}, "b": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m", "w": "N*m"},
    "parameters": {"g": "9.81 m/s^2", "J": "0.4 kg*m^2", "k": "0.12 kg*m^2"},
    "mass_matrix": [["J + 2*k*cos(b)", "k*(0.6 + cos(b))"], ["k*(0.6 + cos(b))", "0.6*k"]],
    "bias": {"a": "0.3*kg_m*g*sin(a)", "b": "0.1*kg_m*g*sin(a + b)"},
    "forces": {"a": "u", "b": "w"},
    "period": "10 ms",
}
TWO["parameters"]["kg_m"] = "1 kg*m"
EVERY = [gc.registry().build("effect", name) for name in gc.registry().names("effect")]


def find(name):
    return next(e for e in EVERY if e.name == name)


def simulated(section, hidden=(), noise=1e-3, seed=0, u=None, colour=0.0, hold="zero", channels=None, changed=None):
    """A model, and data of the same with effects (name, site, numbers), at a tenth of its step."""
    model, fine = equations(section), equations({**section, "substeps": 10})
    extensions = []
    for name, site, numbers in hidden:
        extension = find(name).extension(site, fine)
        known = dict(zip((p.name for p in extension.parameters), numbers, strict=True))
        parts = tuple(gc.Parameter(p.name, known[p.name], p.unit, low=p.low, high=p.high) for p in extension.parameters)
        extensions.append(gc.plugin.Extension(**{**vars(extension), "parameters": parts}))
    truth = fine.extend(extensions) if extensions else fine
    if u is None:
        u = np.concatenate([multisine(T * PERIOD, PERIOD, 2.0, (0.2, 2.5), 4 + i) for i in range(model.nu)], axis=1)
    acting = u if hold == "zero" else 0.5 * (u + np.vstack([u[1:], u[-1:]]))
    x0 = np.full((1, model.nx), 0.0)
    x0[0, 0] = 0.3
    x = truth.fast_rollout(x0, acting[None, :-1], parameters=changed).x[0]
    y = truth.output(x, u)
    rng = np.random.default_rng(seed)
    table = {}
    for name in channels or model.coordinates:
        e = rng.standard_normal(len(y))
        for k in range(1, len(e) if colour else 0):
            e[k] = colour * e[k - 1] + math.sqrt(1 - colour**2) * e[k]
        table[name] = y[:, [s.name for s in model.outputs].index(name)] + noise * e
    table |= {s.name: u[:, i] for i, s in enumerate(model.inputs)}
    return model, gc.Recording.of(np.arange(len(u)) * PERIOD, table)


def prepared(model, recording, effects=EVERY, length=110):
    library = Library(model, Dataset.of(model, recording), effects)
    return library, library.measured.windows(length)


def named(model, recording, effects=EVERY):
    library, windows = prepared(model, recording, effects)
    search, found = search_windows(library, windows)
    return answered(search, found, windows)


def names(answer):
    return [c.effect.name for c in answer.causes]


@pytest.mark.exam
@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("coulomb-friction", (0.06,)),
        ("stribeck-friction", (0.08, 1.0, 0.4)),
        ("asymmetric-coulomb-friction", (0.05, 0.12)),
        ("load-dependent-friction", (0.06,)),
        ("asymmetric-viscous-friction", (0.03, 0.08)),
    ],
)
def test_one_law_of_a_family_does_not_crowd_out_the_others_and_nested_ones_are_told_apart(name, numbers):
    model, recording = simulated(LOOSE, [(name, "q", numbers)])
    answer = named(model, recording)
    assert names(answer) == [name]
    found = [answer.fit.values[n] for n in answer.search.library.names(answer.causes[0])]
    assert found[0] == pytest.approx(numbers[0], rel=0.1)
    for tie, _ in answer.ties:
        assert not answer.search.library.contains(tie[0].effect.name, name)


def test_what_hides_in_the_stated_values_is_screened_by_its_prior():
    section = {**LOOSE, "parameters": {**LOOSE["parameters"], "l": {"value": "1 m", "tolerance": "2 %"}}}
    model, recording = simulated(section, changed={"m": 1.25})
    library, windows = prepared(model, recording)
    search = FittedSets(library, windows)
    _, long = search.promises(((), search.nothing))
    (mass,) = (s for s in long if keys(s.move) == {("parameter", "m")})
    assert mass.gain > library.charge()
    assert mass.values["m"] == pytest.approx(1.25, rel=0.1)
    answer = named(model, recording)
    assert {("parameter", "m")} in [keys(answer.causes), *(keys(t) for t, _ in answer.ties)]


def test_a_number_at_its_bound_does_not_hide_a_law_from_the_screen():
    section = {**LOOSE, "parameters": {**LOOSE["parameters"], "l": {"value": "1 m", "tolerance": "2 %"}}}
    model, recording = simulated(section, changed={"m": 1.25})
    library, windows = prepared(model, recording)
    search = FittedSets(library, windows)
    bounds = search.nothing.hypothesis
    assert ((search.nothing.theta == bounds.low) | (search.nothing.theta == bounds.high)).any()
    _, long = search.promises(((), search.nothing))
    (gain,) = (s.gain for s in long if keys(s.move) == {("input-gain", "u")})
    assert gain > 1000


def test_a_level_that_only_later_data_reach_is_found_there():
    u = 0.6 * multisine(T * PERIOD, PERIOD, 1.0, (0.2, 2.5), 4)
    u[round(0.6 * T) :] *= 4  # the last quarter is held out, and the quarter of the rest before it judges what was found
    answer = named(*simulated(LOOSE, [("input-saturation", "u", (1.2,))], u=u[:, :1]))
    assert names(answer) == ["input-saturation"]
    assert answer.fit.values["input_saturation_u"] == pytest.approx(1.2, rel=0.05)


def test_inside_its_tolerance_a_parameter_is_no_cause():
    assert not named(*simulated(LOOSE, changed={"m": 1.015})).causes


@pytest.mark.parametrize("level", [0.12, 1.2])
@pytest.mark.exam
def test_a_saturation_far_below_what_was_asked_is_found(level):
    answer = named(*simulated(LOOSE, [("input-saturation", "u", (level,))]))
    assert names(answer) == ["input-saturation"]
    assert answer.fit.values["input_saturation_u"] == pytest.approx(level, rel=0.02)


def test_a_needle_between_two_starts_is_found_by_a_local_scan(monkeypatch):
    model, recording = simulated(LOOSE, [("cogging", "q", (0.3, 0.0901, 0.7))], noise=2e-4)
    library, windows = prepared(model, recording, [find("cogging"), find("viscous-friction")])

    def best():
        search = FittedSets(library, windows)
        (promised,) = (s for s in search.promises(((), search.nothing))[0] if s.move[0].effect.name == "cogging")
        return promised

    closer = best()
    assert closer.values["cogging_q_period"] == pytest.approx(0.0901, rel=0.01)
    monkeypatch.setattr(screen, "THRESHOLDS", replace(screen.THRESHOLDS, scanned_moves=0))
    assert best().gain < closer.gain


@pytest.mark.parametrize(("colour", "seed"), [(0.5, 1), (0.9, 2)])
def test_coloured_noise_is_not_friction(colour, seed):
    model, recording = simulated(LOOSE, colour=colour, seed=seed, noise=2e-3, channels=("q", "q_dot"))
    assert not named(model, recording).causes


def test_a_cause_below_one_per_cent_of_the_effort_is_listed_and_not_named():
    model, recording = simulated(LOOSE, [("viscous-friction", "q", (0.004,))], noise=3e-4)
    library, windows = prepared(model, recording)
    search, found = search_windows(library, windows)
    assert found[0] == ()
    (key, share) = next((k, s) for k, s in search.negligible.items() if k[0] == "viscous-friction")
    assert key == ("viscous-friction", "q")
    assert 0.001 < share < screen.THRESHOLDS.least_effort


@pytest.mark.exam
def test_a_hold_that_is_not_declared_is_found_on_the_final_model():
    hidden = [("coulomb-friction", "q", (0.06,))]
    for hold in ("zero", "first"):
        u = multisine(T * PERIOD, PERIOD, 4.0, (1.0, 8.0), 4)
        model, recording = simulated(LOOSE, hidden, hold=hold, u=u, noise=2e-4)
        library, windows = prepared(model, recording)
        search, found = search_windows(library, windows)
        assert [c.effect.name for c in found[0]] == ["coulomb-friction"]
        assert (search.windows.measured.hold or "zero") == hold


def test_later_data_judge_the_whole_set_and_then_each_member():
    model, recording = simulated(LOOSE, [("coulomb-friction", "q", (0.03,)), ("cubic-spring", "q", (1.5,))])
    library, windows = prepared(model, recording)
    earlier, later = windows.guard()
    search = FittedSets(library, earlier)
    best = EquationSearch(search).forward()
    assert {c.effect.name for c in best[0]} == {"coulomb-friction", "cubic-spring"}
    assert drop_unconfirmed(search, best, later)[0] == best[0]
    # The same data, with what the later ones say turned round: a law that helped only early is dropped.
    table = dict(recording.trajectories[0].channels)
    plain = simulated(LOOSE, [("cubic-spring", "q", (1.5,))])[1].trajectories[0].channels
    later_start = 1000  # where the guard begins
    table["q"] = np.concatenate([table["q"][:later_start], plain["q"][later_start:]])
    mixed = gc.Recording.of(np.arange(T) * PERIOD, table)
    library, windows = prepared(model, mixed)
    earlier, later = windows.guard()
    search = FittedSets(library, earlier)
    both = search.fit(best[0], None, best[1].values)
    assert [c.effect.name for c in drop_unconfirmed(search, (best[0], both), later)[0]] == ["cubic-spring"]


@pytest.mark.exam
def test_teeth_far_finer_than_the_range_are_found_and_their_side_lobes_are_not():
    """A motor with 5 teeth per turn, over some 45 of them, at up to a third of one per sample."""
    spindle = {
        **ROD,
        "parameters": {"J": {"value": "2e-3 kg*m^2", "tolerance": "4 %"}, "b": "0.02 N*m*s/rad"},
        "mass_matrix": [["J"]],
        "bias": {"q": "b*q_dot"},
    }
    u = 0.9 * multisine(T * PERIOD, PERIOD, 1.0, (0.1, 0.7), 8)
    hidden = [("cogging", "q", (0.15, 2 * np.pi / 5, 0.4))]
    model, log = simulated(spindle, hidden, noise=1e-3, seed=5, u=u)
    assert 40 < np.ptp(log.trajectories[0].channels["q"]) * 5 / (2 * np.pi) < 60
    answer = named(model, log, [find(n) for n in ("cogging", "coulomb-friction", "external-push", "cubic-spring")])
    assert keys(answer.causes) == {("cogging", "q")}
    assert answer.fit.values["cogging_q_period"] == pytest.approx(2 * np.pi / 5, rel=1e-3)
    assert abs(answer.fit.values["cogging_q_amplitude"]) == pytest.approx(0.15, rel=0.03)


@pytest.mark.exam
@pytest.mark.parametrize(("one", "two"), [(0.15, 0.07), (0.07, 0.15)])
def test_waves_of_one_map_are_one_cause_whichever_is_the_strongest(one, two):
    parameters = {"J": {"value": "2e-3 kg*m^2", "tolerance": "4 %"}, "b": "0.02 N*m*s/rad"}
    spindle = {**ROD, "parameters": parameters, "mass_matrix": [["J"]], "bias": {"q": "b*q_dot"}}
    teeth = {"A": f"{one} N*m", "B": f"{two} N*m"}
    toothed = {"parameters": parameters | teeth, "bias": {"q": "b*q_dot - A*sin(2*q + 0.4) - B*sin(4*q + 1.0)"}}
    u = 0.9 * multisine(T * PERIOD, PERIOD, 1.0, (0.1, 0.7), 8)
    _, log = simulated({**spindle, **toothed}, noise=1e-3, seed=5, u=u)
    answer = named(equations(spindle), log, [find(n) for n in ("cogging", "coulomb-friction", "cubic-spring")])
    assert [c.told for c in answer.causes] == [("cogging", "q")]
    (c,) = answer.causes
    numbers = {p.name: answer.fit.values[n] for n, p in answer.library.parameters(c).items()}
    period = numbers["period"] * (2.0 if c.effect.name == "cogging-halves" else 1.0)
    assert period == pytest.approx(np.pi, rel=1e-3)
    shown = c.effect.canonical(numbers)
    assert [shown[f"amplitude_{k}"] for k in (1, 2)] == [pytest.approx(a, rel=0.05) for a in (one, two)]
    assert shown["amplitude_3"] < 0.01


def test_a_number_that_reaches_the_length_of_the_data_is_told_so():
    model, log = simulated(ROD, [("supply-sag", "u", (0.2, 400.0))], noise=1e-3, seed=2)
    library, windows = prepared(model, log, [find("supply-sag")])
    (c,) = library.candidates
    high = library.bounds(c)[1][1]
    assert high == pytest.approx((T - 1) * PERIOD)
    h = library.hypothesis((c,))
    ended = fit(h, windows, theta=h.theta(dict(zip(library.names(c), (0.4, high), strict=True))), iterations=0)
    assert f"{high:.4g} s is as long as the data, which tell no longer one from it" in flags(library, c, ended)[0]


def test_a_push_that_blows_up_says_nothing_and_breaks_nothing(monkeypatch):
    model, recording = simulated(LOOSE, [("viscous-friction", "q", (0.05,))])
    library, windows = prepared(model, recording, [find("viscous-friction"), find("quadratic-drag")])
    search = FittedSets(library, windows)
    pushed = screen.Screen.pushed

    def wild(self, c, rows):
        push = pushed(self, c, rows)
        state = push.state * (1e300 if c.effect.name == "quadratic-drag" else 1.0)
        return gains.Push(push.candidate, push.values, state, push.output)

    monkeypatch.setattr(screen.Screen, "pushed", wild)
    _, long = search.promises(((), search.nothing))
    assert long[0].move[0].effect.name == "viscous-friction"
    assert [s.gain for s in long if s.move[0].effect.name == "quadratic-drag"] == [0.0]


def test_the_same_law_at_all_joints_is_one_move():
    hidden = [("coulomb-friction", "a", (0.05,)), ("coulomb-friction", "b", (0.02,))]
    model, recording = simulated(TWO, hidden)
    library, windows = prepared(model, recording, [find("coulomb-friction"), find("viscous-friction"), find("input-gain")], 80)
    moves = [tuple(c.key for c in m) for m in library.moves]
    assert (("coulomb-friction", "a"), ("coulomb-friction", "b")) in moves
    search = FittedSets(library, windows)
    both = next(s for s in search.promises(((), search.nothing))[1] if len(s.move) == 2)
    assert keys(both.move) == set(moves[-3])
    search, found = search_windows(library, windows)
    assert keys(found[0]) == {("coulomb-friction", "a"), ("coulomb-friction", "b")}
    assert found[1].values["coulomb_friction_b"] == pytest.approx(0.02, rel=0.1)


def test_equal_explanations_are_named_by_the_simplest_and_no_experiment_is_promised():
    answer = named(*simulated(LOOSE, [("input-offset", "u", (0.2,))]))
    assert [c.key for c in answer.causes] == [("constant-force", "q")]
    assert {("input-offset", "u")} in [keys(t) for t, _ in answer.ties]
    library = answer.search.library
    limits = Limits.of(library.model, library.measured)
    ties = [t for t in answer.ties if keys(t[0]) == {("input-offset", "u")}]
    design, apart, _ = told_apart(answer.causes, answer.fit, ties, library.measured, limits)
    assert design is None
    assert apart == (False,)


def test_a_sensor_that_rounds_is_read_off_its_values():
    model, recording = simulated(LOOSE, [("viscous-friction", "q", (0.1,))], noise=1e-4)
    tr = recording.trajectories[0]
    table = {**tr.channels, "q": np.round(tr.channels["q"] / 0.02) * 0.02}
    found = gc.diagnose(model, gc.Recording.of(tr.t, table), ["viscous-friction", "coulomb-friction", "sensor-quantisation"])
    assert found.verdict == "causes"
    assert [c.effect for c in found.causes] == ["viscous-friction", "sensor-quantisation"]
    assert found.causes[0].parameters["coefficient"].value == pytest.approx(0.1, rel=0.1)
    assert found.causes[1].parameters["resolution"].value == pytest.approx(0.02)
    assert found.causes[1].explained > 0.3
    assert "round" in found.extended_model.equations()
    assert found.residual["q"].noise_floor == pytest.approx(0.02 / math.sqrt(12), rel=0.1)
    assert not prepared(model, recording)[0].seen


def test_what_would_have_been_seen_is_of_the_size_that_is_seen():
    model, recording = simulated(LOOSE)
    library, windows = prepared(model, recording)
    search = FittedSets(library, windows)
    least = next(s for s in smallest(search) if s.effect == "viscous-friction")
    assert least.unit == "N*m/(rad/s)"
    for factor, seen in ((3.0, True), (0.3, False)):
        _, hidden = simulated(LOOSE, [("viscous-friction", "q", (factor * least.value,))])
        search = FittedSets(*prepared(model, hidden))
        (c,) = (c for c in library.candidates if c.effect.name == "viscous-friction")
        found, nothing = ((c,), search.fit((c,), ((), search.nothing))), ((), search.nothing)
        assert (search.pays(found, nothing) and search.matters(found)) == seen


def test_values_that_are_not_plausible_are_flagged():
    model, recording = simulated(LOOSE, changed={"m": 0.35})
    library, windows = prepared(model, recording, [find("parameter")])
    search = FittedSets(library, windows)
    (c,) = library.candidates
    (flag,) = flags(library, c, search.fit((c,), ((), search.nothing)))
    assert flag.startswith("implausible: value = 0.3")


def test_a_factor_with_the_wrong_sign_asks_for_the_convention():
    model, recording = simulated(LOOSE, [("input-gain", "u", (-1.05,))])
    library, windows = prepared(model, recording, [find("input-gain")])
    search = FittedSets(library, windows)
    (c,) = library.candidates
    (flag,) = flags(library, c, search.fit((c,), ((), search.nothing)))
    assert flag.startswith("implausible: gain = -1.05")
    assert flag.endswith("; is the sign of u in the log the other way round than in the model?")


def test_the_same_again_is_the_same():
    model, recording = simulated(LOOSE, [("coulomb-friction", "q", (0.06,))])
    one, two = (named(model, recording) for _ in range(2))
    assert [c.key for c in one.causes] == [c.key for c in two.causes]
    assert one.fit.theta.tolist() == two.fit.theta.tolist()


@pytest.mark.exam
def test_a_joint_that_sticks_for_most_of_the_time_is_dry():
    # One slip in 15 s: a screen along the measured path sees neither a speed nor a force, and offers springs and gains.
    case = single("singles", 20261123, 66)
    answer = named(equations(case.model), case.recording().split({"last": 0.25})[0])
    assert set(names(answer)) <= {"coulomb-friction", "stribeck-friction"}


WAYS = {
    "kind": "equations",
    "states": {"x": "m", "y": "m"},
    "inputs": {"u": "m/s", "w": "m/s"},
    "derivative": {"x": "u + w", "y": "u - w"},
    "period": "10 ms",
}


def test_where_samples_cannot_be_counted_a_law_is_weighed_at_all_its_sites_at_once():
    """A sag that the library lacks makes the fit rough: windows agree on two lags together, and on neither alone."""
    hidden = [(e, s, n) for s in "uw" for e, n in (("input-rate-limited-lag", (3.0, 0.06)), ("supply-sag", (0.2, 1.0)))]
    model, recording = simulated(WAYS, hidden, noise=1e-5, channels=("x", "y"))
    effects = [find(n) for n in ("input-rate-limit", "input-lag", "input-rate-limited-lag")]
    library, windows = prepared(model, recording, effects)
    search = FittedSets(library, windows)
    rich, plain = (tuple(c for c in library.candidates if c.effect.name == e.name) for e in (effects[2], effects[0]))
    found = plain, search.fit(plain, None, {library.names(c)[0]: 3.0 for c in plain})
    assert found[1].rough
    for search.cautious in (False, True):
        options = {keys(new): start for new, start in swaps(search, found)}
        assert {keys((rich[0], plain[1])), keys((plain[0], rich[1]))} <= set(options)
        assert (keys(rich) in options) == search.cautious
    # The sites start where they were, each with its own rate.
    start = options[keys(rich)]
    assert [start[library.names(c)[0]] for c in rich] == [found[1].values[library.names(c)[0]] for c in plain]
    assert spared(search, rich, (plain[0], rich[1]))
    assert not spared(search, rich, plain)
    assert not spared(search, plain, (rich[0], plain[1]))
    assert richer([found[1]], True, spared=True) < richer([found[1]], True)
    # From here it is the step at both sites that pays; what it finds at one of them stays.
    assert rich[0] in EquationSearch(search).refine(found)[0]


def test_a_larger_set_must_pay_for_itself_on_whatever_path_it_was_found():
    """It may fit better than samples explain, as a stand-in for a law that the library lacks does, and take too little away."""
    u = multisine(4 * T * PERIOD, PERIOD, 2.0, (0.2, 2.5), 4)
    hidden = [("viscous-friction", "q", [0.3]), ("coulomb-friction", "q", [0.03])]
    library, windows = prepared(*simulated(ROD, hidden, noise=8e-3, u=u))
    search, (viscous, dry) = (
        FittedSets(library, windows),
        (next(c for c in library.candidates if c.key[0] == h[0]) for h in hidden),
    )
    few = (viscous,), search.fit((viscous,), None)
    more = (viscous, dry), search.fit((viscous, dry), few)
    assert search.better(more[1], few[1]) > library.charge()
    assert not EquationSearch(search).outdoes(more, few)
    assert EquationSearch(search).outdoes(few, ((), search.nothing))


def test_a_law_is_looked_for_beside_a_number_whose_prior_hides_it():
    """Of what a factor of 1.24 does, a resistance that is a fifth off hides so much that neither pays without the other."""
    section = {"kind": "equations", "integrator": "rk4", "states": {"v": "V"}, "inputs": {"u": "V"}, "period": "10 ms"}
    stated = {"R": {"value": "1 ohm", "tolerance": "2 %"}, "C": {"value": "0.12 F", "tolerance": "2 %"}}
    section |= {"derivative": {"v": "(u - v)/(R*C)"}, "parameters": stated}
    u = np.repeat(np.random.default_rng(5).uniform(-1, 1, T // 20), 20)[:, None]
    wrong = ("sensor-scale", "v", (1.24,)), {"R": np.array([1.2])}
    model, log = simulated(section, wrong[:1], 2e-3, u=u, channels=("v",), changed=wrong[1])
    effects = [find(n) for n in ("sensor-scale", "input-lag", "sensor-lag", "supply-sag", "parameter")]
    library, windows = prepared(model, log, effects)
    search = EquationSearch(FittedSets(library, windows))
    found = search.try_pairs(search.nothing)
    assert {c.effect.name for c in found[0]} == {"sensor-scale", "parameter"}
    assert found[1].values["sensor_scale_v"] == pytest.approx(1.24, rel=0.01)
    assert found[1].values["R"] * found[1].values["C"] == pytest.approx(0.144, rel=0.01)


def test_a_fit_that_stalls_goes_on_from_the_numbers_of_a_law_that_contains_its_own():
    model, log = simulated(WAYS, [("input-rate-limit", "u", (3.0,))], noise=1e-4, channels=("x", "y"))
    library, windows = prepared(model, log, [find("input-rate-limit"), find("input-rate-limited-lag")])
    sets = FittedSets(library, windows)
    one, two = sorted((c for c in library.candidates if c.site == "u"), key=lambda c: c.effect.name)
    right = sets.fit((two,), None, {"input_rate_limited_lag_u_rate": 3.0, "input_rate_limited_lag_u_time_constant": 1e-4})
    stalled = followed(h := library.hypothesis((one,)), h.theta({"input_rate_limit_u": 4.0}), windows)
    assert sets.better(right, stalled) > 100
    again = alternatives._plainer(sets, (two,), two, (one,), stalled)
    assert sets.better(right, again) < 0
    assert again.values["input_rate_limit_u"] == pytest.approx(3.0, rel=0.01)
    assert alternatives._plainer(sets, (two,), two, (one,), again) is again
