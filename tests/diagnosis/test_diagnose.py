"""Every verdict can be reached, with its evidence, and the summary keeps its keys."""

import json
from dataclasses import replace

import numpy as np
import pytest
from exams.hide import hide

import gapcert as gc
from gapcert.testing import multisine
from gapcert_diagnosis import Diagnoser, Diagnosis
from gapcert_diagnosis.diagnose import _once as once
from gapcert_diagnosis.testing import ROD, equations

PERIOD = 0.01
SWING = {**ROD, "integrator": "semi_implicit"}
CART = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"u": "N"},
    "parameters": {"mass": "1 kg"},
    "mass_matrix": [["mass"]],
    "forces": {"q": "u"},
    "integrator": "semi_implicit",
    "period": "10 ms",
}
DRY = ("coulomb-friction", "q", {"level": 0.1})
FRICTIONS = ["viscous-friction", "coulomb-friction", "quadratic-drag", "constant-force"]


def swung(effects=(), seed=1, noise=None, seconds=16.0):
    model = equations(SWING)
    u = multisine(seconds, PERIOD, 2.0, (0.2, 2.5), 4)
    return model, hide(model, effects, x0=[0.3, 0.0], u=u, noise=noise or {"q": 1e-3}, seed=seed)


def noisy(x, u):
    q = x[:, 0] + 1e-3 * np.random.default_rng(0).standard_normal(len(x))
    return gc.Recording.of(np.arange(len(x)) * PERIOD, {"q": q, "u": u[:, 0]})


def find(model, recording, effects="all", **options):
    return gc.diagnose(model, recording, effects, **{"hold_out": {"last": 0.25}, "horizons": [0.5, 1.5], **options})


@pytest.fixture(scope="module")
def dry():
    model, recording = swung([DRY])
    return model, recording, find(model, recording)


def test_causes(dry):
    model, _, found = dry
    assert found.verdict == "causes"
    assert found.experiment is None
    assert found.unexplained is None
    (cause,) = found.causes
    level = cause.parameters["level"]
    assert (cause.effect, cause.site, level.unit) == ("coulomb-friction", "q", "N*m")
    assert level.low <= 0.1 <= level.high
    assert level.high - level.low < 0.01
    assert cause.explained > 0.8 > cause.runner_up.explained
    assert found.extended_model.extend([]).equations() != model.equations()
    assert [p.value for p in found.extended_model.parameters if p.name == "coulomb_friction_q"] == [level.value]


def test_the_gain_is_that_of_free_rollouts_on_held_out_data(dry):
    _, _, found = dry
    for horizon in ("0.5", "1.5"):
        gain = found.gain[horizon]["q"]
        assert gain.low <= gain.after <= gain.high
        assert gain.after < 0.3 * gain.before
        assert gain.after == pytest.approx(1e-3, rel=0.4)  # the noise of the measurement is in it


def test_the_summary_keeps_its_keys(dry):
    summary = dry[2].summary()
    assert list(summary) == ["verdict", "causes", "units", "residual", "gain", "evidence", "log", "timings"]
    assert list(summary["causes"][0]) == ["effect", "site", "parameters", "explained", "runner_up"]
    assert list(summary["causes"][0]["parameters"]["level"]) == ["value", "unit", "low", "high"]
    assert list(summary["causes"][0]["runner_up"]) == ["effect", "site", "explained", "margin", "leaves"]
    assert list(summary["residual"]["q"]) == ["before", "after", "noise_floor"]
    assert list(summary["gain"]) == ["0.5", "1.5"]
    assert list(summary["gain"]["0.5"]["q"]) == ["before", "after", "low", "high"]
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary


def test_the_same_again_is_the_same(dry):
    model, recording, found = dry
    one, two = (d.summary() for d in (found, find(model, recording)))
    assert {k: v for k, v in one.items() if k != "timings"} == {k: v for k, v in two.items() if k != "timings"}


def test_the_figure_shows_held_out_data_and_the_law(dry):
    figure = dry[2].figure
    (channel,), law = figure.channels, figure.laws[0]
    assert channel.t[0] > 12.0
    assert len(channel.t) == len(channel.measured) == len(channel.before) == len(channel.after) == 150
    assert np.abs(channel.after - channel.measured).max() < np.abs(channel.before - channel.measured).max()
    assert law.law[law.at > 0.5].max() == pytest.approx(-0.1, rel=0.05)
    assert "N*m" in law.y_label


def test_nothing():
    for seed in range(3):
        found = find(*swung(seed=seed), horizons=[0.5])
        assert found.verdict == "nothing"
        assert not found.causes
        assert found.gain["0.5"]["q"].after == found.gain["0.5"]["q"].before


@pytest.mark.parametrize("effects", [["parameter"], ["viscous-friction"], ["sensor-quantisation"]])
def test_one_effect_alone_can_be_asked_for(dry, effects):
    model, recording, _ = dry
    assert find(model, recording, effects).verdict in ("causes", "unexplained")


def test_nothing_in_data_without_noise():
    assert find(*swung(noise={"q": 0.0}), horizons=[0.5]).verdict == "nothing"


def test_a_measured_velocity_is_used():
    model, recording = swung([DRY], noise={"q": 1e-3, "q_dot": 1e-2})
    found = find(model, recording)
    assert [c.effect for c in found.causes] == ["coulomb-friction"]
    assert set(found.residual) == {"q", "q_dot"}


def test_a_short_second_log_takes_nothing_from_a_long_one():
    # Windows of an eighth of the short one would be too short for so little friction.
    light = [("viscous-friction", "q", {"coefficient": 0.02})]
    model, log = swung(light, noise={"q": 3e-3})
    _, brief = swung(light, seed=2, noise={"q": 3e-3}, seconds=2.4)
    found = [find(model, r, FRICTIONS, horizons=[0.3]) for r in (log, gc.Recording((*log.trajectories, *brief.trajectories)))]
    assert [(f.verdict, f.causes[0].effect) for f in found] == [("causes", "viscous-friction")] * 2


def rod(damping, period):
    """The swing with a damper in N·m·s that the model does not know, at a period in s."""
    parameters = {**ROD["parameters"], "c": f"{damping} N*m*s/rad"}
    bias = {"q": "m*g*l/2*sin(q) + c*q_dot"}
    return equations({**ROD, "parameters": parameters, "bias": bias, "period": f"{period} s"})


def runs(damping=0.0, count=24, few=()):
    """As many logs, of which those in `few` end early, none of them long enough for two windows."""
    u = np.stack([multisine(1.1, PERIOD, 2.0, (0.6, 4.0), 50 + k) for k in range(count)])
    starts = np.array([[0.5 * (-1) ** k, 0.0] for k in range(count)])
    q = rod(damping, PERIOD).fast_rollout(starts, u[:, :-1]).x[..., 0]
    q += 1e-3 * np.random.default_rng(count).standard_normal(q.shape)
    ends = [50 if k in few else q.shape[1] for k in range(count)]
    logs = [gc.Recording.of(PERIOD * np.arange(e), {"q": q[k, :e], "u": u[k, :e, 0]}) for k, e in enumerate(ends)]
    return gc.Recording(tuple(replace(log.trajectories[0], name=f"run {k}") for k, log in enumerate(logs)))


@pytest.mark.parametrize("few", [(), (3, 11)])
def test_many_runs_of_a_second_are_enough(few):
    model, two = rod(0.0, PERIOD), ["viscous-friction", "coulomb-friction"]
    assert [(c.effect, c.site) for c in gc.diagnose(model, runs(0.05, few=few), two).causes] == [("viscous-friction", "q")]
    assert gc.diagnose(model, runs(few=few), two).verdict == "nothing"


def trembling(damping, mean, seed=2):
    """A swing that is logged at times of its own."""
    u = np.repeat(multisine(12.0, 0.01, 2.0, (0.2, 2.5), 4), 20, axis=0)
    q = rod(damping, 0.0005).fast_rollout(np.array([[0.3, 0.0]]), u[None, :-1]).x[0, :, 0]
    rng = np.random.default_rng(seed)
    gaps = mean * np.maximum(0.3, 1 + 0.2 * rng.standard_normal(int(11.5 / mean)))
    rows = np.unique(np.round(np.cumsum(gaps) / 0.0005).astype(int))
    rows = rows[rows < len(q)]
    return gc.Recording.of(0.0005 * rows, {"q": q[rows] + 1e-3 * rng.standard_normal(len(rows)), "u": u[rows, 0]})


@pytest.mark.parametrize("mean", [0.0087, 0.0128])
def test_stamps_that_tremble_are_put_on_the_grid_of_the_model_and_told(mean):
    told, log = [], trembling(0.05, mean)
    two = ["viscous-friction", "coulomb-friction"]
    found = find(rod(0.0, PERIOD), log, two, horizons=[0.5], emit=lambda e: told.append(str(e.data.get("message", ""))))
    assert [(c.effect, c.site) for c in found.causes] == [("viscous-friction", "q")]
    assert found.log["resampled"] == {"from": pytest.approx(mean, rel=0.05), "to": 0.01}
    assert any("s apart, unevenly, are put on a grid of 0.01 s" in text for text in told)
    assert find(rod(0.0, PERIOD), trembling(0.0, mean), two, horizons=[0.5]).verdict == "nothing"


@pytest.mark.exam
def test_ambiguous_when_the_speed_never_changes_until_the_experiment_is_played():
    cart, u = equations(CART), np.full((900, 1), 0.5)
    drag = [("viscous-friction", "q", {"coefficient": 0.5})]
    log = hide(cart, drag, x0=[0.0, 1.0], u=u, noise={"q": 1e-3}, seed=1)
    found = find(cart, log, FRICTIONS, experiment={"limits": {"u": ["-1 N", "1 N"], "q": [-30, 30]}, "seconds": 10.0})
    sets = {found.causes[0].effect} | {effect for group in found.ambiguous_with for effect, _ in group}
    assert found.verdict == "ambiguous"
    assert {"viscous-friction", "coulomb-friction", "quadratic-drag"} <= sets
    assert found.experiment.startswith(f"to tell {found.causes[0].effect} at q from ")
    assert found.summary()["ambiguous_with"][0][0].keys() == {"effect", "site"}
    assert found.design.rivals[0] == ("viscous-friction", "q")
    x0 = [found.design.start[n][0] for n in ("q", "q_dot")]
    played = hide(cart, drag, x0=x0, u=found.design.inputs["u"][:, None], noise={"q": 1e-3}, seed=2)
    assert np.abs(found.design.inputs["u"]).max() <= 1
    both = find(cart, gc.Recording((*log.trajectories, *played.trajectories)), FRICTIONS)
    assert (both.verdict, both.causes[0].effect, both.ambiguous_with) == ("causes", "viscous-friction", ())
    # More of the same would not have done.
    again = hide(cart, drag, x0=[0.0, 1.0], u=u, noise={"q": 1e-3}, seed=2)
    assert find(cart, gc.Recording((*log.trajectories, *again.trajectories)), FRICTIONS).ambiguous_with


def test_a_late_force_and_a_late_sensor_have_no_experiment_and_what_would_tell_is_said():
    cart = equations(CART)
    u = multisine(16.0, PERIOD, 3.0, (0.2, 1.5), 3)
    log = hide(cart, [("input-delay", "u", {"delay": 0.032})], x0=[0.0, 0.0], u=u, noise={"q": 5e-4}, seed=4)
    found = find(cart, log, ["input-delay", "sensor-delay", "viscous-friction"])
    assert (found.verdict, found.design) == ("causes", None)
    assert found.ambiguous_with == ((("sensor-delay", "q"),),)
    assert found.sentence().endswith(
        "To tell input-delay at u from sensor-delay at q: measure u where it acts, or q with a second sensor; "
        "or measure q_dot as well, with noise of 1 % of its deviation or less."
    )


def test_no_experiment_for_what_is_the_same_under_every_input():
    found = find(*swung([("constant-force", "q", {"force": 0.1})]), ["constant-force", "input-offset"])
    assert found.verdict == "causes"
    assert found.causes[0].effect == "constant-force"
    assert found.ambiguous_with == ((("input-offset", "u"),),)
    assert found.design is None
    assert found.experiment == "to tell constant-force at q from input-offset at u: measure the force at q, or u where it acts"


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            {"horizons": [60.0]},
            r"a horizon of 60 s does not fit the held-out data: 0.08 s serve to find a start and 3.92 s are left",
        ),
        ({"horizons": []}, r"no horizon is given"),
        ({"horizons": [-1.0]}, r"expected a positive horizon"),
        ({"effects": []}, r"no effect is given"),
        ({"effects": ["viscous"]}, r"no plugin provides effect 'viscous'.*did you mean 'viscous-friction'\?"),
        ({"window": 11.0}, r"windows are too few"),
        ({"hold_out": {"last": 0.95}}, r"windows are too few|record for longer"),
    ],
)
def test_refuses_in_one_sentence(dry, options, says):
    with pytest.raises(gc.UsageError, match=says):
        find(*dry[:2], **options)


def test_progress_is_told(dry):
    events = []
    find(*dry[:2], ["viscous-friction", "coulomb-friction"], emit=events.append)
    assert {e.name for e in events} == {"progress"}
    counts = [e.data["done"] for e in events]
    assert counts == sorted(counts)
    assert set(range(1, counts[-1] + 1)) <= {*counts}, "every hypothesis that is fitted is told"
    assert "friction at q" in events[-1].data["best"]["best"]
    assert events[-1].data["best"]["error left"].endswith("%")


@pytest.mark.exam
@pytest.mark.parametrize("window", [None, 2.4])
def test_samples_far_apart_make_windows_of_a_few_seconds(window):
    """Three samples in a second: a window of 0.3 s would hold one."""
    slow, fine = ({**ROD, "period": period, "substeps": n} for period, n in (("300 ms", 100), ("3 ms", 1)))
    u = multisine(90.0, 0.3, 2.0, (0.02, 0.25), 3)
    rubs = ("viscous-friction", "q", {"coefficient": 0.1})
    recording = hide(equations(fine), [rubs], x0=[0.3, 0.0], u=u, noise={"q": 1e-3}, seed=0, decimate=100)
    found = gc.diagnose(equations(slow), recording, FRICTIONS, window=window, horizons=[1.2])
    assert [(c.effect, c.site) for c in found.causes] == [("viscous-friction", "q")]
    assert found.causes[0].parameters["coefficient"].value == pytest.approx(0.1, rel=0.05)


def test_a_window_of_a_few_samples_is_refused():
    told = "diagnose.window: 0.02 s hold 2 samples, 0.01 s apart; expected 8 or more; give 0.08 s, or leave it out"
    with pytest.raises(gc.UsageError, match=told):
        find(*swung([DRY]), window=0.02)


class Somebodys(Diagnoser):
    """Of models of a kind that only somebody else knows."""

    def accepts(self, model):
        return len(model.coordinates) == 1

    def diagnose(self, problem):
        problem.clock.lap("asked")
        return Diagnosis("nothing", (), {}, {}, problem.model, log={"fitted": len(problem.fitted.trajectories)})


def test_a_model_is_left_to_a_diagnoser_that_accepts_it(monkeypatch):
    model, recording = swung()
    own = gc.plugin.Component("diagnoser", "somebodys", "knows its models", f"{__name__}:Somebodys")
    known = gc.registry()
    monkeypatch.setattr(known, "components", {**known.components, ("diagnoser", "somebodys"): own})
    found = find(model, recording, FRICTIONS)
    assert (found.verdict, found.log, list(found.timings)) == ("nothing", {"fitted": 1}, ["asked"])
    monkeypatch.setattr(Somebodys, "accepts", lambda self, model: False)
    assert "search" in find(model, recording, FRICTIONS, horizons=[0.5]).timings


def test_what_is_held_out_is_not_fitted_under_another_name():
    model, recording = swung([DRY], seconds=8.0)
    (tr,) = recording.trajectories
    other = replace(swung([DRY], seed=2, seconds=8.0)[1].trajectories[0], name="other")
    named = {n: replace(tr, name=n) for n in ("one", "two")}
    again = replace(named["one"], t=tr.t + 30, channels={n: np.round(v, 6) for n, v in tr.channels.items()}, name="again")
    log = replace(recording, trajectories=(again, other, named["one"]))
    said = []
    found = find(model, log, FRICTIONS, hold_out={"trajectories": ["one"]}, horizons=[0.5], emit=said.append)
    told = "1 of 3 trajectories is a copy and counts once: 'again' is a copy of 'one'"
    assert told in found.assumptions
    assert found.summary()["log"]["copies"] == [{"name": "again", "of": "one", "start": 30.0, "rows": len(tr), "whole": True}]
    assert any(e.data.get("message") == told for e in said)
    alone = find(
        model, replace(log, trajectories=(other, named["one"])), FRICTIONS, hold_out={"trajectories": ["one"]}, horizons=[0.5]
    )
    assert found.summary()["causes"] == alone.summary()["causes"]
    with pytest.raises(gc.UsageError, match="what is left for the fit is a copy of what is held out"):
        find(model, replace(log, trajectories=(again, named["one"])), FRICTIONS, hold_out={"trajectories": ["one"]})
    # Where each trajectory ends in what is held out, one that is a copy ends nowhere.
    parts = once(replace(log, trajectories=(named["one"], again, other)), {"last": 0.25}, None, ["torque"])[0]
    assert [[t.name for t in part.trajectories] for part in parts] == [["one", "other"], ["one", "other"]]
