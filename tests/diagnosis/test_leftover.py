"""What is left: noise of any colour is silent, a missing law is not, and its kind, place and formula are told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.signal import lfilter

import gapcert as gc
from gapcert.contracts.systems.extension import Extension, Memory, Parameter
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.fitting.fit import fit, rescued
from gapcert_diagnosis.residual import lack_of_fit as lackoffit
from gapcert_diagnosis.residual import regression, whiteness
from gapcert_diagnosis.residual import unexplained as leftover
from gapcert_diagnosis.residual.lack_of_fit import Lack, lack
from gapcert_diagnosis.residual.regression import features
from gapcert_diagnosis.residual.unexplained import evidence
from gapcert_diagnosis.search.candidates import Library
from gapcert_diagnosis.testing import ROD, equations
from gapcert_report.words.diagnosis import dependence

PERIOD = 0.01
SWING = {**ROD, "parameters": {**ROD["parameters"], "m": {"value": "1 kg", "tolerance": "2 %"}}}
FRICTIONS = ["viscous-friction", "coulomb-friction", "quadratic-drag", "constant-force"]
U = multisine(12.0, PERIOD, 2.0, (0.2, 2.5), 4)
LAWS = {
    "quadratic": ("-a*{v}*abs({v})", {"a": (0.05, "N*m*s^2")}),
    "cogging": ("a*sin(9*{q})", {"a": (0.1, "N*m")}),
    "spring": ("-a*{q}**3", {"a": (0.6, "N*m")}),
    "stiff spring": ("-a*{q}**3", {"a": (2.0, "N*m")}),
    "slight": ("-a*{v}", {"a": (0.002, "N*m*s")}),
}


def truth(law=None, mass=1.01):
    """A finer model, with a force that the nominal one does not have."""
    section = {**SWING, "period": "2 ms", "parameters": {**ROD["parameters"], "m": f"{mass} kg"}}
    if law is None:
        return equations(section)
    text, numbers = LAWS[law]
    extension = Extension("hidden", "q", tuple(Parameter(n, *v) for n, v in numbers.items()), force=text)
    return equations(section).extend([extension])


def recorded(system, *, noise=2e-3, colour=0.0, velocity=False, seed=0, forces=None, u=U, x0=(0.3, 0.0)):
    fine = round(PERIOD / system.period)
    start, drive = np.array([x0]), np.repeat(u, fine, axis=0)[None, : (len(u) - 1) * fine]
    if forces is None:
        x = system.fast_rollout(start, drive, every=fine).x[0]
    else:
        x = system.rollout(start, drive, forces=forces).x[0, ::fine]
    fresh = np.random.default_rng(seed).standard_normal((len(x) + 200, 2)) * np.sqrt(1 - colour**2)
    y = x + noise * np.std(x, axis=0) / np.std(x[:, 0]) * lfilter([1.0], [1.0, -colour], fresh, axis=0)[200:]
    channels = {"q": y[:, 0], "u": u[:, 0]} | ({"q_dot": y[:, 1]} if velocity else {})
    return gc.Recording.of(np.arange(len(u)) * PERIOD, channels)


def left(recording, period=PERIOD):
    model = equations({**SWING, "period": f"{period} s"})
    measured = Dataset.of(model, recording)
    library, windows = Library(model, measured, []), measured.windows(120)
    last = rescued(fit(library.hypothesis(()), windows))
    extended = library.extended((), dict(zip(last.hypothesis.names, last.theta, strict=True)))
    return leftover.left(extended, last), last


@pytest.mark.exam
@pytest.mark.parametrize("velocity", [False, True])
@pytest.mark.parametrize("colour", [0.0, 0.5, 0.8, 0.9])
def test_noise_of_any_colour_is_nothing(colour, velocity):
    for seed in range(2):
        found, last = left(recorded(truth(), colour=colour, velocity=velocity, seed=seed, noise=5e-3))
        assert not found.remains
        assert found.growth.sigmas < 3.5
        assert all(k.share < leftover.THRESHOLDS.learnt_share for k in found.learnt)
        assert leftover.verdict(0, found, last, last, undecided=False, doubted=False, near=lambda share: True) == "nothing"
    # Against the white noise floor alone, coloured noise looks like something that grows.
    assert found.growth.chi_long > 1.06 * max(found.growth.chi_short, 1.0) or colour < 0.6


@pytest.mark.parametrize("colour", [0.0, 0.8])
@pytest.mark.parametrize("law", ["quadratic", "cogging"])
def test_a_missing_law_is_seen_through_the_noise(law, colour):
    found, last = left(recorded(truth(law), colour=colour))
    assert found.growth.sigmas > leftover.THRESHOLDS.growth_sigmas
    assert found.remains
    assert leftover.verdict(0, found, last, last, undecided=False, doubted=False, near=lambda share: True) == "unexplained"


def test_what_an_integrator_may_leave_is_seen_and_not_told():
    found, _ = left(recorded(truth("slight"), noise=1e-4))
    assert found.growth.sigmas > leftover.THRESHOLDS.growth_sigmas
    assert 0.0005 < found.share < leftover.THRESHOLDS.slight_force
    assert not found.remains


def test_a_law_of_the_state_has_a_formula_that_is_a_model():
    recording = recorded(truth("quadratic"))
    found, last = left(recording)
    rest = leftover.unexplained(found)
    assert not rest.needs_memory
    assert rest.looks_like["static"] > 0.7 > rest.looks_like.get("input memory", 0)
    assert rest.correction.terms["q_dot*abs(q_dot)"] == pytest.approx(-0.05, rel=0.15)
    assert rest.correction.explained > 0.7
    corrected = found.long.model.extend([rest.correction.extension])
    windows = found.long.windows
    after = fit(replace(last.hypothesis, model=corrected), windows, theta=last.theta)
    assert after.chi[0] - 1 < 0.1 * (last.chi[0] - 1)


def test_a_law_of_the_place_is_periodic():
    rest = leftover.unexplained(left(recorded(truth("cogging")))[0])
    assert not rest.needs_memory
    assert rest.looks_like["periodic"] > 0.7
    assert rest.correction.site == "q"


def test_what_follows_the_input_late_needs_memory():
    motor = Memory("motor", "N*m", "{u} + (motor - {u})*exp(-{h}/lag)")
    late = Extension("hidden", "u", (Parameter("lag", 0.08, "s"),), input="motor", memory=(motor,))
    found, _ = left(recorded(truth().extend([late])))
    rest = leftover.unexplained(found)
    assert rest.needs_memory
    assert rest.looks_like["input memory"] > 0.5
    assert rest.correction is None
    assert evidence(found)["memory"]["q"] > 0.5


def test_the_missing_force_of_a_law_goes_with_what_makes_it():
    tests = evidence(left(recorded(truth("quadratic"), velocity=True))[0])
    assert tests["force with q_dot"]["q"] < -5
    assert abs(tests["force with q"]["q"]) < 4
    assert tests["memory"]["q"] < 0.4
    assert tests["autocorrelation"]["q"] > 0.5


def test_the_tests_of_noise_are_small():
    tests = evidence(left(recorded(truth(), velocity=True))[0])
    assert "memory" not in tests
    assert all(abs(v) < 4 for name in ("with u", "size with time") for v in tests[name].values())
    assert all(abs(v) < 0.1 for v in tests["autocorrelation"].values())


def test_it_is_told_when_it_happened():
    forces = np.zeros((1, (len(U) - 1) * 5, 1, 1))
    forces[0, 2500:3500, 0, 0] = 0.5 * np.sin(np.arange(1000) / 50)
    rest = leftover.unexplained(left(recorded(truth(), forces=forces))[0])
    assert rest.where
    assert all(a > 4.5 and b < 7.5 for a, b in rest.where)


def test_a_window_on_the_wrong_side_of_a_summit_is_led_back():
    u = multisine(12.0, PERIOD, 3.2, (0.3, 1.0), 2)
    recording = recorded(truth(), noise=2e-2, u=u, x0=(1.5, 1.0))
    model = equations(SWING)
    windows = Dataset.of(model, recording).windows(120)
    off = replace(windows, start=windows.start + np.array([0.0, 6.0]))
    hypothesis = Library(model, windows.measured, []).hypothesis(())
    lost = replace(fit(hypothesis, off), windows=windows)
    assert np.mean(lost.residual**2) > 5
    found = rescued(lost)
    assert np.mean(found.residual**2) < 1.5
    assert rescued(found) is found


def test_causes_that_leave_something_are_doubted():
    found, last = left(recorded(truth("quadratic")))
    (doubt,) = leftover.doubts(1, found, last)
    assert doubt.startswith("inadequate: a residual of ")
    assert doubt.endswith("it looks like a law of the present state and input")
    assert leftover.doubts(3, found, last)[1].startswith("composite: 3 causes")
    assert len(leftover.doubts(3, found, last, settings=1)) == 1
    assert leftover.doubts(0, found, last) == ()
    nothing = replace(last, residual=5 * last.residual)
    for causes, before, undecided, doubted, close, verdict in (
        (0, last, False, False, True, "unexplained"),
        (1, last, True, False, True, "unexplained"),
        (1, nothing, False, False, True, "causes"),
        (1, nothing, False, True, True, "unexplained"),
        (1, nothing, False, False, False, "unexplained"),
        (1, nothing, True, False, True, "ambiguous"),
    ):
        assert leftover.verdict(causes, found, last, before, undecided, doubted, lambda share, near=close: near) == verdict


def test_nothing_is_said_of_nothing_only():
    found, last = left(recorded(truth()))
    goes = replace(found, share=0.02, lack=Lack("q", "the time", 6.0))
    off = replace(last, theta=last.theta + 8 * last.hypothesis.sd)
    for one, numbers, verdict in (
        (found, last, "nothing"),
        (goes, last, "unexplained"),
        (replace(goes, share=0.004), last, "nothing"),
        (replace(found, wide=goes), last, "unexplained"),
        (found, off, "unexplained"),
    ):
        assert leftover.verdict(0, one, numbers, last, undecided=False, doubted=False, near=lambda share: True) == verdict


def test_what_long_rollouts_lose_counts_where_windows_are_nearly_noise():
    """A cause that leaves a third of what little windows show is the answer where rollouts lose most, and none where they do
    not, though they were close to the motion before."""
    found, last = left(recorded(truth("quadratic")))
    quiet = replace(last, residual=1.3 * last.residual / np.sqrt(last.chi.max()))
    before = replace(quiet, residual=1.3 * quiet.residual)

    def close(share):
        return share > 0

    for rest, verdict in ((0.05, "causes"), (0.5, "unexplained")):
        assert leftover.verdict(1, found, quiet, before, False, False, close, rest) == verdict
    slight = replace(found, share=1e-3)
    for rest, verdict in ((0.2, "causes"), (0.5, "unexplained")):
        assert leftover.verdict(1, slight, quiet, before, False, False, close, rest) == verdict


@pytest.mark.parametrize("colour", [0.0, 0.8])
def test_a_direction_shows_what_is_too_little_for_other_tests(colour):
    for law, seen in ((None, False), ("slight", True)):
        recording = recorded(truth(law), colour=colour, noise=2e-3 if law is None else 1e-4)
        found, _ = left(recording)
        lacking = lack(found.long, found.short)
        assert (lacking is not None) == seen
    assert lacking.site == "q"
    assert lacking.sigmas > 5
    doubt = replace(found, growth=replace(found.growth, sigmas=0.0), learnt=(), lack=lacking).doubt
    assert doubt.startswith("inadequate: what is left goes with ")


@pytest.mark.parametrize("sag", [0.0, 0.2])
def test_what_is_slow_shows_in_windows_beyond_the_horizon(sag):
    """The supply sags within a second. In windows of 0.3 s, another gain explains it and leaves only noise."""
    load = Memory("load", "N*m", "abs({u}) + (load - abs({u}))*exp(-{h}/lag)")
    numbers = (Parameter("lag", 1.0, "s"), Parameter("sag", sag, "1/(N*m)"))
    system = truth().extend([Extension("hidden", "u", numbers, input="{u}*(1 - sag*load)", memory=(load,))])
    model = equations(SWING)
    library = Library(model, Dataset.of(model, recorded(system, noise=5e-3)), [gc.registry().build("effect", "input-gain")])
    last = fit(library.hypothesis(library.candidates), library.measured.windows(30))
    extended = library.extended(library.candidates, last.values)
    assert leftover.left(extended, last).doubt is None
    found = leftover.left(extended, last, horizon=1.2)
    assert found.wide.long.windows.length == 240
    assert not found.coherent
    assert found.doubt == found.wide.doubt
    assert (found.doubt is not None) == (sag > 0)


def test_parameters_that_a_stand_in_drags_along_doubt_it():
    """What is stated is a measurement, too: a cause beside which all parameters have to move is less likely than they are."""
    parameters = ROD["parameters"] | {n: {"value": f"1 {u}", "tolerance": "1 %"} for n, u in (("m", "kg"), ("l", "m"))}
    model = equations({**ROD, "parameters": parameters})
    recording = recorded(equations({**ROD, "period": "2 ms", "parameters": ROD["parameters"] | {"m": "1.06 kg"}}))
    library = Library(model, Dataset.of(model, recording), [gc.registry().build("effect", "parameter")])
    doubts = {}
    for c in library.candidates:
        last = fit(library.hypothesis((c,)), library.measured.windows(120))
        doubts[c.site] = leftover.doubts(1, leftover.left(library.extended((c,), last.values), last), last)
    assert doubts["m"] == ()
    assert doubts["l"][-1].startswith("inadequate: parameters that are no cause lie further")


TANK = {
    "kind": "equations",
    "states": {"h": "m"},
    "inputs": {"u": "m/s"},
    "parameters": {"tau": {"value": "60 s", "tolerance": "3 %"}},
    "derivative": {"h": "u - h/tau"},
    "period": "2 s",
}


@pytest.mark.parametrize("late", [0.0, 5.0])
def test_two_lags_that_stand_for_a_delay_are_doubted(monkeypatch, late):
    """In a log of minutes memories are as long; and two equal lags seem to make what only two that swing could."""
    model, rng = equations(TANK), np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1e-2, 1e-2, 120), 8)[:, None]
    system = model.extend([Extension("hidden", "u", (Parameter("late", late, "s"),), delay="late")])
    h = system.rollout(np.zeros((1, 1)), u[None, :-1]).x[0, :, 0] + 0.01 * rng.standard_normal(len(u))
    recording = gc.Recording.of(2.0 * np.arange(len(u)), {"h": h, "u": u[:, 0]})
    library = Library(model, Dataset.of(model, recording), [gc.registry().build("effect", "input-lag")])
    (c,) = (c for c in library.candidates if len(library.names(c)) == 2)
    last = fit(library.hypothesis((c,)), library.measured.windows(30), iterations=40)
    found = leftover.left(library.extended((c,), last.values), last)
    lacking = lack(found.long, found.short)
    assert (lacking is not None) == (found.doubt is not None) == (late > 0)
    if lacking is not None:
        assert lacking.kind == lackoffit.KINDS["input memory"]
        with monkeypatch.context() as patched:
            patched.setattr(lackoffit, "THRESHOLDS", replace(lackoffit.THRESHOLDS, unmade=np.inf))
            assert lack(found.long, found.short) is None


def test_memories_of_an_input_are_as_long_whatever_the_unit_of_time():
    made = []
    for period in (0.01, 10.0):
        section = {**TANK, "parameters": {"tau": f"{30 * period} s"}, "period": f"{period} s"}
        model, rng = equations(section), np.random.default_rng(0)
        u = rng.standard_normal(600)
        h = model.rollout(np.zeros((1, 1)), u[None, :-1, None]).x[0, :, 0] / period
        recording = gc.Recording.of(period * np.arange(600), {"h": h * period, "u": u})
        library = Library(model, Dataset.of(model, recording), [])
        last = fit(library.hypothesis(()), library.measured.at(np.array([[0, 100], [0, 300]]), 100))
        made.append(regression.input_features(leftover.Tangent.of(library.extended((), {}), last)))
    for kind, forces in made[0].items():
        np.testing.assert_allclose(forces, made[1][kind], rtol=1e-6, atol=1e-9)


def test_what_no_single_force_is_like_shows_in_a_kind(monkeypatch):
    found, _ = left(recorded(truth(None), noise=2e-3))
    columns = found.long.responses("q", features(found.long, "q")["periodic"]).reshape(found.long.residual.size, -1)
    columns /= np.linalg.norm(columns, axis=0)
    basis = columns @ lackoffit._spanning(columns.T @ columns)
    little = 2.2 * np.random.default_rng(2).choice([-1.0, 1.0], basis.shape[1])
    rough = replace(found.long, residual=found.long.residual + (basis @ little).reshape(found.long.residual.shape))
    lacking = lack(rough, found.short)
    assert lacking.kind == lackoffit.KINDS["periodic"]
    monkeypatch.setattr(lackoffit, "_together", lambda *given: 0.0)
    assert lack(rough, found.short) is None


def test_the_noise_of_a_lack_is_drawn_once(monkeypatch):
    found, _ = left(recorded(truth("slight"), noise=1e-4))
    drawn, plain = [], lackoffit.noise
    monkeypatch.setattr(lackoffit, "noise", lambda *given: drawn.append(given) or plain(*given))
    monkeypatch.setattr(lackoffit, "THRESHOLDS", replace(lackoffit.THRESHOLDS, lack_sigmas=1.0))
    assert lack(found.long, found.short) is not None
    assert len(drawn) == 1


def test_what_swings_freely_may_lack_a_force_as_well():
    law = Extension("hidden", "q", (Parameter("a", 0.004, "N*m*s^2"),), force="-a*q_dot*abs(q_dot)")
    free = {**ROD, "inputs": {}, "forces": {}, "parameters": SWING["parameters"]}
    x = equations({**free, "period": "2 ms"}).extend([law]).rollout(np.array([[1.2, 0.0]]), np.zeros((1, 6000, 0))).x[0, ::5]
    t = np.arange(len(x)) * PERIOD
    y = x[:, 0] + 1e-4 * np.random.default_rng(0).standard_normal(len(x))
    model = equations({**free, "period": f"{PERIOD} s"})
    library = Library(model, Dataset.of(model, gc.Recording.of(t, {"q": y})), [])
    windows = library.measured.windows(120)
    last = fit(library.hypothesis(()), windows)
    found = leftover.left(library.extended((), dict(zip(last.hypothesis.names, last.theta, strict=True))), last)
    lacking = lack(found.long, found.short)
    assert lacking is not None
    assert lacking.site == "q"


def test_products_of_what_forces_make_need_no_outputs():
    motion = left(recorded(truth(), velocity=True))[0].long
    force = features(motion, "q")["static"]
    made = motion.responses("q", force).reshape(motion.residual.size, -1)
    gone = np.linalg.qr(motion.project(np.random.default_rng(0).standard_normal((*motion.residual.shape, 2))).reshape(-1, 2))[0]
    r = motion.project(motion.residual).reshape(-1, 1)
    r -= gone @ (gone.T @ r)
    rows = np.concatenate([motion.linear.free, *(a.reshape(*motion.residual.shape, -1) for a in (gone, r))], axis=2)
    forces = lackoffit._Forces.of(motion, "q", *motion.linear.adjoint(rows))
    columns = forces.columns(force)
    assert len(columns.which) == made.shape[1]
    kept = made - gone @ (gone.T @ made)
    kept /= np.linalg.norm(kept, axis=0)
    assert np.allclose(columns.square, kept.T @ kept, rtol=0, atol=1e-10)
    assert np.allclose(columns.along, kept.T @ r[:, 0], rtol=0, atol=1e-10 * np.linalg.norm(r))
    scores = columns.scores(motion.responses("q", force), [r.T])
    assert np.allclose(scores[0], columns.along, rtol=0, atol=1e-10 * np.linalg.norm(r))
    again = lackoffit._Columns.made(motion.responses("q", force), gone, r.T)
    assert np.allclose(again.square, columns.square, rtol=0, atol=1e-10)
    assert np.allclose(again.along, columns.along, rtol=0, atol=1e-10 * np.linalg.norm(r))
    nothing = np.concatenate([np.zeros_like(force[..., :1]), force[..., :1]], axis=-1)
    assert forces.columns(nothing).which.tolist() == [1]


def test_where_starts_make_nearly_all_outputs_are_made(monkeypatch):
    found, _ = left(recorded(truth("slight"), noise=1e-4))
    lacking, made = lack(found.long, found.short), []
    monkeypatch.setattr(lackoffit, "THRESHOLDS", replace(lackoffit.THRESHOLDS, told_by_products=1.0))
    monkeypatch.setattr(
        lackoffit._Columns, "made", lambda *given, of=lackoffit._Columns.made: made.append(of(*given)) or made[-1]
    )
    again = lack(found.long, found.short)
    assert made
    assert (again.site, again.kind) == (lacking.site, lacking.kind)
    assert again.sigmas == pytest.approx(lacking.sigmas, rel=1e-9)


def test_noise_that_starts_follow_has_the_sums_that_are_expected():
    found = left(recorded(truth(), velocity=True))[0]
    w, length, ny = found.short.windows.y.shape
    gap = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    for d, j in ((0, 0), (1, 5)):
        cover = np.zeros((length, ny, length, ny))
        cover[:, d, :, d] = whiteness.THRESHOLDS.noise_colours[j] ** gap
        keep = np.eye(length * ny) - found.short.linear.free @ np.swapaxes(found.short.linear.free, 1, 2)
        left_over = (keep @ cover.reshape(length * ny, -1) @ keep).reshape(w, length, ny, length, ny)
        sums = whiteness._Expected.of(found.short, found.long).short[..., d, j]
        for k, c in ((0, 0), (0, 1), (3, d)):
            one = sum(left_over[:, t, c, t + k, c].sum() for t in range(length - k))
            assert sums[k, c] == pytest.approx(one, rel=1e-9, abs=1e-9)
    assert sums[0, 0] != sums[0, 1]


def test_two_colours_are_fitted_as_least_squares_without_signs_do():
    rng = np.random.default_rng(1)
    columns = rng.random((8, 2))
    values = rng.standard_normal((200, 8)) + 0.5
    found = whiteness._nearest_pair(columns, values)
    assert np.allclose(found, [nnls(columns, v)[0] for v in values], atol=1e-12)
    assert [np.count_nonzero(found > 0, axis=1).tolist().count(k) > 5 for k in range(3)] == [True] * 3


def find(recording, effects=FRICTIONS, **options):
    model = equations(SWING)
    return gc.diagnose(model, recording, effects, **{"hold_out": {"last": 0.25}, "horizons": [0.5], **options})


def test_pushes_are_told_one_by_one():
    forces = np.zeros((1, (len(U) - 1) * 5, 1, 1))
    forces[0, 2000:2025], forces[0, 3500:3525] = 4.0, -4.0
    found = find(recorded(truth(), forces=forces, noise=1e-3))
    events = found.unexplained.events
    assert found.verdict == "unexplained"
    assert [(e.site, e.sign) for e in events] == [("q", 1), ("q", -1)]
    assert np.allclose([e.t + e.duration / 2 for e in events], [4.025, 7.025], atol=0.01)
    assert np.allclose([e.size for e in events], 0.2, rtol=0.03)  # 4 N·m for 50 ms
    assert all(0 < e.high - e.low < 0.01 for e in events)
    assert {(e.trajectory, e.unit, e.force_unit) for e in events} == {("0", "N*m*s", "N*m")}


@pytest.mark.parametrize(("law", "seed"), [("spring", 5), ("stiff spring", 4)])
def test_a_law_that_is_large_where_the_swing_is_wide_is_no_push(law, seed):
    u = multisine(12.0, PERIOD, 2.0, (0.2, 2.5), seed)
    found = find(recorded(truth(law), u=u))
    assert (found.verdict, found.unexplained.events) == ("unexplained", ())
    assert found.summary()["unexplained"]["looks_like"]


def test_gusts_all_over_are_no_pushes():
    rng = np.random.default_rng(3)
    forces = np.zeros((1, (len(U) - 1) * 5, 1, 1))
    for k in range(0, len(U) - 10, 20):
        forces[0, 5 * k : 5 * k + 25] = rng.standard_t(2) * 0.5
    found = find(recorded(truth(), forces=forces, noise=1e-3))
    assert (found.verdict, found.unexplained.needs_memory, found.unexplained.events) == ("unexplained", False, ())


@pytest.mark.parametrize("switched", [0.0, 0.4])
def test_a_force_of_time_alone_is_told_as_one_from_outside(switched):
    t = np.arange((len(U) - 1) * 5) * PERIOD / 5
    force = 0.7 * np.sin(2 * np.pi * (0.3 * t + 0.07 * t**2)) * (1 + switched * np.sign(np.sin(1.3 * t)))
    found = find(recorded(truth(), forces=force[None, :, None, None], noise=1e-3))
    rest = found.summary()["unexplained"]
    assert (found.verdict, found.causes, rest["needs_memory"]) == ("unexplained", (), False)
    assert set(rest["looks_like"].values()) == {0.0}
    assert dependence(rest).startswith(
        "No dependence on state, input or their past was found; it looks like an external disturbance, "
    )
