"""Run folders from outside: what runs, what is over, what differs, what may go; and what a killed run leaves behind."""

import io
import json
import math
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

import gapcert as gc
from gapcert.cli.main import main
from gapcert.cli.terminal import Terminal
from gapcert.cli.watching import Follower
from gapcert.contracts.plugins.events import BEAT, Event, Heart, Pulse
from gapcert.numerics.errors import UsageError
from gapcert.run import journal
from gapcert.run.folder import alive, enter, myself, owned, owner, spec_of
from gapcert.run.journal import Journal
from gapcert.run.progress_rate import Pace, counted, duration, speed
from gapcert.run.status import RunFolder, standing
from gapcert_runs.cleaning import remove, seconds, size
from gapcert_runs.comparison import Figure, change, compare
from gapcert_runs.listing import entry, sized


@pytest.fixture
def folder(small_run, tmp_path):
    """A copy of a finished run's folder, alone in a folder of runs."""
    return shutil.copytree(small_run.folder, tmp_path / "runs" / small_run.folder.name)


def cli(capsys, *arguments):
    code = main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return code, out, err


# --- pace


def test_a_rate_is_unknown_at_first_and_then_that_of_the_last_half_minute():
    pace = Pace()
    pace.saw(0, 500, 10_000)
    pace.saw(1, 600, 10_000)
    assert (pace.rate, pace.remaining(1)) == (None, None)
    for t in range(2, 201):
        pace.saw(t, 500 + (100 * t if t <= 100 else 10_000 + 20 * (t - 100)), 20_000)
    assert pace.rate == pytest.approx(20)
    assert pace.remaining(200) == pytest.approx((20_000 - 12_500) / 20)
    assert pace.remaining(210) == pytest.approx((20_000 - 12_500) / 20 - 10)


def test_reports_once_a_minute_have_a_rate_and_a_new_beginning_has_none():
    pace = Pace()
    for t, done in ((0, 0), (60, 1), (120, 2)):
        pace.saw(t, done, 4)
    assert pace.remaining(120) == pytest.approx(120)
    pace.saw(130, 0, 4)
    assert pace.rate is None


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (0.4, "0 s"), (51, "51 s"), (250, "4 min 10 s"), (7500, "2 h 05 min"), (273600, "3 d 04 h")],
)
def test_durations(value, text):
    assert duration(value) == text


@pytest.mark.parametrize(
    ("rate", "unit", "text"),
    [(None, "points", ""), (98_213, "points", "98,000 points/s"), (7, "", "7/s"), (1 / 12, "designs", "12 s per design")],
)
def test_speeds(rate, unit, text):
    assert speed(rate, unit) == text


@pytest.mark.parametrize(
    ("progress", "text"),
    [
        ({"done": 1, "unit": "hypotheses"}, "1 hypothesis"),
        ({"done": 2, "unit": "hypotheses"}, "2 hypotheses"),
        ({"done": 1, "total": 4, "unit": "boxes"}, "1 of 4 boxes"),
        ({"done": 1, "total": 1, "unit": "boxes"}, "1 of 1 box"),
    ],
)
def test_one_is_one(progress, text):
    assert counted(progress) == text


def test_a_pulse_tells_seldom_always_the_last_and_computes_the_best_only_then(monkeypatch):
    clock, told, computed = [0.0], [], []
    monkeypatch.setattr("gapcert.contracts.plugins.events.time.monotonic", lambda: clock[0])
    pulse = Pulse(told.append, "work", 1000, "steps")
    for k in range(1, 1001):
        clock[0] = k * BEAT / 100
        pulse(k, lambda k=k: computed.append(k) or {"best": k})
    assert [e.data["done"] for e in told] == computed
    assert len(told) in (11, 12)
    assert told[-1].data == {"done": 1000, "total": 1000, "unit": "steps", "best": {"best": 1000}}


def test_a_log_says_what_goes_on_where_nothing_is_told(monkeypatch):
    clock, log = [0.0], io.StringIO()
    monkeypatch.setattr("gapcert.cli.terminal.time.monotonic", lambda: clock[0])
    terminal = Terminal(log)
    terminal(Event("stage-started", "controller"))
    for clock[0] in (5.0, 12.0, 13.0, 71.0):
        terminal.beat()
    terminal(Event("progress", "controller", {"done": 1, "total": 4, "unit": "designs", "best": {"domain": "40%"}}))
    clock[0] = 100.0
    terminal(Event("progress", "controller", {"done": 2, "total": 4, "unit": "designs", "best": {"domain": "44%"}}))
    for clock[0] in (112.0, 122.0, 133.0):
        terminal.beat()
    terminal(Event("progress", "controller", {"done": 3, "total": 4, "unit": "designs", "best": {"domain": "44%"}}))
    clock[0] = 144.0
    terminal.beat()
    assert log.getvalue().splitlines() == [
        "[  0:00] controller ...",
        "[  0:12] controller: still at it, for 12 s",
        "[  1:11] controller: still at it, for 1 min 11 s",
        "[  1:40] controller: 2 of 4 designs (50%), 29 s per design, 58 s left, so far domain 44%",
        "[  1:52] controller: still at it, for 1 min 52 s",
        "[  2:13] controller: still at it, for 2 min 13 s",
        "[  2:24] controller: 3 of 4 designs (75%), 31 s per design, 20 s left",
    ]


def test_a_heart_beats_from_another_thread_until_it_is_stopped():
    beats = []
    with Heart(0.001, lambda: beats.append(1)):
        while len(beats) < 3:
            time.sleep(0.001)
    count = len(beats)
    time.sleep(0.01)
    assert len(beats) == count


# --- the journal


def test_a_run_leaves_a_journal_that_says_how_it_ended(small_run):
    lines = journal.read(small_run.folder / journal.NAME)
    assert [line["n"] for line in lines] == list(range(len(lines)))
    assert lines[0]["event"] == "run-started"
    assert lines[0]["pid"] == os.getpid()
    assert {"event": "run-ended", "how": "finished", "verdict": "holds", "exit_code": 0}.items() <= lines[-1].items()
    assert {"certificate", "controller", "closed_loop"} <= {e["stage"] for e in lines if e["event"] == "stage-finished"}
    best = [e["best"] for e in lines if e["event"] == "progress" and e["stage"] == "closed_loop"][-1]
    assert best["runs failed with γ"] == 0
    assert owner(small_run.folder) is None


def test_a_torn_last_line_is_left_out_and_numbers_go_on(tmp_path):
    with Journal(tmp_path) as j:
        j(Event("stage-started", "fit"))
    path = tmp_path / journal.NAME
    path.write_bytes(path.read_bytes() + b'{"n": 2, "t": 1, "s"')
    with Journal(tmp_path) as j:
        j(Event("stage-started", "fit"))
    assert [(e["n"], e["event"]) for e in journal.read(path)] == [
        (0, "run-started"), (1, "stage-started"), (2, "run-started"), (3, "stage-started"),
    ]  # fmt: skip
    assert [e.get("again") for e in journal.read(path)][::2] == [False, True]


def test_a_journal_is_bounded_and_a_follower_sees_each_line_once(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "THRESHOLDS", replace(journal.THRESHOLDS, stage_pause=0.0))
    monkeypatch.setattr(journal, "LIMIT", 20_000)
    follower, seen = Follower(tmp_path), []
    with Journal(tmp_path) as j:
        j(Event("warning", "fit", {"message": "w" * 10_000}))
        for k in range(2000):
            j(Event("progress", "fit", {"done": k, "total": 2000, "best": {"δ": math.inf}}))
            if k % 10 == 0:
                seen += follower.new()
    assert (tmp_path / journal.NAME).stat().st_size < 20_000
    seen += follower.new()
    numbers = [line["n"] for line in seen]
    assert numbers == sorted(set(numbers))
    assert seen[-1]["done"] == 1999
    assert seen[-1]["best"] == {"δ": "inf"}
    assert len(journal.read(tmp_path / journal.NAME)[1]["message"]) == journal.LONGEST


def test_progress_that_came_too_soon_is_told_before_the_stage_ends(tmp_path):
    with Journal(tmp_path) as j:
        for k in (1, 2, 3):
            j(Event("progress", "fit", {"done": k, "total": 3}))
        j(Event("stage-finished", "fit", {"seconds": 0.5, "certificate": object()}))
    told = [(e["event"], e.get("done")) for e in journal.read(tmp_path / journal.NAME)]
    assert told == [("run-started", None), ("progress", 1), ("progress", 3), ("stage-finished", None)]


@pytest.mark.parametrize(
    ("error", "how", "code"),
    [(KeyboardInterrupt(), "interrupted", 4), (UsageError("x: bad"), "failed", 2), (ValueError("ours"), "failed", 70)],
)
def test_a_journal_says_what_ended_a_run(tmp_path, error, how, code):
    with pytest.raises(type(error)), Journal(tmp_path):
        raise error
    found = standing(tmp_path)
    assert (found.state, found.exit_code) == (how, code)


# --- whose it is


def test_a_folder_is_owned_by_one_and_the_mark_says_by_whom(tmp_path):
    with owned(tmp_path):
        mark = owner(tmp_path)
        assert mark == myself()
        assert alive(mark)
        with pytest.raises(UsageError, match="another process runs this spec"), owned(tmp_path):
            pass
        assert owner(tmp_path) == mark, "who is refused leaves the mark of who is not"
    assert owner(tmp_path) is None


@pytest.mark.contract
def test_a_dead_process_and_a_later_one_of_its_number_are_not_alive():
    child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    mark = myself() | {"pid": child.pid}
    assert not alive(mark), "born at another time"
    born = Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()[19]
    assert alive(mark | {"born": int(born)})
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
    assert not alive(mark | {"born": int(born)}), "a zombie"
    child.communicate()
    assert alive(mark | {"place": "another machine"}) is None


def test_a_run_elsewhere_counts_as_running_as_long_as_it_gives_signs(folder):
    (folder / "run.lock").write_text(json.dumps(myself() | {"place": "elsewhere"}))
    path = folder / journal.NAME
    lines = [line for line in journal.read(path) if line["event"] != "run-ended"]
    for age, state in ((1.0, "running"), (3600.0, "interrupted")):
        lines[-1]["t"] = time.time() - age
        path.write_text("".join(json.dumps(line) + "\n" for line in lines))
        assert standing(folder).state == state


# --- gapcert runs list


@pytest.mark.run
def test_list_tells_state_figures_and_expectations(folder, capsys):
    code, out, _ = cli(capsys, "runs", "--out", folder.parent)
    assert code == 0
    assert folder.name in out
    assert "holds" in out
    assert "1 of 1" in out
    assert "deterministic, γ " in out
    code, out, _ = cli(capsys, "runs", "list", "--out", folder.parent, "--json")
    (row,) = json.loads(out)
    assert {"state": "finished", "kind": "certify", "exit_code": 0, "expectations": {"met": 1, "of": 1}}.items() <= row.items()
    assert row["size_bytes"] == sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (["--name", "sm*"], 1), (["--name", "other"], 0), (["--state", "holds"], 1), (["--state", "finished"], 1),
        (["--state", "interrupted"], 0), (["--sort", "size"], 1),
    ],
)  # fmt: skip
def test_list_filters(folder, capsys, options, found):
    _, out, _ = cli(capsys, "runs", "list", "--out", folder.parent, "--json", *options)
    assert len(json.loads(out)) == found


@pytest.mark.parametrize("word", ["causes", "ambiguous", "nothing", "unexplained", "agree", "explained", "differ", "compared"])
def test_list_filters_by_every_verdict(folder, capsys, word):
    (folder / journal.NAME).unlink()
    (folder / "summary.json").write_text(json.dumps({"verdict": word}))
    code, out, _ = cli(capsys, "runs", "--out", folder.parent, "--state", word, "--json")
    assert (code, [r["verdict"] for r in json.loads(out)]) == (0, [word])


def test_a_reason_of_several_lines_leaves_the_table_a_table(folder, capsys):
    with pytest.raises(UsageError), Journal(folder):
        raise UsageError("s.yaml:1:1: bad\n   ^")
    row = entry(RunFolder.at(folder))
    assert (row["state"], row["reason"]) == ("failed", "s.yaml:1:1: bad\n   ^")
    lines = cli(capsys, "runs", "--out", folder.parent)[1].splitlines()
    assert len(lines) == 2
    assert lines[1].endswith("s.yaml:1:1: bad")


def test_a_run_that_was_cut_off_says_where(folder, capsys):
    path = folder / journal.NAME
    lines = [line for line in journal.read(path) if line["event"] not in ("run-ended", "stage-finished")]
    lines = [*lines[:3], {"n": 99, "t": time.time(), "s": 9.0, "event": "progress", "stage": "audit", "done": 1, "total": 4}]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    row = entry(RunFolder.at(folder))
    assert (row["state"], row["stage"], row["share"], row["headline"]) == ("interrupted", "audit", 0.25, "")
    assert "interrupted, audit 25%" in cli(capsys, "runs", "--out", folder.parent)[1]
    code, _, err = cli(capsys, "watch", folder)
    assert code == 4
    assert f"interrupted in audit at 25%, last sign 0 s ago; go on with: gapcert runs resume {folder}" in err


def test_a_folder_without_a_journal_is_judged_by_its_summary(folder):
    (folder / journal.NAME).unlink()
    assert (standing(folder).state, standing(folder).verdict, standing(folder).exit_code) == ("finished", "holds", 0)
    (folder / "summary.json").unlink()
    assert standing(folder).state == "interrupted"


@pytest.mark.parametrize(("n", "text"), [(812, "812 B"), (3_400_000, "3.4 MB"), (250_000, "250 kB"), (7.2e13, "72.0 TB")])
def test_sizes(n, text):
    assert sized(n) == text


# --- gapcert runs compare


def test_compare_tells_what_changed_beyond_noise(folder, capsys):
    other = shutil.copytree(folder, folder.parent / "other")
    spec = json.loads((other / "spec.json").read_text())
    spec["sampling"]["budget"] = 50
    (other / "spec.json").write_text(json.dumps(spec))
    summary = json.loads((other / "summary.json").read_text())
    state = summary["certificate"]["states"]["theta"]
    state["tightness"] *= 1.004
    state["gamma_mean"] *= 2
    summary["timings"]["cpu"] *= 1.1
    (other / "summary.json").write_text(json.dumps(summary))
    told = compare([RunFolder.at(folder), RunFolder.at(other)])
    assert told["spec"] == [{"path": "sampling.budget", "values": [40, 50]}]
    changes = {f["figure"]: f["change"] for f in told["figures"] if f["change"] != ["same"]}
    assert changes == {
        "certificate.states.theta.tightness": ["noise"],
        "certificate.states.theta.gamma_mean": ["changed"],
        "timings.cpu": ["noise"],
    }
    code, out, _ = cli(capsys, "runs", "compare", folder, other)
    assert code == 0
    assert "sampling.budget  40" in out
    assert "the samples are the same, bit for bit" in out


def test_compare_says_whose_figures_are_of_before(folder, capsys):
    other = shutil.copytree(folder, folder.parent / "elsewhere" / folder.name)
    with pytest.raises(UsageError), Journal(other):
        raise UsageError("x: bad")
    _, out, _ = cli(capsys, "runs", "compare", folder, other)
    assert out.startswith(f"{folder} against {other}\n  {other} is failed: its figures are of before\n")
    (other / "summary.json").unlink()
    assert f"{other} is failed: it has no figures to compare yet" in cli(capsys, "runs", "compare", folder, other)[1]


@pytest.mark.parametrize(
    ("a", "b", "found"),
    [
        (Figure(1.0), Figure(1.0 + 1e-12), "same"),
        (Figure(1.0), Figure(1.1), "changed"),
        (Figure("x"), Figure("y"), "changed"),
        (Figure(1.0, spread=(0.9, 1.1)), Figure(1.15, spread=(1.05, 1.3)), "noise"),
        (Figure(1.0, spread=(0.9, 1.1)), Figure(1.5, spread=(1.4, 1.6)), "changed"),
        (Figure(1.0), None, "changed"),
    ],
)
def test_what_counts_as_a_change(a, b, found):
    assert change(a, b) == found


def test_compare_needs_two_run_folders(folder, tmp_path, capsys):
    code, _, err = cli(capsys, "runs", "compare", folder)
    assert code == 2
    assert "two or more" in err
    code, _, err = cli(capsys, "runs", "compare", folder, tmp_path)
    assert code == 2
    assert "holds no run.json" in err


# --- gapcert runs clean


def test_clean_says_what_would_go_and_removes_it_only_then(folder, capsys):
    beside = folder.parent / "mine"
    beside.mkdir()
    (beside / "notes.txt").write_text("keep")
    (folder.parent / "ledger.json").write_text("{}")
    code, out, _ = cli(capsys, "runs", "clean", "--out", folder.parent, "--all")
    assert code == 0
    assert f"would go: {folder}" in out
    assert "--yes removes them" in out
    assert folder.exists()
    code, out, _ = cli(capsys, "runs", "clean", "--out", folder.parent, "--all", "--yes", "--json")
    assert [f["run_dir"] for f in json.loads(out)["folders"]] == [str(folder)]
    assert not folder.exists()
    assert (beside / "notes.txt").exists()
    assert (folder.parent / "ledger.json").exists()


@pytest.mark.parametrize(
    ("options", "goes"),
    [
        (["--state", "finished"], True), (["--state", "failed"], False), (["--older-than", "1d"], False),
        (["--older-than", "0s"], True), (["--larger-than", "1GB"], False), (["--larger-than", "1kB"], True),
        (["--all", "--keep-last", "1"], False), (["--name", "small"], True),
    ],
)  # fmt: skip
def test_clean_chooses(folder, capsys, options, goes):
    _, out, _ = cli(capsys, "runs", "clean", "--out", folder.parent, "--json", *options)
    assert len(json.loads(out)["folders"]) == goes


def test_clean_keeps_the_newest_of_a_name(folder, capsys):
    older = shutil.copytree(folder, folder.parent / "older")
    journal = older / "progress.jsonl"
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    journal.write_text("".join(json.dumps(line | {"t": line["t"] - 1000}) + "\n" for line in lines))
    _, out, _ = cli(capsys, "runs", "clean", "--out", folder.parent, "--json", "--all", "--keep-last", "1")
    assert [Path(f["run_dir"]).name for f in json.loads(out)["folders"]] == ["older"]


def test_clean_asks_which(folder, capsys):
    code, _, err = cli(capsys, "runs", "clean", "--out", folder.parent)
    assert code == 2
    assert "nothing says which" in err
    code, _, err = cli(capsys, "runs", "clean", "--out", folder.parent, "--older-than", "week")
    assert code == 2
    assert "expected a number and one of" in err


def test_clean_never_removes_what_runs_nor_what_holds_a_ledger_or_another_run(folder, capsys):
    holds = shutil.copytree(folder, folder.parent / "ledger")
    (holds / "deep").mkdir()
    (holds / "deep" / "ledger.json").write_text("{}")
    nest = shutil.copytree(folder, folder.parent / "nest")
    shutil.copytree(folder, nest / "inner")
    with owned(folder):
        code, out, _ = cli(capsys, "runs", "clean", "--out", folder.parent, "--all", "--yes", "--json")
        with pytest.raises(UsageError, match="another process runs this spec"):
            remove(RunFolder.at(folder))
    reasons = {Path(k["run_dir"]).name: k["reason"] for k in json.loads(out)["kept"]}
    assert "runs in it" in reasons[folder.name]
    assert "audit ledger" in reasons["ledger"]
    assert "another run" in reasons["nest"]
    assert code == 0
    assert all(p.exists() for p in (folder, holds, nest))
    with pytest.raises(UsageError, match="holds an audit ledger"):
        remove(RunFolder.at(holds))


def test_clean_follows_no_link(folder, tmp_path, capsys):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("keep")
    (folder / "link").symlink_to(outside)
    elsewhere = shutil.copytree(folder, tmp_path / "elsewhere", symlinks=True)
    (folder.parent / "linked").symlink_to(elsewhere)
    code, _, _ = cli(capsys, "runs", "clean", "--out", folder.parent, "--all", "--yes")
    assert code == 0
    assert not folder.exists()
    assert (outside / "precious").exists()
    assert (elsewhere / "run.json").exists()


@pytest.mark.parametrize(("text", "value"), [("90s", 90), ("7d", 604800), ("1.5 h", 5400), ("2w", 1209600)])
def test_ages(text, value):
    assert seconds(text) == value


@pytest.mark.parametrize(("text", "value"), [("800kB", 8e5), ("2 GB", 2e9)])
def test_amounts(text, value):
    assert size(text) == value


# --- gapcert runs resume, gapcert watch


def test_a_finished_run_is_not_run_again(folder, capsys):
    before = (folder / "summary.json").stat().st_mtime_ns
    code, out, _ = cli(capsys, "runs", "resume", folder)
    assert code == 0
    assert "has finished already; nothing was run" in out
    assert "small: holds" in out
    assert (folder / "summary.json").stat().st_mtime_ns == before


def test_a_running_run_is_not_resumed(folder, capsys):
    with owned(folder):
        code, _, err = cli(capsys, "runs", "resume", folder)
    assert code == 2
    assert f"process {os.getpid()} runs it already" in err


def interrupted(folder):
    (folder / journal.NAME).write_text("")
    (folder / "summary.json").unlink()


def test_resume_refuses_what_is_no_longer_what_was_begun(folder, capsys):
    interrupted(folder)
    mark = json.loads((folder / "run.json").read_text())
    renamed = folder.rename(folder.parent / "renamed")
    code, _, err = cli(capsys, "runs", "resume", renamed)
    assert code == 2
    assert f"call it {folder.name} again" in err
    folder = renamed.rename(folder)
    (folder / "run.json").write_text(json.dumps(mark | {"folder": "/nowhere"}))
    code, _, err = cli(capsys, "runs", "resume", folder)
    assert code == 2
    assert "/nowhere is not there any more" in err
    (folder / "run.json").write_text(json.dumps(mark))
    (folder / "spec.json").write_text((folder / "spec.json").read_text().replace("0.25", "0.26"))
    code, _, err = cli(capsys, "runs", "resume", folder)
    assert code == 2
    assert "is not the one that was begun" in err


def test_resume_names_the_file_that_has_changed(small_run, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("t,x\n0,0\n")
    spec = gc.load_spec(json.loads((small_run.folder / "spec.json").read_text()))
    spec = replace(spec, folder=tmp_path, files=(log,))
    folder = tmp_path / f"small-{spec.digest[:8]}"
    folder.mkdir()
    enter(folder, spec, "threads")
    assert json.loads((folder / "run.json").read_text())["executor"] == "threads"
    log.write_text("t,x\n0,1\n")
    with pytest.raises(UsageError, match=r"log\.csv has changed since"):
        spec_of(folder)


@pytest.mark.run
def test_a_finished_run_is_watched_to_its_answer(folder, capsys):
    code, out, err = cli(capsys, "watch", folder)
    assert code == 0
    assert "small: holds" in out
    assert "finished: holds" in err
    code, out, _ = cli(capsys, "watch", folder, "--json")
    lines = [json.loads(line) for line in out.splitlines()]
    assert lines[0]["event"] == "run-started"
    assert {"event": "watched", "state": "finished", "exit_code": 0}.items() <= lines[-1].items()
    assert lines[-1]["summary"]["verdict"] == "holds"


def test_a_run_that_failed_is_told_with_its_reason(folder, capsys):
    with pytest.raises(UsageError), Journal(folder):
        raise UsageError("here: found this; expected that")
    code, _, err = cli(capsys, "watch", folder)
    assert code == 2
    assert "failed: here: found this; expected that" in err
    assert "here: found this" in cli(capsys, "runs", "--out", folder.parent)[1]


@pytest.mark.parametrize("command", [["watch"], ["runs", "resume"]])
def test_what_is_no_run_folder_is_refused(tmp_path, capsys, command):
    (tmp_path / "link").symlink_to(tmp_path)
    for path, found in ((tmp_path, "holds no run.json"), (tmp_path / "no", "is not there"), (tmp_path / "link", "is a link")):
        code, _, err = cli(capsys, *command, path)
        assert code == 2
        assert found in err
