"""The commands that are Gapcert's own."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from gapcert.contracts.plugins.component import EXECUTED, SET, SPEC, Answer, Argument, Arguments, Component
from gapcert.numerics.errors import UsageError

_TICK: Mapping[str, Any] = {"action": "store_true"}


def _command(name: str, summary: str, *arguments: Argument, does: str = "") -> Component:
    return Component("command", name, summary, f"{__name__}:{does or name}", arguments=arguments)


COMMANDS = (
    _command("run", "execute a spec; the same command again resumes an interrupted run", *EXECUTED, does="execute"),
    _command("validate", "check a spec; nothing is run, and all errors are told", SPEC, SET),
    _command(
        "schema",
        "print the JSON Schema of a spec, or put it where editors find it",
        Argument("--install", "into your editor's folder (.)", {"nargs": "?", "const": Path(), "type": Path, "metavar": "DIR"}),
        Argument("--modeline", "name it at a spec's top", {"action": "append", "default": [], "type": Path, "metavar": "SPEC"}),
    ),
    _command("plugins", "list what is installed and what is missing, or begin a plugin"),
    _command(
        "doctor",
        "say what this machine can do",
        Argument("--paste", "as a short block to paste into a report of a fault", _TICK),
        Argument("--licences", "the licence of every package that is needed, and by what", _TICK),
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
