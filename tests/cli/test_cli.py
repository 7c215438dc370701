"""The command line: one object on stdout for --json, one sentence for every error, and exit codes that mean something."""

import errno
import importlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import gapcert
from gapcert import Event, GapcertError, registry
from gapcert.cli.main import main
from gapcert.cli.terminal import Terminal
from gapcert.contracts.plugins.component import Component
from gapcert.contracts.plugins.registry import Registry, installed
from gapcert.numerics.errors import Interrupted
from gapcert.numerics.texts import columns
from gapcert_report.words.summary import in_words

MINIMAL = """\
version: 1
name: minimal
model: {kind: equations, states: {x: m}, inputs: {u: m/s}, next: {x: x + u*(1 s)}, period: 1 s}
backend: {kind: equations, states: {x: m}, inputs: {u: m/s}, next: {x: x + u*(1 s)}, period: 1 s}
domain: {x: [-1, 1], u: [-1, 1]}
certificate: {claim: statistical}
"""


@pytest.fixture
def spec(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = MINIMAL.replace("x + u*(1 s)", "x + h*u").replace("inputs: {u: m/s},", "inputs: {u: m/s}, parameters: {h: 1 s},")
    Path("minimal.yaml").write_text(text)
    return "minimal.yaml"


@pytest.fixture
def faked(monkeypatch):
    """Replaces the execution of specs by an answer or an exception, and remembers how it was asked."""

    def fake(outcome, code=0):
        asked = SimpleNamespace()

        def execute(spec, **options):
            asked.spec, asked.options = spec, options
            if isinstance(outcome, BaseException):
                raise outcome
            for observer in options["observers"]:
                observer(Event("stage-started", "certificate"))
            return SimpleNamespace(summary=outcome, exit_code=code)

        monkeypatch.setattr(importlib.import_module("gapcert.run.run"), "run", execute)
        return asked

    return fake


def one_object(text):
    return json.loads(text)


# --- commands that need no run


def test_help_names_every_command(capsys):
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    for name in ("run", "diagnose", "validate", "schema", "plugins", "verify", "report", "doctor"):
        assert f"\n    {name} " in out


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == gapcert.__version__


@pytest.mark.run
def test_plugins_lists_what_is_there(capsys):
    assert main(["plugins", "--json"]) == 0
    rows = one_object(capsys.readouterr().out)
    assert all(set(row) == {"kind", "name", "distribution", "available", "reason"} for row in rows)
    assert {(r["kind"], r["name"]) for r in rows} >= {
        ("executor", "processes"),
        ("model", "equations"),
        ("backend", "pybullet"),
    }
    assert main(["plugins"]) == 0
    assert "equations" in capsys.readouterr().out


@pytest.mark.run
def test_schema_is_one_object(capsys):
    assert main(["schema"]) == 0
    assert one_object(capsys.readouterr().out)["else"]["properties"]["version"] == {"const": 1}


@pytest.mark.run
def test_doctor_knows_versions_components_and_programs(capsys):
    assert main(["doctor", "--json"]) == 0
    out = capsys.readouterr()
    found = one_object(out.out)
    assert found["python"].startswith(f"{sys.version_info.major}.{sys.version_info.minor}")
    assert {"chromium", "vulkan", "platform", "components", "packages"} <= set(found)
    assert found["packages"]["numpy"]
    assert len(found["components"]) == len(registry().listing())


@pytest.mark.contract
def test_doctor_has_a_block_to_paste_that_names_no_folder_at_home(capsys, monkeypatch):
    monkeypatch.setattr("gapcert.cli.doctor.Path.home", lambda: Path("/somebody"))
    monkeypatch.setattr("gapcert.cli.doctor._playwright", lambda: "/somebody/chrome")
    monkeypatch.setattr("gapcert.cli.doctor.BROWSERS", ())
    absent = Component("reader", "toy", "a toy", "toy:Toy", requires=("no_such_toy",), distribution="acme 1.0")
    monkeypatch.setattr("gapcert.cli.doctor.installed", lambda: Registry([*installed().components.values(), absent], [], None))
    assert main(["doctor", "--paste"]) == 0
    first, *lines, last = capsys.readouterr().out.splitlines()
    assert (first, last) == ("```text", "```")
    said = "\n".join(lines)
    assert f"gapcert {gapcert.__version__}, Python {sys.version_info.major}" in said
    assert "plugins of others: acme 1.0" in said
    assert "reader toy: reader 'toy' needs no_such_toy, which is not installed; run: pip install no_such_toy" in said
    assert "chromium: ~/chrome" in said
    assert "somebody" not in said


@pytest.mark.contract
def test_listings_answer_even_when_names_collide(spec, capsys, monkeypatch):
    twins = [Component("reader", "toy", "a toy", "toy:Toy", distribution=d) for d in ("acme 1.0", "toys 2.0")]
    twice = Registry([*installed().components.values(), *twins], [], installed().manager)
    monkeypatch.setattr("gapcert.contracts.plugins.registry.installed", lambda: twice)
    monkeypatch.setattr("gapcert.cli.doctor.installed", lambda: twice)
    sentence = "2 distributions declare reader 'toy': acme 1.0 (toy:Toy) and toys 2.0 (toy:Toy)"
    for command, rows in (("plugins", lambda d: d), ("doctor", lambda d: d["components"])):
        assert main([command]) == 2
        out = capsys.readouterr()
        assert out.out.count(sentence) == 2
        assert "equations" in out.out
        assert sentence in out.err
        assert main([command, "--json"]) == 2
        out = capsys.readouterr()
        assert [r["available"] for r in rows(one_object(out.out)) if r["name"] == "toy"] == [False, False]
        assert sentence in out.err
    assert main(["run", spec]) == 2
    assert sentence in capsys.readouterr().err
    assert not Path("runs").exists()


@pytest.mark.run
def test_validate(spec, capsys):
    assert main(["validate", spec]) == 0
    assert capsys.readouterr().out == "minimal.yaml: valid\n"
    assert main(["validate", spec, "--json"]) == 0
    answer = one_object(capsys.readouterr().out)
    assert (answer["valid"], answer["runs"]) == (True, ["minimal"])
    assert main(["validate", spec, "--set", "matrix={seed: [1, 2]}"]) == 0
    assert "(2 runs)" in capsys.readouterr().out


def test_validate_tells_all_errors_with_their_places(spec, capsys):
    assert main(["validate", spec, "--set", "domain.x=[1, -1]", "--set", "sead=1", "--json"]) == 2
    out = capsys.readouterr()
    answer = one_object(out.out)
    assert answer["exit_code"] == 2
    assert {p["path"] for p in answer["problems"]} == {"domain.x", "sead"}
    assert all({"file", "line", "column", "message", "hint"} <= set(p) for p in answer["problems"])
    assert "did you mean 'seed'?" in out.err


def test_a_missing_dependency_ends_with_3(spec, capsys, monkeypatch):
    monkeypatch.setattr("gapcert.contracts.plugins.component.importlib.util.find_spec", lambda name: None)
    assert main(["validate", spec]) == 3
    assert "pip install" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["run"], ["run", "a.yaml", "--colour"], ["flY"], ["validate", "a.yaml", "b.yaml"]])
def test_wrong_usage_ends_with_2(arguments, capsys):
    assert main(arguments) == 2
    assert capsys.readouterr().err


# --- run and diagnose


@pytest.mark.parametrize("code", [0, 1, 5])
def test_run_prints_the_summary_and_returns_its_code(spec, faked, capsys, code):
    asked = faked({"name": "minimal", "verdict": "holds", "reason": "because"}, code)
    arguments = ["run", spec, "--json", "--out", "there", "--executor", "threads", "--allow-code", "--set", "seed=7", "--view"]
    assert main(arguments) == code
    out = capsys.readouterr()
    assert one_object(out.out)["verdict"] == "holds"
    assert "certificate ..." in out.err
    assert "minimal: holds (because)" in out.err
    options = {k: v for k, v in asked.options.items() if k != "observers"}
    assert options == {"out": Path("there"), "executor": "threads", "allow_code": True, "view": True}
    assert asked.spec.config.seed == 7


def test_without_json_the_words_are_on_stdout_and_quiet_means_quiet(spec, faked, capsys):
    faked({"name": "minimal", "verdict": "fails"}, 1)
    assert main(["run", spec, "--quiet"]) == 1
    out = capsys.readouterr()
    assert out.out == "minimal: fails\n"
    assert out.err == ""


def test_diagnose_needs_something_to_diagnose(spec, faked, capsys):
    faked({})
    assert main(["diagnose", spec]) == 2
    assert "no diagnose: section" in capsys.readouterr().err


def test_a_spec_that_asks_for_nothing_is_not_run(spec, faked, capsys):
    faked({})
    Path("part.yaml").write_text("".join(Path(spec).read_text().splitlines(True)[:3]))
    assert main(["validate", "part.yaml"]) == 0
    assert main(["run", "part.yaml"]) == 2
    assert "nothing to do" in capsys.readouterr().err


# --- errors


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (GapcertError("no good"), 2, "no good"),
        (Interrupted("stopped; run it again"), 4, "stopped; run it again"),
        (KeyboardInterrupt(), 4, "go on with the same command: gapcert run minimal.yaml"),
        (OSError(errno.ENOSPC, "No space left on device", "runs/x"), 2, "runs/x: no space left on device; make room"),
        (OSError(errno.EACCES, "Permission denied", "runs/x"), 2, "choose another folder with --out"),
        (ZeroDivisionError("1/0"), 70, "internal error: ZeroDivisionError: 1/0"),
        (OSError(errno.ENOENT, "No such file", "x"), 70, "internal error: FileNotFoundError"),
    ],
)
def test_errors_are_sentences_with_exit_codes(spec, faked, capsys, error, code, words):
    faked(error)
    assert main(["run", spec]) == code
    out = capsys.readouterr()
    assert words in out.err
    assert "Traceback" not in out.err
    assert out.out == ""
    assert main(["run", spec, "--json"]) == code
    assert one_object(capsys.readouterr().out)["exit_code"] == code


@pytest.mark.parametrize("how", ["option", "variable"])
def test_debug_shows_where_an_internal_error_happened(spec, faked, capsys, monkeypatch, how):
    faked(ZeroDivisionError("1/0"))
    if how == "variable":
        monkeypatch.setenv("GAPCERT_DEBUG", "1")
    assert main(["run", spec, *(["--debug"] if how == "option" else [])]) == 70
    assert "Traceback" in capsys.readouterr().err


def test_warnings_are_one_line(spec, faked, capsys, monkeypatch):
    import warnings

    class Warns(dict):
        def get(self, *key):
            warnings.warn("no viewer", RuntimeWarning, stacklevel=1)
            return super().get(*key)

    faked(Warns(name="minimal", verdict="holds"))
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        assert main(["run", spec, "--quiet"]) == 0
    assert set(capsys.readouterr().err.splitlines()) == {"warning: no viewer"}


@pytest.mark.contract
def test_ctrl_c_ends_with_4(tmp_path):
    code = """if True:
        import sys, time, gapcert.spec.spec, gapcert.cli.main
        gapcert.spec.spec.load_spec = lambda *a, **k: (print('ready', flush=True), time.sleep(30))
        sys.exit(gapcert.cli.main.main(['run', 'x.yaml']))
    """
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 4
    assert "go on with the same command: gapcert run x.yaml" in err


@pytest.mark.contract
@pytest.mark.fault("whoever reads the output has gone (`| head`)", shows="no error")
def test_a_reader_that_goes_away_is_no_error(tmp_path):
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run([sys.executable, "-m", "gapcert", "schema"], stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


# --- verify and report


def test_verify_returns_its_verdict(monkeypatch, capsys, tmp_path):
    checks = [{"check": "audit", "passed": False, "detail": "3 points outside"}]
    monkeypatch.setattr("gapcert_verify.verify_run", lambda folder, *more, **asked: {"verdict": "fails", "checks": checks})
    assert main(["verify", str(tmp_path)]) == 1
    assert "FAILED  audit  3 points outside" in capsys.readouterr().out
    monkeypatch.setattr("gapcert_verify.verify_run", lambda folder, *more, **asked: {"verdict": "holds", "checks": []})
    assert main(["verify", str(tmp_path), "--json"]) == 0
    assert one_object(capsys.readouterr().out)["verdict"] == "holds"


def test_report_says_where_it_is(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr("gapcert_report.pages.page.write_report", lambda folder: folder / "report.html")
    assert main(["report", str(tmp_path), "--json"]) == 0
    assert one_object(capsys.readouterr().out) == {"report": str(tmp_path / "report.html")}


@pytest.mark.parametrize("command", ["verify", "report"])
def test_a_folder_without_a_run_is_a_sentence(command, capsys, tmp_path):
    assert main([command, str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


# --- the terminal


class Tty(io.StringIO):
    def isatty(self):
        return True


def test_a_log_gets_lines_and_progress_seldom(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("gapcert.cli.terminal.time.monotonic", lambda: clock[0])
    log = io.StringIO()
    with Terminal(log) as terminal:
        terminal(Event("stage-started", "sampling"))
        for i in range(30):
            clock[0] = float(i)
            terminal(Event("progress", "sampling", {"done": i * 1000, "total": 30000}))
        terminal(Event("warning", "sampling", {"message": "overpowered"}))
        terminal(Event("stage-finished", "sampling", {"seconds": 3.21}))
    lines = log.getvalue().splitlines()
    assert lines == [
        "[  0:00] sampling ...",
        "[  0:11] sampling: 11,000 of 30,000 (37%), 1,000/s, 19 s left",
        "[  0:22] sampling: 22,000 of 30,000 (73%), 1,000/s, 8 s left",
        "[  0:29] warning: sampling: overpowered",
        "[  0:29] sampling done in 3.2 s",
    ]


def test_a_terminal_gets_bars_and_is_left_clean(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    screen = Tty()
    with Terminal(screen) as terminal:
        terminal(Event("progress", "sampling", {"done": 1, "total": 2}))
        terminal(Event("progress", "search", {"done": 1}))
        terminal(Event("stage-finished", "sampling"))
        assert terminal.bars is not None
    assert terminal.bars is None
    assert "sampling done" in screen.getvalue()


def test_quiet_still_warns():
    log = io.StringIO()
    with Terminal(log, quiet=True) as terminal:
        terminal(Event("stage-started", "x"))
        terminal(Event("warning", "x", {"message": "careful"}))
    assert log.getvalue() == "warning: x: careful\n"


def test_columns_are_as_wide_as_their_widest_cell():
    assert list(columns(("a", "b"), [("xxx", 1)])) == ["a    b", "xxx  1"]


def test_runs_that_have_not_arrived_are_told_in_words():
    row = {"policy": "first", "starts": 100, "violations": 2, "reached": 90}
    summary = {"verdict": "holds", "closed_loop": {"with_gamma": row, "without_gamma": row | {"reached": 98}}}
    assert list(in_words(summary))[1:] == [
        "  closed loop with γ: 2 of 100 runs fail, 8 are still on the way (policy first)",
        "  closed loop without γ: 2 of 100 runs fail (policy first)",
    ]


def test_a_summary_in_words():
    state = {"gap_mean": 1e-3, "gamma_mean": 1.01e-3, "tightness": 1.01, "constant_bound": 2e-3}
    row = {"policy": "first", "starts": 100, "violations": 0}
    summary = {
        "name": "pendulum",
        "verdict": "holds",
        "certificate": {"states": {"theta": state, "omega": {"gap_mean": 0.0}}, "audit": {"points": 14502, "violations": 0}},
        "controller": {"winning_cells": 5, "cells": 9},
        "closed_loop": {"with_gamma": row, "without_gamma": {**row, "violations": 97}},
        "causes": [
            {
                "effect": "viscous-friction",
                "site": "theta",
                "parameters": {"b": {"value": 0.04, "unit": "N*m*s"}},
                "explained": 0.9,
            }
        ],
        "ambiguous_with": [[{"effect": "input-gain", "site": "torque"}, {"effect": "parameter", "site": "m"}]],
        "experiment": "swing higher",
        "expectations": [
            {"text": "verdict == holds", "value": "holds", "met": True},
            {"text": "x <= 1", "value": 2, "met": False},
        ],
        "run_dir": "runs/x",
    }
    text = "\n".join(in_words({"runs": [summary, summary]}))
    for words in (
        "pendulum: holds",
        "theta  0.001     0.00101  1.01       0.002",
        "omega  0         -",
        "audit: 0 violations at 14502 fresh points",
        "5 of 9 cells win",
        "without γ: 97 of 100 runs fail (policy first)",
        "viscous-friction at theta: b = 0.04 N*m*s (explains 0.9)",
        "cannot be told apart: input-gain at torque, parameter at m",
        "expectations: 1 of 2 met",
        "NOT MET  x <= 1   (found 2)",
        "results in runs/x",
    ):
        assert text.count(words) == 2, f"{words}\n{text}"


@pytest.mark.parametrize("command", [["extend"], ["verify"], ["report"], ["watch"], ["runs", "resume"]])
def test_a_pattern_that_stands_for_two_runs_is_told(capsys, command):
    assert main([*command, "runs/stage-1", "runs/stage-2"]) == 2
    assert "one run at a time; found 2 (runs/stage-1, runs/stage-2); name one of them" in capsys.readouterr().err
    assert main([*command, "runs/stage-1", "--nothing"]) == 2
    assert "unrecognized arguments: --nothing" in capsys.readouterr().err
