"""A spec with a recording in place of a backend: what it runs, what it claims, and what it refuses."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from measuring import RANGES, calibrated, recording

import gapcert as gc
from gapcert.cli.main import main
from gapcert.numerics.order_statistics import WINDOWS
from gapcert_verify.verify import verify_run

ROOT = Path(__file__).parents[2]
SPEC: dict[str, Any] = {
    "version": 1,
    "name": "drift",
    "model": {
        "kind": "equations",
        "states": {"x0": "m"},
        "inputs": {"u0": "m/s"},
        "derivative": {"x0": "u0"},
        "integrator": "euler",
        "period": "100 ms",
    },
    "recording": {
        "kind": "csv",
        "files": ["log.csv"],
        "trajectory": "run",
        "columns": {"x0": "x", "u0": "u"},
        "units": {"x": "mm"},
    },
    "domain": {name: list(ends) for name, ends in RANGES.items()},
    "certificate": {"claim": "statistical", "violation": 0.05, "route": "calibrate"},
    "report": {"rerun": False},
}


def logged(path: Path, log: gc.Recording, names: tuple[str, ...] = ("t", "x", "u", "run"), scale: float = 1e3) -> Path:
    """As CSV, with every digit."""
    rows = [
        (t, scale * x, u, i)
        for i, tr in enumerate(log.trajectories)
        for t, x, u in zip(tr.t, tr.channels["x0"], tr.channels["u0"], strict=True)
    ]
    path.write_text("\n".join([",".join(names), *(",".join(repr(float(v)) for v in row) for row in rows)]) + "\n")
    return path


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    logged(tmp_path / "log.csv", recording(90))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def changed(**sections: Any) -> dict[str, Any]:
    """The spec with sections merged in; None removes one."""
    merged = {k: {**SPEC[k], **v} if isinstance(v, dict) and isinstance(SPEC.get(k), dict) else v for k, v in sections.items()}
    return {k: v for k, v in (SPEC | merged).items() if v is not None}


def test_a_run_says_what_python_does(here: Path) -> None:
    done = gc.run(SPEC, out="runs")
    by_hand = calibrated()
    assert (done.exit_code, done.summary["verdict"]) == (0, "holds")
    assert isinstance(done.certificate, gc.CalibratedRecording)
    c = done.summary["certificate"]
    assert c["claim"] == {"kind": "statistical", "epsilon": 0.05, "distribution": WINDOWS}
    assert c["recording"]["windows"] == by_hand.summary()["recording"]["windows"] == {"fit": 30, "calibration": 60}
    assert c["recording"]["score"] == pytest.approx(by_hand.score, rel=1e-9)  # millimetres cost a rounding
    assert c["recording"]["number"] == 1
    assert any("assumed, not tested" in s for s in c["assumptions"])
    assert "a further window that is exchangeable" in done.summary["reason"]
    assert 1 < c["states"]["x0"]["tightness"] < 10
    report = (done.folder / "report.html").read_text()
    assert "provided that windows are exchangeable: 60 of them, which the fit has not seen, set γ" in report
    assert "Scores of the held windows" in report
    assert "simulator" not in re.sub(r"<(style|svg).*?</\1>", "", report, flags=re.DOTALL).lower()
    assert verify_run(done.folder)["verdict"] == "holds"


def test_confidence_and_windows_are_asked_for(here: Path) -> None:
    asked = {"violation": 0.1, "confidence": 0.9, "window": "1 s", "fit": "50 %"}
    c = gc.run(changed(certificate=asked), out="runs").summary["certificate"]
    assert c["claim"]["beta"] == 0.1
    assert c["recording"]["windows"] == {"fit": 90, "calibration": 90}


@pytest.mark.run
def test_the_commands_take_it(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "spec.yaml").write_text(json.dumps(SPEC))
    assert main(["run", "spec.yaml", "--json", "--quiet"]) == 0
    summary = json.loads(capsys.readouterr().out)
    run = summary["run_dir"]
    assert main(["verify", run]) == 0
    assert "the held windows give the widening of the band" in capsys.readouterr().out
    own, other = ("t", "x0", "u0", "run"), recording(5, 7)
    one = logged(here / "one.csv", gc.Recording(other.trajectories[:1]), own, 1.0)
    assert main(["check", run, str(one), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], found["points"]) == ("holds", 20)
    tr = other.trajectories[0]
    worn = gc.Recording((gc.Trajectory(tr.t, {**tr.channels, "x0": tr.channels["x0"] + 3 * tr.t}),))
    assert main(["check", run, str(logged(here / "worn.csv", worn, own, 1.0)), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["violations"][0]["state"] == "x0"
    assert main(["check", run, "spec.yaml", "--json"]) in (0, 1)
    points = json.loads(capsys.readouterr().out)["points"]
    assert points == sum(summary["certificate"]["recording"]["transitions"].values())
    assert main(["report", run]) == 0


def test_an_interrupted_run_goes_on_to_the_same_bits(here: Path) -> None:
    def stop(event: gc.Event) -> None:
        if event.name == "stage-finished" and event.stage == "certificate":
            raise KeyboardInterrupt

    whole = gc.run(SPEC, out="whole").folder
    with pytest.raises(KeyboardInterrupt):
        gc.run(SPEC, out="runs", observers=[stop])
    assert not list(Path("runs").glob("*/summary.json"))
    again = gc.run(SPEC, out="runs")
    assert again.summary["certificate"]["recording"]["number"] == 1
    for name in ("certificate.npz", "certificate.json", "figures.npz"):
        assert (again.folder / name).read_bytes() == (whole / name).read_bytes()


def test_a_second_look_at_the_same_measurements_is_told(here: Path) -> None:
    gc.run(SPEC, out="runs")
    second = gc.run(changed(gap={"kind": "constant"}), out="runs").summary["certificate"]
    assert second["recording"]["number"] == 2
    assert "this is calibration 2 on the same measurements" in second["warnings"][0]
    logged(here / "log.csv", recording(90, 1))
    assert gc.run(changed(gap={"kind": "constant"}), out="runs").summary["certificate"]["recording"]["number"] == 1


def test_an_extended_model_is_subtracted_first_within_relations(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wave = {**SPEC["model"], "parameters": {"a": "0.1 m/s", "k": "3 1/m"}, "derivative": {"x0": "u0 + a*sin(k*x0)"}}
    (here / "extended.yaml").write_text(json.dumps({"version": 1, "name": "extended", "model": wave}))
    spec = changed(
        gap={"kind": "envelope", "predictor": {"model": "extended.yaml"}},
        relations=["x0 + 0.1*u0 <= 0.5"],
        certificate={"violation": 0.1},
    )
    done = gc.run(spec, out="runs")
    c = done.certificate
    assert isinstance(c, gc.CalibratedRecording)
    assert (c.held.z @ [1, 0.1] <= 0.5).all()
    assert c.summary()["recording"]["rows"]["outside"] > 0
    assert c.problem.predictor.kind == "model"
    assert verify_run(done.folder)["verdict"] == "holds", verify_run(done.folder)
    log = logged(here / "again.csv", recording(20, 5), ("t", "x0", "u0", "run"), 1.0)
    assert main(["check", str(done.folder), str(log), "--json"]) in (0, 1)
    found = json.loads(capsys.readouterr().out)
    assert found["band_violations"] == c.check(recording(20, 5)).band_violations
    assert found["outside_domain"] > 0


def test_windows_may_be_a_matrix_and_each_is_a_look(here: Path) -> None:
    done = gc.run(changed(matrix={"certificate.window": ["1 s", "2 s"]}), out="runs")
    assert [r.summary["certificate"]["recording"]["number"] for r in done.runs] == [1, 2]
    assert [r.summary["certificate"]["recording"]["units"] for r in done.runs] == [180, 90]


BACKEND = {"kind": "equations", **{k: v for k, v in SPEC["model"].items() if k != "kind"}}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a state that is not measured": (
        {"recording": {"columns": {"u0": "u"}, "units": {}}},
        r"recording.columns: nothing for 'x0'; every state and input of the model has to be measured \(x0, u0\)",
    ),
    "another route": ({"certificate": {"route": "dominate"}}, r"certificate.route: route dominate asks a simulator at points"),
    "a stronger claim": (
        {"certificate": {"claim": "deterministic", "route": None}},
        r"certificate.claim: a recording gives a statistical claim",
    ),
    "an attack": ({"certificate": {"attack": 10}}, r"certificate.attack: 'attack' is about points drawn from a simulator"),
    "exceedances": ({"certificate": {"exceedances": 3}}, r"certificate.exceedances: 'exceedances' is about points drawn"),
    "sampling": ({"sampling": {"kind": "adaptive", "budget": 9}}, r"sampling: 'sampling' needs a simulator"),
    "a period to resample to": ({"recording": {"every": "50 ms"}}, r"recording.every: a calibration takes rows as they were"),
    "no period": ({"model": {**SPEC["model"], "period": None}}, r"model"),
    "windows of a backend": (
        {"recording": None, "backend": BACKEND, "certificate": {"window": "1 s"}},
        r"certificate.window: only a recording in place of a backend has windows",
    ),
    "a backend beside it": ({"backend": BACKEND}, r"recording: 'recording' needs 'diagnose', which is missing"),
    "no domain": ({"domain": None}, r"certificate: 'certificate' needs 'domain', which is missing"),
    "too few windows": ({"certificate": {"violation": 0.01}}, r"90 trajectories .* ε = 0\.01 needs 99 others, 148 in all"),
    "too few for a confidence": (
        {"certificate": {"confidence": 0.999999}},
        r"ε = 0\.05, β = 1e-06 needs 270 others, 404 in all",
    ),
    "another sampling than the model's": (
        {"model": {"period": "70 ms"}},
        r"no two rows are one period of 0\.07 s apart .*\(rows are 0\.1 s apart\)",
    ),
    "a domain where nothing begins": ({"domain": {"x0": [5, 6]}}, r"no transition of a whole window begins in the domain"),
    "windows longer than any trajectory": (
        {"certificate": {"window": "5 s"}},
        r"no trajectory is as long as a window of 5\.0 s",
    ),
    "constants that are estimated": (
        {"lipschitz": {"residual": {"kind": "wood-zhang"}}},
        r"a recording answers no questions; declare them",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_one_error(here: Path, name: str) -> None:
    sections, message = REFUSED[name]
    with pytest.raises(gc.GapcertError, match=message) as found:
        gc.run(changed(**sections), out="runs")
    assert found.value.exit_code == 2
    assert len(getattr(found.value, "problems", ()) or [None]) == 1
    assert not list(Path("runs").glob("*/certificate.json"))


def test_a_column_without_numbers_is_named(here: Path) -> None:
    log = recording(90)
    empty = tuple(gc.Trajectory(tr.t, tr.channels, tr.name) for tr in log.trajectories)
    text = logged(here / "log.csv", gc.Recording(empty)).read_text().splitlines()
    rows = [",".join((t, "nan", u, i)) for t, _, u, i in (line.split(",") for line in text[1:])]
    (here / "log.csv").write_text("\n".join([text[0], *rows]) + "\n")
    with pytest.raises(gc.UsageError, match=r"'x0' holds no finite number"):
        gc.run(SPEC, out="runs")


def test_tosses_of_a_cube_beside_free_fall(tmp_path: Path) -> None:
    done = gc.run(ROOT / "specs/free_fall.yaml", overrides=("report.rerun=false",), out=tmp_path)
    assert done.exit_code == 0, done.summary["expectations"]
    c = done.certificate
    assert isinstance(c, gc.CalibratedRecording)
    assert (c.claim.epsilon, c.claim.beta) == (0.05, 0.01)
    assert (c.units, len(c.held), c.rank) == (364, 243, 239)
    told = (
        "14 of 379 trajectories are copies of others and count once: '140' is a copy of '56', '301' of '172', '302' of '173', "
    )
    assert c.warnings == [f"{told}and 11 more"]
    copies = done.summary["certificate"]["recording"]["copies"]
    assert (len(copies), copies[1]["name"], copies[1]["of"], {k["whole"] for k in copies}) == (14, "301", "172", {True})
    low, high = c.gap.interval(c.held.z)
    out = c.held.window[((c.held.r < low) | (c.held.r > high)).any(axis=1)]
    assert len(np.unique(out)) == 243 - 239
    assert verify_run(done.folder)["verdict"] == "holds"


def test_measurements_are_the_same_whatever_their_names_units_and_order(here: Path) -> None:
    """Fresh ones cannot be drawn, so that a second look at them warns, however they are written."""
    log = recording(90)
    assert gc.run(SPEC, out="runs").certificate.entry.k == 1
    logged(here / "m.csv", log, ("time", "place", "push", "n"), scale=1.0)
    renamed = {
        "kind": "csv",
        "files": ["m.csv"],
        "trajectory": "n",
        "time": "time",
        "columns": {"x0": "place", "u0": "push"},
    }
    second = gc.run({**SPEC, "name": "again", "recording": renamed}, out="runs").certificate
    assert second.entry.k == 2
    assert "this is calibration 2 on the same measurements" in second.warnings[0]
    logged(here / "log.csv", gc.Recording(tuple(reversed(log.trajectories[20:]))))
    assert gc.run({**SPEC, "name": "less"}, out="runs").certificate.entry.k == 3
    logged(here / "log.csv", recording(90, 1))
    assert gc.run({**SPEC, "name": "fresh"}, out="runs").certificate.entry.k == 1
