"""`gapcert runs` and `gapcert watch` on the command line."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from gapcert.errors import GapcertError, UsageError

Options = argparse.Namespace
ORDERS = ("age", "name", "kind", "state", "size", "seconds")
WORDS = (
    *("running", "finished", "interrupted", "failed", "holds", "fails", "unknown"),
    *("causes", "ambiguous", "nothing", "unexplained", "agree", "explained", "differ", "compared"),
)
Add = Callable[..., argparse.ArgumentParser]
Answer = Callable[[Options, object, Iterable[str]], None]


def declare(add: Add, answer: Answer) -> None:
    """Add both commands to the parser; `answer` prints data or words."""
    runs = add("runs", lambda o: listed(o, answer), "list, compare, clean and resume run folders")
    _listing(runs)
    parts = runs.add_subparsers(title="commands", metavar="COMMAND")

    def part(name: str, command: Callable[[Options, Answer], int], text: str) -> argparse.ArgumentParser:
        one = parts.add_parser(name, help=text, description=text, allow_abbrev=False, argument_default=argparse.SUPPRESS)
        one.add_argument("--json", action="store_true", help="print one JSON value on stdout, and all else on stderr")
        one.add_argument("--debug", action="store_true", help="show where an internal error happened (or set GAPCERT_DEBUG)")
        one.set_defaults(command=lambda o: command(o, answer))
        return one

    _listing(part("list", listed, "run folders with state, figures and size (what `gapcert runs` alone does)"))
    compared = part("compare", compare, "what differs between the specs of runs, and which figures changed beyond noise")
    compared.add_argument("runs", metavar="RUN", nargs="+", help="run folders, the first of which the others are held against")
    compared.add_argument("--all", action="store_true", help="show figures that are the same, too")
    _cleaning(part("clean", clean, "which run folders would go; with --yes they do"))
    resumed = part("resume", resume, "go on with an interrupted run from its folder alone")
    resumed.add_argument("run", metavar="RUN", help="the folder of a run")
    resumed.add_argument("--executor", metavar="NAME", help="another executor than the run was begun with")
    resumed.add_argument("--allow-code", action="store_true", help="run Python functions that the spec names")
    resumed.add_argument("--view", action="store_true", help="open a live Rerun viewer")
    resumed.add_argument("--quiet", "-q", action="store_true", help="no progress")
    watched = add("watch", lambda o: watch(o, answer), "follow a run from its folder: stage, rate, remaining time, best so far")
    watched.add_argument("run", metavar="RUN", help="the folder of a run")
    watched.add_argument("--keep", action="store_true", help="where the run dies, wait until it is resumed")


def _listing(parser: argparse.ArgumentParser) -> None:
    """Options that choose folders. Those of `runs list` and `clean` have no defaults: they would undo what stands before."""
    out: Any = argparse.SUPPRESS if parser.argument_default == argparse.SUPPRESS else Path("runs")
    parser.add_argument("--out", type=Path, default=out, metavar="DIR", help="where the run folders are (runs)")
    again = argparse.SUPPRESS if out is argparse.SUPPRESS else []
    parser.add_argument(
        "--name",
        action="append",
        default=again,
        metavar="PATTERN",
        help="names or folders such as 'pendulum*'; may be repeated",
    )
    parser.add_argument(
        "--state",
        action="append",
        default=again,
        metavar="WORD",
        choices=WORDS,
        help=f"one of {', '.join(WORDS)}; may be repeated",
    )
    order = argparse.SUPPRESS if out is argparse.SUPPRESS else "age"
    parser.add_argument("--sort", default=order, choices=ORDERS, metavar="BY", help=f"one of {', '.join(ORDERS)}")


def _cleaning(parser: argparse.ArgumentParser) -> None:
    _listing(parser)
    parser.add_argument("--older-than", default=None, metavar="AGE", help="such as 30min, 12h, 7d, 2w")
    parser.add_argument("--larger-than", default=None, metavar="SIZE", help="such as 100MB, 2GB")
    parser.add_argument("--keep-last", default=0, type=int, metavar="N", help="keep the newest N of each name")
    parser.add_argument("--all", default=False, action="store_true", help="every folder that nothing else leaves out")
    parser.add_argument("--yes", default=False, action="store_true", help="remove them")


def listed(options: Options, answer: Answer) -> int:
    from gapcert.folders.listing import chosen, entry, table

    rows = [entry(r) for r in chosen(options.out, options.name, options.state, options.sort)]
    answer(options, rows, table(rows) if rows else [f"no run folders in {options.out}" + _filtered(options)])
    return 0


def _filtered(options: Options) -> str:
    return " that match" if options.name or options.state else ""


def compare(options: Options, answer: Answer) -> int:
    from gapcert.folders.comparing import compare as side_by_side
    from gapcert.folders.comparing import in_words
    from gapcert.folders.folder import RunFolder

    if len(options.runs) < 2:
        raise UsageError("gapcert runs compare: one run folder was given; expected two or more")
    told = side_by_side([RunFolder.at(path) for path in options.runs])
    answer(options, told, in_words(told, getattr(options, "all", False)))
    return 0


def clean(options: Options, answer: Answer) -> int:
    from gapcert.folders.cleaning import Choice, remove, seconds, size
    from gapcert.folders.listing import chosen, condition, entry, sized
    from gapcert.texts import times

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
    answer(options, data, words)
    return UsageError.exit_code if failed else 0


def resume(options: Options, answer: Answer) -> int:
    from gapcert.folders.folder import RunFolder
    from gapcert.folders.resuming import resume as go_on
    from gapcert.presentation import view
    from gapcert.terminal import Terminal

    over = RunFolder.at(options.run).standing.state == "finished"
    how: dict[str, Any] = {
        k: getattr(options, k, other) for k, other in (("executor", None), ("allow_code", False), ("view", False))
    }
    with Terminal(sys.stderr, getattr(options, "quiet", False)) as terminal:
        done = go_on(options.run, observers=[terminal], **how)
    head = [f"{options.run}: has finished already; nothing was run"] if over else []
    answer(options, done.summary, [*head, *view("Run").lines(done.summary)])
    return done.exit_code


def watch(options: Options, answer: Answer) -> int:
    from gapcert.folders.folder import RunFolder, Standing
    from gapcert.folders.watching import follow, sentence, show
    from gapcert.presentation import view
    from gapcert.terminal import Terminal

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
    else:
        for line in view("Run").lines(summary):
            print(line)
    return code
