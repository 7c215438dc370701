"""A look into a log: what is told of every column, and how it is shown."""

import json

import numpy as np
import pytest

import gapcert as gc
from gapcert.cli.main import main
from gapcert_recordings.inspect import in_words, inspect, sentence
from gapcert_report.pages.log import write_log_page

T = np.arange(3000) * 0.002
NOISE = 1e-3


def write(path, t=T, **more):
    import pyarrow
    from pyarrow import csv

    rng = np.random.default_rng(0)
    q = np.sin(2 * np.pi * T) + NOISE * rng.standard_normal(len(T))
    q[700] = 40.0
    more = {"q": q, "ticks": np.round(np.sin(2 * np.pi * T) / 0.01) * 0.01, "label": ["run"] * len(T), **more}
    csv.write_csv(pyarrow.table({"t": t, **more}), path)
    return path


def test_every_column_is_described(tmp_path):
    (table,) = inspect(write(tmp_path / "log.csv"))
    assert (table.name, table.time, len(table.t)) == ("log.csv", "t", 3000)
    assert table.period == pytest.approx(0.002)
    q, ticks = table.columns
    assert (q.name, q.high, q.outliers, q.missing) == ("q", 40, 1, 0)
    assert q.noise == pytest.approx(NOISE, rel=0.1)
    assert q.step is None
    assert ticks.step == pytest.approx(0.01)
    assert sentence(table) == "3,000 rows over 5.998 s, 500 Hz (every 0.002 s)"


def test_flaws_of_the_clock_are_told(tmp_path):
    t = np.where(T < 2, T, T + 0.4)
    t = np.where(T < 4, t, T - 4)
    t[100] = t[99]
    (table,) = inspect(write(tmp_path / "log.csv", np.delete(np.append(t, 3.0), -1)))
    said = sentence(table)
    assert "1 gaps, the longest 0.402 s" in said
    assert "the clock is set back 1 times" in said
    assert "1 rows whose time does not go forward" in said
    assert "1 samples lost" in said
    facts = table.facts()
    assert facts["gaps"][0]["at"] == pytest.approx(1.998)
    json.dumps(facts, allow_nan=False)


@pytest.mark.exam
@pytest.mark.parametrize("fill", [9.96921e36, float(np.finfo(np.float32).max), -1e308, -9999.0])
def test_what_formats_fill_holes_with_is_missing(tmp_path, capsys, fill):
    q = np.where(np.arange(3000) % 1000 == 500, fill, np.sin(T))
    log = write(tmp_path / "log.csv", filled=q)
    found = {c.name: c for c in inspect(log)[0].columns}
    assert (found["filled"].missing, found["filled"].low) == (3, pytest.approx(-1.0, abs=0.01))
    assert main(["inspect", str(log), "--out", str(tmp_path / "runs")]) == 0
    assert "error" not in capsys.readouterr().err


def test_numbers_that_are_missing(tmp_path):
    import pyarrow
    from pyarrow import parquet

    q = np.where(np.arange(3000) % 10, np.sin(T), np.nan)
    parquet.write_table(pyarrow.table({"t": T, "q": q, "nothing": np.full(3000, np.nan)}), tmp_path / "log.parquet")
    (table,) = inspect(tmp_path / "log.parquet")
    found = {c.name: c for c in table.columns}
    assert found["q"].missing == 300
    assert found["nothing"].missing == 3000
    json.dumps(table.facts(), allow_nan=False)


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_times_since_1970_are_understood(tmp_path, unit):
    parts = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[unit]
    step = max(1, parts // 500)
    stamps = 1_700_000_000 * parts + np.arange(3000, dtype=np.int64) * step
    (table,) = inspect(write(tmp_path / "log.csv", stamps))
    assert table.period == pytest.approx(step / parts)


@pytest.mark.parametrize(
    ("header", "period"),
    [("time [ms]", 2e-6), ("Time (s)", 2e-3), ("t[us]", 2e-9), ("timestamp [µs]", 2e-9), ("(time)", 2e-3), ("time [h]", None)],
)
def test_a_time_whose_header_states_its_unit(tmp_path, header, period):
    import pyarrow
    from pyarrow import csv

    csv.write_csv(pyarrow.table({header: T, "q": np.sin(T)}), tmp_path / "log.csv")
    (table,) = inspect(tmp_path / "log.csv")
    assert table.period == (None if period is None else pytest.approx(period))
    assert [c.name for c in table.columns] == (["q"] if period else [header, "q"])


def test_units_that_a_header_states_are_shown(tmp_path):
    (table,) = inspect(write(tmp_path / "log.csv", **{"Angle [deg]": np.sin(T), "Torque (N*m)": np.cos(T), "gain [x]": T}))
    assert [c.unit for c in table.columns if " " in c.name] == ["deg", "N*m", ""]


def test_rows_are_counted_where_no_column_has_the_time(tmp_path):
    import pyarrow
    from pyarrow import csv

    csv.write_csv(pyarrow.table({"q": np.sin(T)}), tmp_path / "log.csv")
    (table,) = inspect(tmp_path / "log.csv")
    assert table.time is None
    assert sentence(table).startswith("3,000 rows; no column is called time or t (in a spec, `time:` names the one")
    assert "rate" not in table.facts()


def test_a_spec_shows_its_recording_as_mapped(tmp_path):
    write(tmp_path / "log.csv")
    spec = tmp_path / "spec.yaml"
    spec.write_text(
        "version: 1\nname: one\nmodel:\n  kind: equations\n  coordinates: {x: {unit: rad, kind: angle}}\n  inputs: {u: N*m}\n"
        "  parameters: {J: 1 kg*m^2}\n  mass_matrix: [[J]]\n  forces: {x: u}\n"
        "recording: {kind: csv, files: [log.csv], columns: {x: q, u: ticks}, units: {q: deg}}\n"
        "diagnose: {hold_out: {from: 3 s, to: 5 s}, horizons: [0.5 s]}\n"
    )
    (table,) = inspect(spec)
    assert [(c.name, c.unit) for c in table.columns] == [("x", "deg"), ("u", "")]
    assert gc.load_spec(spec).config.sections["diagnose"].hold_out.start == 3


def test_the_page_shows_every_column(tmp_path):
    tables = inspect(write(tmp_path / "log.csv", np.where(T < 2, T, T + 0.4)))
    text = write_log_page(tmp_path / "out" / "report.html", "log.csv", tables).read_text()
    assert text.count('<div class="plot"><svg') == 3  # the steps of time, and two columns
    assert "noise floor" in text
    assert "http:" not in text
    assert "https:" not in text


@pytest.mark.run
def test_the_command_prints_and_writes(tmp_path, capsys):
    write(tmp_path / "log.csv")
    assert main(["inspect", str(tmp_path / "log.csv"), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[0] == "log.csv: 3,000 rows over 5.998 s, 500 Hz (every 0.002 s)"
    assert (tmp_path / "inspect-log.csv" / "report.html").is_file()
    assert main(["inspect", str(tmp_path / "log.csv"), "--out", str(tmp_path), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["tables"][0]["columns"][0]["outliers"] == 1
    assert answer["report"].endswith("report.html")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("none.csv", "there is no such file; expected a log"),
        ("log.xyz", r"no reader knows files that end in '\.xyz'"),
        ("spec.yaml", "the spec has no recording"),
        (".", "nothing in it is a table of numbers"),
    ],
)
def test_what_is_no_log(tmp_path, name, says):
    (tmp_path / "log.xyz").write_text("?")
    (tmp_path / "spec.yaml").write_text(
        "version: 1\nname: one\nmodel: &m {kind: equations, states: {x: m}, derivative: {x: '-x/tau'}, parameters: {tau: 1 s},"
        " period: 1 s}\nbackend: *m\ndomain: {x: [0, 1]}\ncertificate: {claim: empirical}\n"
    )
    with pytest.raises(gc.UsageError, match=says):
        inspect(tmp_path / name)


def test_words_fit_a_terminal(tmp_path):
    lines = in_words(inspect(write(tmp_path / "log.csv")))
    assert max(map(len, lines)) < 100
    assert lines[1].split() == ["column", "least", "greatest", "deviation", "noise", "floor", "step", "missing", "outliers"]


def test_a_column_with_text_is_named_with_its_line(tmp_path, capsys):
    lines = [f"{t:.3f},{t:.3f},{t:.3f}" for t in T[:40]]
    lines[6], lines[8] = "0.012,,oops", "0.016,NaN,"
    (tmp_path / "log.csv").write_text("\n".join(["t,q,load", "", *lines]))
    (table,) = inspect(tmp_path / "log.csv")
    assert [(c.name, c.missing) for c in table.columns] == [("q", 2)]
    assert "  not numbers: load (line 9: 'oops')" in in_words([table])
    assert table.facts()["not_numbers"] == [{"name": "load", "at": "line 9", "value": "oops"}]
    write_log_page(tmp_path / "page.html", "log", [table])
    assert "Not numbers: load (line 9: &#x27;oops&#x27;)." in (tmp_path / "page.html").read_text()


def test_a_log_without_rows_or_values(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.csv").write_text("t,q\n")
    (tmp_path / "lost.csv").write_text("t,q\n" + "".join(f"{i},\n" for i in range(2000)))
    assert main(["inspect", "empty.csv"]) == main(["inspect", "lost.csv"]) == 0
    out = capsys.readouterr().out
    assert "empty.csv: no rows" in out
    assert inspect("lost.csv")[0].columns[0].missing == 2000
