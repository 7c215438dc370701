"""`gapcert runs` and `gapcert watch` on the command line."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gapcert.contracts.plugins.component import ALLOW_CODE, Answer, Argument, Arguments, Component
from gapcert.numerics.errors import GapcertError, UsageError

ORDERS = ("age", "name", "kind", "state", "size", "seconds")
WORDS = (
    *("running", "finished", "interrupted", "failed", "holds", "fails", "unknown"),
    *("causes", "ambiguous", "nothing", "unexplained", "agree", "explained", "differ", "compared"),
)
_TICK: Mapping[str, Any] = {"action": "store_true"}
_CHOSEN = (
    Argument("--out", "where the run folders are (runs)", {"type": Path, "default": Path("runs"), "metavar": "DIR"}),
    Argument(
        "--name",
        "names or folders such as 'pendulum*'; may be repeated",
        {"action": "append", "default": [], "metavar": "PATTERN"},
    ),
    Argument(
        "--state",
        f"one of {', '.join(WORDS)}; may be repeated",
        {"action": "append", "default": [], "metavar": "WORD", "choices": WORDS},
    ),
    Argument("--sort", f"one of {', '.join(ORDERS)}", {"default": "age", "choices": ORDERS, "metavar": "BY"}),
)


def _command(name: str, does: str, summary: str, *arguments: Argument) -> Component:
    return Component("command", name, summary, f"{__name__}:{does}", arguments=arguments)


FOLDERS = (
    _command("runs", "listed", "list, compare, clean and resume run folders", *_CHOSEN),
    _command("runs list", "listed", "run folders with state, figures and size (what `gapcert runs` alone does)", *_CHOSEN),
    _command(
        "runs clean",
        "clean",
        "which run folders would go; with --yes they do",
        *_CHOSEN,
        Argument("--older-than", "such as 30min, 12h, 7d, 2w", {"metavar": "AGE"}),
        Argument("--larger-than", "such as 100MB, 2GB", {"metavar": "SIZE"}),
        Argument("--keep-last", "keep the newest N of each name", {"default": 0, "type": int, "metavar": "N"}),
        Argument("--all", "every folder that nothing else leaves out", _TICK),
        Argument("--yes", "remove them", _TICK),
    ),
    _command(
        "runs resume",
        "resume",
        "go on with an interrupted run from its folder alone",
        Argument("RUN", "the folder of a run"),
        Argument("--executor", "another executor than the run was begun with", {"metavar": "NAME"}),
        ALLOW_CODE,
        Argument("--view", "open a live Rerun viewer", _TICK),
        Argument("--quiet -q", "no progress", _TICK),
    ),
    _command(
        "watch",
        "watch",
        "follow a run from its folder: stage, rate, remaining time, best so far",
        Argument("RUN", "the folder of a run"),
        Argument("--keep", "where the run dies, wait until it is resumed", _TICK),
    ),
)


def listed(options: Arguments) -> Answer:
    from gapcert.cli.folders.listing import chosen, entry, table

    rows = [entry(r) for r in chosen(options.out, options.name, options.state, options.sort)]
    return Answer(rows, table(rows) if rows else [f"no run folders in {options.out}" + _filtered(options)])


def _filtered(options: Arguments) -> str:
    return " that match" if options.name or options.state else ""


def clean(options: Arguments) -> Answer:
    from gapcert.cli.folders.cleaning import Choice, remove, seconds, size
    from gapcert.cli.folders.listing import chosen, condition, entry, sized
    from gapcert.numerics.texts import times

    asked = (options.name, options.state, options.older_than, options.larger_than, options.keep_last, options.all)
    if not any(asked):
        raise UsageError(
            "gapcert runs clean: nothing says which folders; give --state, --name, --older-than, --larger-than, --keep-last "
            "or --all"
        )
    if options.keep_last < 0:
        raise UsageError(f"--keep-last: found {options.keep_last}; expected a number from 0 on")
    older = None if options.older_than is None else seconds(options.older_than)
    larger = None if options.larger_than is None else size(options.larger_than)
    choice = Choice(older, larger, options.keep_last)
    goes, stays = choice.of(chosen(options.out, options.name, options.state, options.sort))
    rows, failed = [entry(r) for r in goes], list[dict[str, str]]()
    if options.yes:
        for run in goes:
            try:
                remove(run)
            except GapcertError as error:
                failed.append({"run_dir": str(run.path), "reason": str(error)})
    lost = {f["run_dir"] for f in failed}
    gone = [r for r in rows if r["run_dir"] not in lost]
    total = sum(r["size_bytes"] for r in gone)
    kept = [{"run_dir": str(r.path), "reason": why} for r, why in stays] + failed
    data = {"removed": options.yes, "folders": gone, "size_bytes": total, "kept": kept}
    verb = "removed" if options.yes else "would go"
    words = [f"{verb}: {r['run_dir']} ({condition(r)}, {sized(r['size_bytes'])})" for r in gone]
    words += [f"stays: {k['run_dir']}: {k['reason']}" for k in kept]
    words += [f"{times(len(gone), 'folder')}, {sized(total)}" + ("" if options.yes or not gone else "; --yes removes them")]
    return Answer(data, words, UsageError.exit_code if failed else 0)


def resume(options: Arguments) -> Answer:
    from gapcert.cli.terminal import Terminal
    from gapcert.contracts.plugins.presentation import view
    from gapcert.run.resuming import resume as go_on
    from gapcert.run.status import RunFolder

    over = RunFolder.at(options.run).standing.state == "finished"
    how: dict[str, Any] = {k: getattr(options, k) for k in ("executor", "allow_code", "view")}
    with Terminal(sys.stderr, options.quiet) as terminal:
        done = go_on(options.run, observers=[terminal], **how)
    head = [f"{options.run}: has finished already; nothing was run"] if over else []
    return Answer(done.summary, [*head, *view("Run").lines(done.summary)], done.exit_code)


def watch(options: Arguments) -> Answer:
    from gapcert.cli.folders.watching import follow, sentence, show
    from gapcert.cli.terminal import Terminal
    from gapcert.contracts.plugins.presentation import view
    from gapcert.run.status import RunFolder, Standing

    run, last = RunFolder.at(options.run), None
    with Terminal(sys.stderr) as terminal:
        for found in follow(run, options.keep):
            if isinstance(found, Standing):
                last = found
                terminal.over()
                terminal.line(sentence(run.path, found), always=True)
            elif options.json:
                print(json.dumps(found, ensure_ascii=False), flush=True)
            else:
                show(terminal, found)
    assert last is not None, "following ends with a standing"
    code = 0 if last.exit_code is None else last.exit_code
    summary = RunFolder.at(options.run).summary if last.state == "finished" else {}
    if options.json:
        end = {"event": "watched", "state": last.state, "verdict": last.verdict, "exit_code": code, "summary": summary}
        print(json.dumps(end, ensure_ascii=False), flush=True)
        return Answer(None, (), code)
    return Answer(None, view("Run").lines(summary), code)
