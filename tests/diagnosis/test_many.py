"""Robots with many joints: what a search does for all of them at once, and what it need not do."""

import functools
import itertools
from dataclasses import replace

import numpy as np
import pytest
from exams.hide import hide

import gapcert as gc
from gapcert.plugin import Recording, Trajectory
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.diagnose import _largest_first, _length
from gapcert_diagnosis.fitting import fit as fitting
from gapcert_diagnosis.fitting.rollout_error import Stretches, stretches
from gapcert_diagnosis.search import fitted_sets, moves
from gapcert_diagnosis.search import screening as screening
from gapcert_diagnosis.search import stepwise as searching
from gapcert_diagnosis.search.alternatives import answered
from gapcert_diagnosis.search.candidates import Library
from gapcert_diagnosis.search.criterion import keys, noise
from gapcert_diagnosis.search.fitted_sets import FittedSets
from gapcert_diagnosis.search.gains import GainTable
from gapcert_diagnosis.search.moves import additions, idle, replacements
from gapcert_diagnosis.search.screening import Screen, _distinct, standing_in
from gapcert_diagnosis.search.stepwise import EquationSearch, lightest
from gapcert_diagnosis.testing import ROD, equations

TWO = {
    "kind": "equations",
    "coordinates": {"a": {"unit": "rad", "kind": "angle"}, "b": {"unit": "rad", "kind": "angle"}},
    "inputs": {"u": "N*m", "w": "N*m"},
    "parameters": {"g": "9.81 m/s^2", "J": "0.4 kg*m^2", "k": "0.12 kg*m^2", "m": "1 kg*m"},
    "mass_matrix": [["J + 2*k*cos(b)", "k*(0.6 + cos(b))"], ["k*(0.6 + cos(b))", "0.6*k"]],
    "bias": {"a": "0.3*m*g*sin(a)", "b": "0.1*m*g*sin(a + b)"},
    "forces": {"a": "u", "b": "w"},
    "period": "10 ms",
}
LAWS = ("coulomb-friction", "asymmetric-coulomb-friction", "viscous-friction", "linear-spring", "input-gain", "sensor-bias")


def recorded(hidden, sigma):
    """14 s of two joints."""
    u = np.concatenate([multisine(14.0, 0.01, 2.0, (0.2, 2.5), 4 + i) for i in range(2)], axis=1)
    fine, noise = equations({**TWO, "period": "1 ms"}), {"a": sigma, "b": sigma}
    return hide(fine, hidden, x0=[0.3, 0, 0, 0], u=u, noise=noise, seed=0, decimate=10)


@functools.cache
def prepared(effect="viscous-friction", sigma=3e-3, laws=LAWS, **numbers):
    """A library of few laws, and data of two joints the second of which rubs; made once, for all tests that look at it."""
    model = equations({**TWO, "substeps": 10})
    measured = Dataset.of(model, rubbed(effect, sigma, **numbers or {"coefficient": 0.05}))
    library = Library(model, measured, [gc.registry().build("effect", n) for n in laws])
    return library, library.measured.windows(80)


@functools.cache
def rubbed(effect, sigma, **numbers):
    return recorded([(effect, "b", numbers)], sigma)


def with_all(search, *names):
    """Fits of laws at all their sites."""
    causes = tuple(c for c in search.library.candidates if c.effect.name in names)
    return causes, search.fit(causes, None)


@pytest.mark.exam
def test_one_program_with_a_law_at_all_sites_screens_as_many_do():
    library, windows = prepared()
    search = FittedSets(library, windows)
    screen = Screen(library, windows, search.nothing)
    for c in library.candidates:
        rows, names = _distinct(library.starts(c), library.amplitude(c)), library.names(c)
        alone, shared = library.hypothesis((c,)).model, screen.pushed(c, rows)
        given = dict(zip(names, rows.T, strict=True))
        if shared.state is not None:
            off = screen.path.next(alone, {})[0]
            expected = np.moveaxis(screen.path.next(alone, given, len(rows)) - off, 0, -1)
            np.testing.assert_allclose(shared.state, expected, rtol=0, atol=1e-12)
    assert library.shared(library.candidates[0]) is library.shared(library.candidates[1])


@pytest.mark.exam
def test_a_law_is_screened_at_all_its_sites_in_one_pass(monkeypatch):
    library, windows = prepared("coulomb-friction", level=0.1, laws=("dahl-friction", "viscous-friction"))
    search, passes = FittedSets(library, windows), []
    at_once, alone = (Screen(library, windows, search.nothing) for _ in range(2))
    plain = Screen._moved
    monkeypatch.setattr(Screen, "_moved", lambda self, m, given, n, **k: passes.append(n) or plain(self, m, given, n, **k))
    at_once._at_once(library.candidates)
    assert len(passes) == 2
    for c in library.candidates:
        one, other = at_once.push(c), alone.push(c)
        np.testing.assert_array_equal(one.values, other.values)
        np.testing.assert_allclose(one.state, other.state, rtol=0, atol=1e-15)
        assert np.any(one.state)
    assert len(passes) == 6


@pytest.mark.exam
def test_causes_that_do_nothing_weigh_least():
    library, windows = prepared(coefficient=5e-4)
    search = FittedSets(library, windows)
    causes, fitted = with_all(search, "viscous-friction", "linear-spring")
    order, lost = lightest(library, causes, fitted)
    assert order[-1].key == ("viscous-friction", "b")
    assert (np.diff(lost) >= 0).all()
    # A second order is exact for so little: as much as a fit without any of them loses.
    rose = np.sum(search.nothing.residual**2) / np.sum(fitted.residual**2) - 1
    assert lost[-2] < 0.02 < 0.5 < lost[-1]
    assert lost[-1] == pytest.approx(rose, rel=0.1)


@pytest.mark.exam
def test_idle_causes_are_dropped_together(monkeypatch):
    library, windows = prepared(sigma=1e-3)
    search = FittedSets(library, windows)
    found = with_all(search, "viscous-friction", "linear-spring", "coulomb-friction")
    assert len(found[0]) == 6
    fits, made = [], search.fit

    def counted(causes, *rest):
        fits.append(causes)
        return made(causes, *rest)

    monkeypatch.setattr(search, "fit", counted)
    rest, _ = EquationSearch(search).prune(found)
    assert keys(rest) == {("viscous-friction", "b")}
    assert len(fits) == 1


def test_an_older_cause_that_a_new_one_replaces_is_dropped():
    library, windows = prepared()
    search = FittedSets(library, windows)
    stand_in = tuple(c for c in library.candidates if c.key == ("coulomb-friction", "b"))
    right = tuple(c for c in library.candidates if c.key == ("viscous-friction", "b"))
    parent = stand_in, search.fit(stand_in, None)
    both = (*stand_in, *right), search.fit((*stand_in, *right), parent)
    assert keys(EquationSearch(search).drop_negligible(both, parent)[0]) == {("viscous-friction", "b")}


@pytest.mark.exam
def test_what_is_left_is_noise_once_the_cause_is_there(monkeypatch):
    library, windows = prepared()
    search = FittedSets(library, windows)
    assert not noise(search.nothing)
    right = search.fit(tuple(c for c in library.candidates if c.key == ("viscous-friction", "b")), None)
    assert noise(right)
    assert not noise(replace(right, residual=1.2 * right.residual))
    widths, step = [], searching.forward
    monkeypatch.setattr(searching, "forward", lambda sets, width=1, *more: widths.append(width) or step(sets, width, *more))
    assert keys(EquationSearch(search).forward()[0]) == {("viscous-friction", "b")}
    assert widths == [1]
    monkeypatch.setattr(searching, "noise", lambda fitted: False)
    EquationSearch(search).forward()
    assert widths == [1, 1, searching.THRESHOLDS.beam]


@pytest.mark.exam
def test_rivals_of_a_cause_are_single_laws_that_do_not_contain_it():
    library, windows = prepared("coulomb-friction", level=0.05)
    search = FittedSets(library, windows.guard()[0])
    found = EquationSearch(search).forward()
    assert keys(found[0]) == {("coulomb-friction", "b")}
    answer = answered(search, found, windows)
    rivals = [f[0] for group in answer.rivals.values() for f in group]
    assert rivals
    for causes in rivals:
        assert len(causes) == 1
        assert not library.contains(causes[0].effect.name, "coulomb-friction")
    assert answer.fit.values["coulomb_friction_b"] == pytest.approx(0.05, rel=0.1)


@pytest.mark.exam
def test_of_very_many_candidates_some_are_piled_up(monkeypatch):
    """As a search finds step by step, but without a step: each of three causes explains a third."""
    hidden = [("viscous-friction", "b", {"coefficient": 0.05}), ("viscous-friction", "a", {"coefficient": 0.2})]
    log, model = recorded([*hidden, ("input-gain", "w", {"gain": 0.7})], 1e-3), equations({**TWO, "substeps": 10})
    library = Library(model, Dataset.of(model, log), [gc.registry().build("effect", n) for n in LAWS])
    windows = library.measured.windows(80)
    truth = {("viscous-friction", "a"), ("viscous-friction", "b"), ("input-gain", "w")}
    stepwise = EquationSearch(FittedSets(library, windows))
    assert stepwise.try_piles() is None
    assert keys(stepwise.forward()[0]) == truth
    for module in (searching, fitted_sets):
        monkeypatch.setattr(module, "THRESHOLDS", replace(module.THRESHOLDS, crowd=1))
    monkeypatch.setattr(searching, "THRESHOLDS", replace(searching.THRESHOLDS, alone_promise=0.95))
    few = EquationSearch(FittedSets(library, windows))
    monkeypatch.setattr(searching, "additions", None)
    found = few.forward()
    assert keys(found[0]) == truth
    assert found[1].values["input_gain_w"] == pytest.approx(0.7, rel=0.01)
    monkeypatch.setattr(GainTable, "pairs", None)  # a pile of all candidates needs no pairs beside it
    assert few.try_pairs(found) is found
    monkeypatch.setattr(searching, "THRESHOLDS", replace(searching.THRESHOLDS, alone_promise=0.0))
    assert few.try_piles() is None


def test_a_pile_grows_by_what_the_last_one_leaves():
    library, windows = prepared()
    search = FittedSets(library, windows)
    (table,) = search.screen.tables([(search.nothing, 1)])
    sets = table.pursue(3)
    gains = [s.gain for s in sets]
    assert [len(s.move) for s in sets] == [1, 2, 3]
    assert gains == sorted(gains)
    assert all(set(a.move) < set(b.move) for a, b in itertools.pairwise(sets))
    pairs = table.pairs(1)
    assert gains[0] < gains[1] <= pairs[0].gain * (1 + 1e-9)


def test_of_a_law_that_is_asked_for_alone_there_is_no_rival():
    library, windows = prepared()
    few = Library(library.model, library.measured, [gc.registry().build("effect", "viscous-friction")])
    search = FittedSets(few, windows.guard()[0])
    found = few.candidates, search.fit(few.candidates, None)
    answer = answered(search, found, windows)
    assert keys(answer.causes) == keys(few.candidates)
    assert list(answer.rivals.values()) == [(), ()]


@pytest.mark.exam
def test_the_richest_law_is_not_fitted_where_those_between_leave_no_less(monkeypatch):
    monkeypatch.setattr(moves, "noise", lambda fitted: False)
    dry = ("coulomb-friction", "stribeck-friction", "dahl-friction", "lugre-friction")
    search = FittedSets(*prepared("coulomb-friction", level=0.1, laws=dry))
    plain, stribeck, dahl, lugre = ((c,) for c in search.library.candidates if c.site == "b")
    found = plain, search.fit(plain, None)
    assert not idle(search, found, lugre)
    for between in (stribeck, dahl):
        search.fit(between, found)
    assert idle(search, found, lugre)
    assert not idle(search, found, dahl)


@pytest.mark.exam
def test_where_noise_is_left_a_law_that_remembers_is_fitted_only_if_its_first_values_lead_somewhere():
    laws = ("coulomb-friction", "dahl-friction")
    idled = []
    for hidden, numbers in (("coulomb-friction", {"level": 0.1}), ("dahl-friction", {"level": 0.1, "displacement": 0.02})):
        search = FittedSets(*prepared(hidden, laws=laws, **numbers))
        plain, dahl = ((c,) for c in search.library.candidates if c.site == "b")
        found = plain, search.fit(plain, None)
        idled.append(idle(search, (plain, replace(found[1], residual=found[1].residual)), dahl))
        assert noise(found[1]) == (hidden == "coulomb-friction")
    assert idled == [True, False]


@pytest.mark.exam
def test_only_what_promises_much_of_what_a_cause_does_is_tried_in_its_place(monkeypatch):
    search = FittedSets(*prepared(coefficient=0.1, laws=("viscous-friction", "linear-spring", "input-gain", "sensor-bias")))
    own = next(c for c in search.library.candidates if c.key == ("viscous-friction", "b"))
    tried = []
    plain = FittedSets.try_move
    monkeypatch.setattr(FittedSets, "try_move", lambda self, *given: tried.append(given[1]) or plain(self, *given))
    nothing = ((), search.nothing)
    search.fit((own,), nothing)
    found = additions(search, nothing, instead=own, hope=-np.inf)
    kept = []
    for promised in search.promises(nothing):
        gains = {keys(s.move): s.gain for s in promised}
        kept.append({key for key, gain in gains.items() if gain > 0.25 * gains[frozenset({own.key})]})
    assert found
    assert {keys(s.move) for s in tried} <= kept[0] | kept[1]
    assert len(kept[0] | kept[1]) < len(search.library.candidates)


def test_what_promises_less_than_a_rival_far_behind_is_not_tried_and_the_best_alone_is_told(monkeypatch):
    search = FittedSets(*prepared(coefficient=0.1))
    own = next(c for c in search.library.candidates if c.key == ("viscous-friction", "b"))
    nothing, tried, plain = ((), search.nothing), [], FittedSets.try_move
    search.fit((own,), nothing)
    monkeypatch.setattr(FittedSets, "try_move", lambda self, *given: tried.append(given[1]) or plain(self, *given))
    known = set(search._fits)
    found = additions(search, nothing, instead=own, hope=-np.inf)
    assert len(found) == 1
    assert len(found[0][1].start) == len(search.short)
    assert set(search._fits) == known  # no long fit of any of them
    gains = {keys(s.move): s.gain for s in tried}
    passed = {key for key in search.lost if key not in gains}
    assert passed
    promised = {keys(s.move): s.gain for p in search.promises(nothing, own) for s in p}
    assert all(promised[key] < 0.7 * max(gains.values()) for key in passed)


def test_a_law_that_remembers_is_passed_over_where_others_promise_much_more():
    library, windows = prepared(coefficient=0.1, laws=("viscous-friction", "linear-spring", "input-lag"))
    search, known = FittedSets(library, windows), {c.key: c for c in library.candidates}
    own, spring, lag = known["viscous-friction", "b"], known["linear-spring", "b"], known["input-lag", "w"]
    nothing = ((), search.nothing)
    brief = search.brief(((own,), search.fit((own,), nothing)))
    screened = {keys(s.move): s for p in search.promises(nothing) for s in p}
    outcomes = []
    for gain in (1.0, 3.0):  # of the spring's, times the lag's
        picks = [replace(screened[frozenset({c.key})], gain=g) for c, g in ((spring, 50.0 * gain), (lag, 50.0))]
        outcomes.append(
            [s.move[0] for s, _ in replacements(search, picks, nothing, own, replace(brief, residual=1e3 + brief.residual))]
        )
    assert outcomes == [[spring, lag], [spring]]


def test_two_steps_show_whether_a_rival_is_worth_the_others(monkeypatch):
    library, windows = prepared(coefficient=0.1, laws=("viscous-friction", "linear-spring"))
    search, known = FittedSets(library, windows), {c.key: c for c in library.candidates}
    own, spring = known["viscous-friction", "b"], known["linear-spring", "b"]
    nothing = ((), search.nothing)
    brief = search.brief(((own,), search.fit((own,), nothing)))
    picks = [s for s in search.promises(nothing)[0] if keys(s.move) == {spring.key}]
    further, plain = [], FittedSets.fit_further
    monkeypatch.setattr(FittedSets, "fit_further", lambda self, *given: further.append(given[1]) or plain(self, *given))
    replacements(search, picks, nothing, own, brief)
    assert further == []  # far behind the cause
    replacements(search, picks, nothing, own, replace(brief, residual=1e3 + brief.residual))
    assert further == [2]


@pytest.mark.exam
def test_the_cause_that_explains_most_stands_first():
    library, windows = prepared(sigma=1e-3)
    known = {c.key: c for c in library.candidates}
    search = FittedSets(library, windows)
    small, large = known["viscous-friction", "a"], known["viscous-friction", "b"]
    found = ((small, large), search.fit((small, large), None))
    answer = replace(answered(search, found, windows), causes=(small, large))
    judge = stretches(library.measured, [0.5])[-1]
    assert _largest_first(answer, judge).causes == (large, small)


def test_what_could_stand_in_for_a_cause_is_screened_alone(monkeypatch):
    """The same gains as of all candidates, of fewer."""
    library, windows = prepared(coefficient=0.1)
    own = next(c for c in library.candidates if c.key == ("viscous-friction", "b"))
    nothing, found = ((), FittedSets(library, windows).nothing), []
    for crowd in (len(library.candidates) + 1, 1):
        monkeypatch.setattr(fitted_sets, "THRESHOLDS", replace(fitted_sets.THRESHOLDS, crowd=crowd))
        found.append(FittedSets(library, windows).promises(nothing, own))
    for every, few in zip(*found, strict=True):
        known = {keys(s.move): s.gain for s in every}
        assert frozenset({own.key}) in {keys(s.move) for s in few}
        assert 4 <= len(few) < len(library.candidates) < len(every)
        assert all(s.gain == pytest.approx(known[keys(s.move)], rel=1e-9) for s in few)
        assert standing_in([(own,), (library.candidates[0],)], {own.key: 9.0}, own.key) == [(own,), (library.candidates[0],)]
        missing = [gain for k, gain in known.items() if len(k) == 1 and k not in {keys(s.move) for s in few}]
        assert max(missing) < 0.3 * known[frozenset({own.key})]


def test_promises_beside_causes_leave_out_what_these_explain():
    library, windows = prepared(coefficient=0.1)
    search, dry = FittedSets(library, windows), ("coulomb-friction", "b")
    causes = tuple(c for c in library.candidates if c.key == ("viscous-friction", "b"))
    (table,) = search.screen.tables([(search.nothing, 1)])
    alone, beside = (table.beside(given) for given in ((), causes))
    assert alone[dry] > 100
    assert beside[dry] < 0.05 * alone[dry]
    assert beside[causes[0].key] == 0
    assert table.beside(()) == alone


def test_first_values_beside_nothing_are_those_of_the_pile(monkeypatch):
    library, windows = prepared(coefficient=0.1)
    plain, piled = FittedSets(library, windows), FittedSets(library, windows)
    c = next(c for c in library.candidates if c.key == ("viscous-friction", "b"))
    expected = next(s for s in plain.promises(((), plain.nothing))[0] if keys(s.move) == {c.key})
    monkeypatch.setattr(fitted_sets, "THRESHOLDS", replace(fitted_sets.THRESHOLDS, crowd=1))
    monkeypatch.setattr(piled.screen, "rank", None)
    promised = piled.promise(((), piled.nothing), c)
    assert promised is not None
    assert promised.values == pytest.approx(dict(expected.values), rel=1e-9)


def test_a_held_out_rollout_is_made_once_for_a_fit(monkeypatch):
    library, windows = prepared()
    search, judge, rolled = FittedSets(library, windows), stretches(library.measured, [0.5])[-1], []
    plain = Stretches._simulated
    monkeypatch.setattr(Stretches, "_simulated", lambda self, fitted: rolled.append(fitted) or plain(self, fitted))
    other = replace(search.nothing, start=search.nothing.start.copy())
    assert judge.error(search.nothing) == judge.error(search.nothing) == pytest.approx(judge.error(other), rel=1e-4)
    judge.rms(search.nothing)
    assert len(rolled) == 2


def test_the_last_step_of_a_fit_needs_no_slopes_of_its_own(monkeypatch):
    library, windows = prepared()
    best = with_all(FittedSets(library, windows), "viscous-friction")[1]
    made, plain = [], fitting._linearise
    monkeypatch.setattr(fitting, "_linearise", lambda *given: made.append(given[0]) or plain(*given))
    again = fitting.fit(best.hypothesis, windows, theta=best.theta, start=best.start)
    assert sum(len(h.names) > 0 for h in made) == 1
    assert np.sum(again.residual**2) == pytest.approx(np.sum(best.residual**2), rel=1e-5)
    np.testing.assert_allclose(again.interval(), best.interval(), rtol=1e-2)


def test_pushes_that_are_averaged_are_made_once_per_block(monkeypatch):
    library, windows = prepared(laws=("viscous-friction",))
    nothing = FittedSets(library, windows).nothing
    fine = Screen(library, windows, nothing).push(library.candidates[0]).state
    monkeypatch.setattr(screening, "THRESHOLDS", replace(screening.THRESHOLDS, screening_block=0.02))
    coarse = Screen(library, windows, nothing).push(library.candidates[0]).state
    assert coarse.shape == fine.shape
    np.testing.assert_array_equal(coarse[:, ::2], fine[:, ::2])
    np.testing.assert_array_equal(coarse[:, 1::2], fine[:, :-1:2])
    assert np.linalg.norm(coarse - fine) < 0.1 * np.linalg.norm(fine)


def test_the_fit_of_nothing_is_made_once(monkeypatch):
    library, windows = prepared()
    plain = fitting.fit(library.hypothesis(()), windows)
    made, real = [], fitted_sets.fit
    monkeypatch.setattr(fitted_sets, "fit", lambda h, *given, **more: made.append(h) or real(h, *given, **more))
    given = FittedSets(library, windows, plain=plain).nothing
    assert not made
    np.testing.assert_array_equal(given.residual, FittedSets(library, windows).nothing.residual)
    assert len(made) == 1


@pytest.mark.parametrize(("samples", "length"), [(160, 150), (189, 179), (200, 95), (330, 106), (1210, 120)])
def test_runs_are_cut_into_windows_without_a_rest(samples, length):
    """Windows of a second side by side would leave up to half of a run to nobody: here it has few samples, or some parts."""
    model, rng = equations(ROD), np.random.default_rng(0)
    t = np.arange(samples) * model.period
    runs = [Trajectory(t, {"q": rng.standard_normal(samples), "u": rng.standard_normal(samples)}, f"{i}") for i in range(12)]
    measured = Dataset.of(model, Recording(tuple(runs), {}, "zero"))
    room = samples - measured.history
    assert _length(measured, model, None) == length
    assert _length(measured, model, 1.0) == 100
    assert measured.windows(length).y.shape[:2] == (12 * round(room / 120), length)
    assert room - round(room / 120) * length < 3
