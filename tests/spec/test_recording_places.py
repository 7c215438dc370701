"""What is wrong with a recording is told at the key of the spec that asks for it."""

import os

import pytest

import gapcert as gc
from gapcert.cli.main import main
from gapcert.spec.compose import data_files

SPEC = """version: 1
name: slide
model:
  kind: equations
  coordinates: {q: m}
  inputs: {F: N}
  parameters: {mass: 2 kg}
  mass_matrix: [[mass]]
  forces: {q: F}
recording:
  kind: csv
  files: [log.csv]
  columns: {q: angle, F: force}
diagnose:
  hold_out: {last: 33 %}
  horizons: [0.5 s]
report: {html: false, rerun: false}
"""
ROWS = "".join(f"{0.01 * i:.2f},{i * i % 11},{i % 7}\n" for i in range(100))

# what is replaced, by what, line:column of the error, its sentence, its hint
WRONG = {
    "missing column": ("q: angle", "q: angel", "13:16", "columns.q: log.csv: 'angel' is not a column", "did you mean 'angle'?"),
    "missing time": ("  columns", "  time: when\n  columns", "13:9", "time: log.csv: 'when' is not a column", "there are"),
    "unmapped input": (", F: force", "", "13:12", "columns: no channel for the input 'F'", "add it to `columns`"),
    "unknown channel": (
        "F: force",
        "F: force, v: force",
        "13:36",
        "columns.v: channel 'v' is no input or",
        "there are F",
    ),
    "no output": ("q: angle, ", "", "13:12", "columns: no output is measured", "add one of q, q_dot to"),
    "unit": (
        "force}",
        "force}\n  units: {angle: kg}",
        "14:18",
        "units.angle: 'q': unit 'kg' does not fit; expected m",
        "give the column's unit",
    ),
    "unit of a channel": (
        "force}",
        "force}\n  units: {q: cm}",
        "14:14",
        "units.q: 'q' is a channel, and units are those of columns",
        "write 'angle'",
    ),
    "unit of no column": (
        "force}",
        "force}\n  units: {angel: cm}",
        "14:18",
        "units.angel: 'angel' is not one of",
        "did you mean 'angle'?",
    ),
}


# The same of what a diagnosis asks of the recording.
ASKED = {
    "no such time": (
        "last: 33 %",
        "from: 2 s",
        "15:13",
        "hold_out: from 2 s; expected at least 16 samples",
        "the recording",
    ),
    "no such one": (
        "last: 33 %",
        "trajectories: [log]",
        "15:28",
        "hold_out.trajectories: 'log' is no",
        "did you mean 'log.csv'?",
    ),
    "all": ("last: 33 %", "every: 1", "15:13", "hold_out: all 1 trajectories; expected some", "hold out fewer"),
    "horizon": ("[0.5 s]", "[5 s]", "16:13", "horizons: a horizon of 5 s does not fit the held-out data", "shorten it or hold"),
    "short horizon": ("[0.5 s]", "[1 ms]", "16:13", "horizons: 0.001 s is shorter than 0.01 s", "is its time in s?"),
    "window": ("[0.5 s]", "[0.2 s]\n  window: 20 ms", "17:11", "window: 0.02 s hold 2 samples", "give 0.08 s"),
}


@pytest.mark.parametrize("name", ASKED)
def test_a_diagnosis_that_does_not_fit_is_told_at_its_key(tmp_path, monkeypatch, name):
    old, new, place, says, hint = ASKED[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slide.yaml").write_text(SPEC.replace(old, new))
    rows = "".join(f"{0.01 * i:.2f},{0.1 * (i % 17)},{i % 7}\n" for i in range(180))
    (tmp_path / "log.csv").write_text("t,angle,force\n" + rows)
    with pytest.raises(gc.SpecError) as error:
        gc.run("slide.yaml")
    first, _, caret = str(error.value).splitlines()
    assert first.startswith(f"slide.yaml:{place}: error: diagnose.{says}")
    assert hint in caret


@pytest.mark.parametrize("name", WRONG)
def test_a_recording_that_does_not_fit_is_told_at_its_key(tmp_path, monkeypatch, name):
    old, new, place, says, hint = WRONG[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slide.yaml").write_text(SPEC.replace(old, new))
    (tmp_path / "log.csv").write_text("t,angle,force\n" + ROWS)
    with pytest.raises(gc.SpecError) as error:
        gc.run("slide.yaml")
    first, _, caret = str(error.value).splitlines()
    assert first.startswith(f"slide.yaml:{place}: error: recording.{says}")
    assert hint in caret
    assert error.value.problems[0]["line"] == int(place.partition(":")[0])


def test_a_value_that_is_no_number_is_told_at_the_channel(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slide.yaml").write_text(SPEC)
    (tmp_path / "log.csv").write_text("t,angle,force\n" + ROWS.replace("0.05,3,5", "0.05,3,off"))
    assert main(["inspect", "slide.yaml"]) == 2
    says = "slide.yaml:13:26: error: recording.columns.F: log.csv: column 'force' holds 'off' in line 7; expected a number"
    assert says in capsys.readouterr().err


def test_a_folder_that_goes_while_it_is_read_is_left_out(tmp_path, monkeypatch):
    for name in ("kept", "gone"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.csv").write_text(ROWS)
    listed = os.scandir

    def vanishing(path):
        if str(path).endswith("gone"):
            raise FileNotFoundError(path)
        return listed(path)

    monkeypatch.setattr(os, "scandir", vanishing)
    assert data_files(tmp_path) == [tmp_path / "kept" / "log.csv"]
