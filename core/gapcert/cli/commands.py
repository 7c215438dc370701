"""The commands that are Gapcert's own."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gapcert.contracts.plugins.component import ALLOW_CODE, EXECUTED, SET, SPEC, Answer, Argument, Arguments, Component
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
_KINDS = "model, backend, gap_family, lipschitz, synthesizer, effect, reader, executor, observer or study"


def _command(name: str, summary: str, *arguments: Argument, does: str = "") -> Component:
    return Component("command", name, summary, f"{__name__}:{does or name}", arguments=arguments)


COMMANDS = (
    _command("run", "execute a spec; the same command again resumes an interrupted run", *EXECUTED, does="execute"),
    _command("validate", "check a spec; nothing is run, and all errors are told", SPEC, SET),
    _command(
        "schema",
        "print the JSON Schema of a spec, or put it where editors find it",
        Argument(
            "--install", "into the folder of your editor (.)", {"nargs": "?", "const": Path(), "type": Path, "metavar": "DIR"}
        ),
        Argument(
            "--modeline",
            "name it at a spec's top",
            {"action": "append", "default": [], "type": Path, "metavar": "SPEC"},
        ),
    ),
    _command("plugins", "list what is installed and what is missing, or begin a plugin"),
    _command(
        "plugins new",
        "write a plugin of your own: a working component, its contract test, and a spec that uses it",
        Argument("KIND", _KINDS),
        Argument("NAME", "its name in specs, such as my-robot"),
        Argument("--out", "a new or empty folder for it (gapcert-NAME)", {"type": Path, "metavar": "DIR"}),
        does="new_plugin",
    ),
    _command(
        "doctor",
        "say what this machine can do",
        Argument("--paste", "as a short block to paste into a report of a fault", _TICK),
        Argument("--licences", "the licence of every package that is needed, and by what", _TICK),
    ),
    _command("runs", "list, compare, clean and resume run folders", *_CHOSEN),
    _command("runs list", "run folders with state, figures and size (what `gapcert runs` alone does)", *_CHOSEN, does="runs"),
    _command(
        "runs clean",
        "which run folders would go; with --yes they do",
        *_CHOSEN,
        Argument("--older-than", "such as 30min, 12h, 7d, 2w", {"metavar": "AGE"}),
        Argument("--larger-than", "such as 100MB, 2GB", {"metavar": "SIZE"}),
        Argument("--keep-last", "keep the newest N of each name", {"default": 0, "type": int, "metavar": "N"}),
        Argument("--all", "every folder that nothing else leaves out", _TICK),
        Argument("--yes", "remove them", _TICK),
        does="clean",
    ),
    _command(
        "runs resume",
        "go on with an interrupted run from its folder alone",
        Argument("RUN", "the folder of a run"),
        Argument("--executor", "another executor than the run was begun with", {"metavar": "NAME"}),
        ALLOW_CODE,
        Argument("--view", "open a live Rerun viewer", _TICK),
        Argument("--quiet -q", "no progress", _TICK),
        does="resume",
    ),
    _command(
        "watch",
        "follow a run from its folder: stage, rate, remaining time, best so far",
        Argument("RUN", "the folder of a run"),
        Argument("--keep", "where the run dies, wait until it is resumed", _TICK),
    ),
)


def execute(options: Arguments) -> Answer:
    """What `run` does, and every command of a study: that refuses a spec which asks for something else."""
    from gapcert.cli.terminal import Terminal
    from gapcert.contracts.plugins.presentation import view

    with Terminal(sys.stderr, options.quiet) as terminal:
        terminal.line(f"reading {options.spec} ...")  # at once: what reads it takes a second to import
        from gapcert.spec.spec import load_spec

        spec, asked = load_spec(options.spec, options.set, options.out), options.command.name
        for task in [member.task for member in spec.expand()]:
            if asked not in ("run", task):
                raise spec.error("", f"there is no {asked}: section to carry out", "use `gapcert run`")
        from gapcert.run.run import run

        how: dict[str, Any] = {k: getattr(options, k) for k in ("out", "executor", "allow_code", "view")}
        done = run(spec, observers=[terminal], **how)
    return Answer(done.summary, view("Run").lines(done.summary), done.exit_code)


def validate(options: Arguments) -> Answer:
    from gapcert.spec.spec import load_spec

    spec = load_spec(options.spec, options.set)
    names = [s.name for s in spec.expand()]
    data = {"valid": True, "name": spec.name, "digest": spec.digest, "runs": names}
    return Answer(data, [f"{options.spec}: valid" + (f" ({len(names)} runs)" if len(names) > 1 else "")])


def schema(options: Arguments) -> Answer:
    from gapcert.spec import editor
    from gapcert.spec.schema import schema as make

    if options.install is None and not options.modeline:
        made = make()
        return Answer(made, () if options.json else [json.dumps(made, indent=1)])
    done = {} if options.install is None else editor.install(options.install, make())
    words = editor.in_words(done) if done else []
    lines = {str(path): editor.modeline(path) for path in options.modeline}
    return Answer(done | ({"modelines": lines} if lines else {}), [*words, *(f"{k}: {v}" for k, v in lines.items())])


def plugins(options: Arguments) -> Answer:
    from gapcert.contracts.plugins.registry import installed
    from gapcert.numerics.texts import columns

    rows = installed().listing()
    table = [(r["kind"], r["name"], r["distribution"], "yes" if r["available"] else f"no: {r['reason']}") for r in rows]
    return _listed(rows, () if options.json else columns(("kind", "name", "from", "available"), table))


def new_plugin(options: Arguments) -> Answer:
    from gapcert.cli.scaffold.scaffold import new

    return Answer(*new(options.kind, options.name, options.out))


def _listed(data: object, words: Iterable[str]) -> Answer:
    """A listing tells on stderr, and by its exit code, what `run` refuses."""
    from gapcert.contracts.plugins.registry import installed

    sentences = installed().collisions()
    for text in sentences:
        print(text, file=sys.stderr)
    return Answer(data, words, UsageError.exit_code if sentences else 0)


def doctor(options: Arguments) -> Answer:
    from gapcert.cli.doctor import examine, licences, pasted
    from gapcert.numerics.texts import columns

    if options.licences:
        rows = licences()
        table = [(r.package, r.version or "-", r.licence or "not stated", ", ".join(r.needed_by)) for r in rows]
        return Answer([r.facts() for r in rows], columns(("package", "version", "licence", "needed by"), table))
    found = examine()
    if options.paste:
        return Answer(found, pasted(found))
    facts = [(k, v) for k, v in found.items() if not isinstance(v, list | dict)]
    packages = [(name, version or "not installed") for name, version in found["packages"].items()]
    parts = [(c["kind"], c["name"], "yes" if c["available"] else c["reason"]) for c in found["components"]]
    words = [*columns(("machine", ""), facts), "", *columns(("package", "version"), packages), ""]
    return _listed(found, [*words, *columns(("component", "", "available"), parts)])


def runs(options: Arguments) -> Answer:
    from gapcert.cli.listing import chosen, entry, table

    rows = [entry(r) for r in chosen(options.out, options.name, options.state, options.sort)]
    none = f"no run folders in {options.out}" + (" that match" if options.name or options.state else "")
    return Answer(rows, table(rows) if rows else [none])


def clean(options: Arguments) -> Answer:
    from gapcert.cli.cleaning import Choice, remove, seconds, size
    from gapcert.cli.listing import chosen, condition, entry, sized
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
    from gapcert.run.run import resume as go_on
    from gapcert.run.status import RunFolder

    over = RunFolder.at(options.run).standing.state == "finished"
    how: dict[str, Any] = {k: getattr(options, k) for k in ("executor", "allow_code", "view")}
    with Terminal(sys.stderr, options.quiet) as terminal:
        done = go_on(options.run, observers=[terminal], **how)
    head = [f"{options.run}: has finished already; nothing was run"] if over else []
    return Answer(done.summary, [*head, *view("Run").lines(done.summary)], done.exit_code)


def watch(options: Arguments) -> Answer:
    from gapcert.cli.terminal import Terminal
    from gapcert.cli.watching import follow, sentence, show
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
