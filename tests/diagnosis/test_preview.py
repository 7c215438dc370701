"""Before a search: the smallest sizes are true, and what a log does not excite, tell apart or leave open is said."""

import json

import numpy as np
import pytest
from exams.hide import hide

import gapcert as gc
from gapcert.cli.main import main
from gapcert.testing import multisine
from gapcert_diagnosis.data.dataset import Dataset
from gapcert_diagnosis.data.feedback import loops
from gapcert_diagnosis.preview import preview
from gapcert_diagnosis.section import DiagnoseConfig
from gapcert_diagnosis.testing import equations
from gapcert_recordings.flaws import flaws
from gapcert_report.words.preview import in_words

PERIOD = 0.005
SLED = {
    "kind": "equations",
    "coordinates": {"x": "m"},
    "inputs": {"F": "N"},
    "parameters": {"M": {"value": "1.4 kg", "tolerance": "2 %"}, "k": "3 N/m"},
    "mass_matrix": [["M"]],
    "bias": {"x": "k*x"},
    "forces": {"x": "F"},
    "integrator": "semi_implicit",
    "period": "5 ms",
}
FEW = ["viscous-friction", "coulomb-friction", "input-gain", "input-offset", "constant-force", "input-delay", "input-lag"]
T = np.arange(2400) * PERIOD
PUSHED = multisine(12.0, PERIOD, 2.5, (0.2, 2.0), 3)[:2400]


def logged(u, effects=(), seed=1):
    model = equations(SLED)
    return model, hide(model, effects, x0=[0.1, 0.0], u=u.reshape(-1, 1), noise={"x": 4e-4}, seed=seed)


def looked(u, effects=FEW, **how):
    return preview(*logged(u, **how), DiagnoseConfig(effects=effects))


def fed_back(gain, seed=0, own=True, damping=4.0, every=200):
    """A sled whose force follows a command in steps, by the measured position and speed, or by the true ones."""
    rng, model = np.random.default_rng(seed), equations(SLED)
    x, rows, steps = np.zeros(2), [], rng.uniform(-0.5, 0.5, 12)
    for k in range(len(T)):
        y = x + [4e-4, 4e-3] * rng.standard_normal(2)
        z = y if own else x
        u = gain * (steps[k // every] - z[0]) - damping * z[1]
        rows.append((*y, u))
        x = model.step(x[None], np.array([[u]])).x[0]
    y, v, u = np.array(rows).T
    return model, gc.Recording.of(T, {"x": y, "x_dot": v, "F": u})


@pytest.fixture(scope="module")
def swept():
    return looked(PUSHED)


def test_sizes_have_units_and_shares(swept):
    found = {(s.effect, s.site): s for s in swept.seen}
    rub = found["coulomb-friction", "x"]
    assert (rub.parameter, rub.unit) == ("level", "N")
    assert 0.005 < rub.share < 0.02
    gain = found["input-gain", "F"]
    assert gain.off == 1
    assert gain.value > 1
    assert not swept.unseen
    assert json.loads(json.dumps(swept.summary(), allow_nan=False)) == swept.summary()


def test_what_looks_alike_is_one_class(swept):
    classes = {frozenset(group) for group in swept.alike}
    assert {("constant-force", "x"), ("input-offset", "F")} in classes
    assert any(("input-lag", "F") in group for group in classes)
    assert not any(("coulomb-friction", "x") in group for group in classes)


@pytest.mark.parametrize("times", [2.0, 0.3])
def test_twice_the_promised_size_is_named_and_a_third_of_it_is_not(swept, times):
    for effect, seed in (("coulomb-friction", 5), ("viscous-friction", 6)):
        (size,) = (s for s in swept.seen if s.effect == effect)
        model, recording = logged(PUSHED, [(effect, "x", {size.parameter: times * size.value})], seed)
        found = gc.diagnose(model, recording, FEW, horizons=[0.5])
        assert [c.effect for c in found.causes] == ([effect] if times > 1 else []), (effect, found.verdict)


def test_sizes_are_those_of_the_noise_whatever_is_hidden(swept):
    other = preview(*logged(PUSHED, [("coulomb-friction", "x", {"level": 0.5})]), DiagnoseConfig(effects=FEW))
    assert other.floors["x"][2] > 5 > swept.floors["x"][2]
    sizes = [next(s.value for s in p.seen if s.effect == "viscous-friction") for p in (swept, other)]
    # Beside the friction the effort is larger; what is left of the fit is 50 times the noise, and plays no part.
    assert 0.5 < sizes[1] / sizes[0] < 3


def test_an_input_that_never_changes():
    still = looked(np.zeros(2400))
    assert [s.share for s in still.seen if s.effect == "input-offset"] == [None]
    assert {("input-gain", "F"), ("input-delay", "F")} <= set(still.unseen)
    assert any("at F, what would be seen only if" in line for line in in_words(still.summary()))
    found = looked(np.full(2400, 1.5))
    assert any(s.startswith("F never changes:") for s in found.unexcited)
    model, one_way = equations(SLED | {"bias": {}, "parameters": {"M": "1.4 kg"}}), np.abs(PUSHED).reshape(-1, 1)
    recording = hide(model, x0=[0.0, 0.5], u=one_way, noise={"x": 4e-4}, seed=2)
    said = " ".join(preview(model, recording, DiagnoseConfig(effects=FEW)).unexcited)
    assert "F never changes its sign" in said
    assert "x moves in one direction only" in said


@pytest.mark.parametrize("own", [True, False])
def test_a_controller_is_recognised(own):
    model, recording = fed_back(40.0, own=own)
    (loop,) = loops(model, Dataset.of(model, recording))
    assert loop.input == "F"
    assert loop.share > 2 * loop.chance


def switched():
    """A sled that is pushed to and fro by a switch, at the measured sum of position and speed, in a wind."""
    rng, model = np.random.default_rng(2), equations(SLED)
    x, rows, u = np.zeros(2), [], 2.0
    for k in range(len(T)):
        y = x + 4e-4 * rng.standard_normal(2)
        s = y[0] + 0.1 * y[1] - 0.2
        u = -2.0 if s > 0.02 else 2.0 if s < -0.02 else u
        rows.append((y[0], u))
        x = model.step(x[None], np.array([[u + 0.8 * np.sin(0.7 * T[k])]])).x[0]
    return model, *np.array(rows).T


def test_a_switch_that_follows_the_state_is_recognised():
    model, x, u = switched()
    (loop,) = loops(model, Dataset.of(model, gc.Recording.of(T, {"x": x, "F": u})))
    assert (loop.input, loop.by) == ("F", "switch")
    assert loop.share < 0.5 * loop.chance
    assert loop.told.startswith("F is under feedback (by the state it should switch at ")
    turns = np.flatnonzero(np.diff(u)) + 1
    held = np.random.default_rng(0).permutation(np.diff(turns))
    other = np.concatenate([u[: turns[0]], np.repeat(np.resize(u[turns[:2]], len(held)), held), u[turns[-1] :]])
    model, recording = logged(other)
    assert loops(model, Dataset.of(model, recording)) == ()


def test_a_controller_that_mostly_rests_is_recognised():
    model, recording = fed_back(40.0, own=False, damping=14.0, every=800)
    (loop,) = loops(model, Dataset.of(model, recording))
    assert loop.by == "state"


@pytest.mark.parametrize("u", [PUSHED[:, 0], np.sign(PUSHED[:, 0]), np.random.default_rng(3).standard_normal(2400)])
def test_an_input_that_is_played_is_no_loop(u):
    model, recording = logged(u)
    assert loops(model, Dataset.of(model, recording)) == ()


def test_sensors_at_the_end_of_their_range_stuck_or_slow():
    rng = np.random.default_rng(0)
    y = np.sin(2 * np.pi * T / 3) + 1e-3 * rng.standard_normal(len(T))
    assert list(flaws(T, y)) == []
    (told,) = flaws(T, np.minimum(y, 0.8))
    assert told.startswith("stays at its greatest value, 0.8, in 2")
    (told,) = flaws(T, np.where((T > 4) & (T < 4.2), y[800], y))
    assert told.startswith("is stuck at ")
    (told,) = flaws(T, np.repeat(y[::5], 5))
    assert "in every 5 samples only" in told
    (told,) = flaws(T, np.full(len(T), 2.5))
    assert told == "never changes (it is 2.5 throughout)"
    # At rest at the end of its range at first: nothing is cut off.
    assert list(flaws(T, np.where(T < 1, 0.0, 1 - np.cos(T - 1)))) == []
    assert list(flaws(T, np.round(y, 2))) == []


@pytest.fixture
def spec(tmp_path):
    def write(channels, **more):
        table = np.column_stack([T, *channels.values()])
        np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t," + ",".join(channels), comments="", fmt="%.9f")
        recording = {"kind": "csv", "files": ["log.csv"], "columns": {n: n for n in channels}}
        tree = {"version": 1, "name": "sled", "model": SLED, "recording": recording, "diagnose": {"effects": FEW}, **more}
        (tmp_path / "sled.yaml").write_text(json.dumps(tree))
        return ["inspect", str(tmp_path / "sled.yaml"), "--out", str(tmp_path / "runs")]

    return write


@pytest.mark.run
def test_the_command_says_what_a_spec_could_show(spec, capsys, tmp_path):
    _, recording = logged(PUSHED)
    (tr,) = recording.trajectories
    command = spec({n: tr.channels[n] for n in ("x", "F")})
    assert main([*command, "--json"]) == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert list(answer) == ["log", "tables", "could_show", "report"]
    assert list(answer["could_show"]) == ["seen", "unseen", "alike", "unexcited", "feedback", "channels"]
    assert list(answer["could_show"]["seen"][0]) == ["effect", "site", "parameter", "value", "unit", "share", "off"]
    assert answer["tables"][0]["columns"][0]["flaws"] == []
    assert "what this log could show" in err
    assert "- this log does not tell apart, where they are small: " in err
    assert max(map(len, err.partition("\n- ")[0].splitlines())) < 110
    page = (tmp_path / "runs" / "inspect-sled.yaml" / "report.html").read_text()
    assert "What this log could show" in page
    assert "Coulomb friction at x: 0.0" in page


@pytest.mark.run
def test_what_a_diagnosis_would_refuse_is_told_beside_the_tables(spec, capsys):
    command = spec({"x": np.full(2400, 0.25), "F": PUSHED[:, 0]})
    assert main(command) == 2
    out = capsys.readouterr().out
    assert "x never changes (it is 0.25 throughout)" in out
    assert "what this log could show cannot be said: recording: 'x' never changes" in out
    assert main(spec({"x": PUSHED[:, 0], "F": PUSHED[:, 0]}, diagnose={"effects": ["vicious-friction"]})) == 2
