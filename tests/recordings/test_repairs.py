"""What is changed in a log before it is used is told: in words, as a warning that --quiet keeps, and in the report."""

import numpy as np
import pytest

from gapcert.cli.main import main
from gapcert_recordings.resampling import repairs

SPEC = """version: 1
name: rod
model:
  kind: equations
  coordinates: {q: {unit: rad, kind: angle}}
  inputs: {u: N*m}
  parameters: {m: 1 kg, l: 1 m, g: 9.81 m/s^2}
  mass_matrix: [[m*l**2/3]]
  bias: {q: m*g*l/2*sin(q)}
  forces: {q: u}
  integrator: semi_implicit
  period: 10 ms
recording: {kind: csv, files: [log.csv], columns: {q: q, u: u}}
diagnose: {effects: [viscous-friction], hold_out: {last: 25 %}, horizons: [0.5 s]}
report: {rerun: false}
"""


def swing(count=900):
    t = 0.01 * np.arange(count)
    q, v = np.zeros(count), 0.0
    u = np.sin(2 * t)
    for k in range(count - 1):
        v += 0.01 * 3 * (u[k] - 9.81 / 2 * np.sin(q[k]))
        q[k + 1] = q[k] + 0.01 * v
    return np.stack([t, q + 1e-4 * np.random.default_rng(0).standard_normal(count), u], axis=1)


def log(rows):
    return "t,q,u\n" + "\n".join(",".join("" if np.isnan(v) else f"{v:.7g}" for v in row) for row in rows) + "\n"


def spoilt(rows):
    rows = rows.copy()
    rows[50, 1], rows[300, 1], rows[80, 0] = np.nan, 40.0, rows[79, 0]
    rows[400:, 0] -= 2.0
    return np.delete(rows, slice(200, 220), axis=0)


@pytest.mark.run
@pytest.mark.parametrize("quiet", [[], ["--quiet"]])
def test_what_was_changed_in_a_log_is_told_with_quiet_too(tmp_path, monkeypatch, capsys, quiet):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rod.yaml").write_text(SPEC)
    (tmp_path / "log.csv").write_text(log(spoilt(swing())))
    assert main(["diagnose", "rod.yaml", *quiet]) == 0
    out, err = capsys.readouterr()
    told = (
        "warning: recording: of the data that are fitted: the clock is set back at 3.99 s, where the recording is cut; "
        "time jumps ahead at 1.99 s, where the recording is cut; "
        "1 row whose time is missing or does not go forward is left out; 1 row is missing, and bridged; "
        "1 value of q is far outside of everything around, and left out"
    )
    assert told in err
    assert "warning" not in out
    assert ("stage" in err or " ..." in err) is not bool(quiet)
    (page,) = tmp_path.glob("runs/*/report.html")
    assert "the clock is set back at 3.99 s, where the recording is cut" in page.read_text()


def test_a_clean_log_is_no_matter(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rod.yaml").write_text(SPEC.replace("rerun: false", "rerun: false, html: false"))
    (tmp_path / "log.csv").write_text(log(swing()))
    assert main(["diagnose", "rod.yaml", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_every_kind_has_its_words():
    many = [{"trajectory": "a", "at": float(k), "seconds": 1.0} for k in range(5)]
    log = {"resets": many, "cuts": many[:1], "duplicates": 1200, "dropped": 3, "stamps": "ignored", "unused": 2.5}
    log |= {"outliers": {"q": 2}, "missing": {"p": 1}, "repaired": {"u": 1}, "jitter": 0.0, "period": 0.1}
    assert list(repairs(log)) == [
        "the clock is set back 5 times (first at 0 s, 1 s, 2 s), where the recording is cut",
        "an input moved unseen at 0 s, where the recording is cut",
        "1,200 rows whose time is missing or does not go forward are left out",
        "3 rows are missing, and bridged",
        "times are taken for those of arrival, and replaced by even ones",
        "2 values of q are far outside of everything around, and left out",
        "1 value of p is missing, and left out",
        "1 reading of u is far outside of everything else, and replaced",
        "2.5 s are in stretches too short or too empty to be used",
    ]
