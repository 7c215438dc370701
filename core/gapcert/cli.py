"""The command line. Every command imports what it needs when it runs, so that help and listings stay quick.

Exit codes: 0 holds, 1 fails, 2 a wrong spec or usage, 3 something is not installed, 4 interrupted and resumable, 5 unknown,
70 an error of ours.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn, final

from gapcert.errors import MACHINE, NO_ROOM, GapcertError, UsageError, clipped, exit_code, harmless
from gapcert.folders.commands import declare
from gapcert.version import __version__

Options = argparse.Namespace
_SEE_TO = "expected a file that can be used; see to the machine"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; every error becomes one sentence."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    _streams()
    with warnings.catch_warnings(), _ended():
        warnings.showwarning = _warn
        try:
            options = _parser().parse_args(argv)
            code: int = options.command(options)
            sys.stdout.flush()
            return code
        except SystemExit as done:  # --help and --version
            return int(done.code or 0)
        except BrokenPipeError:  # whoever read our output has gone (`| head`)
            _discard()
            return 0
        except (Exception, KeyboardInterrupt) as error:
            return _tell(error, argv)


def _tell(error: BaseException, argv: list[str]) -> int:
    """Tell an error in one sentence, on stderr and for --json on stdout too, and choose the exit code."""
    code = exit_code(error)
    debug = "--debug" in argv or bool(os.environ.get("GAPCERT_DEBUG"))
    if isinstance(error, GapcertError):
        text, debug = str(error), debug and error.__cause__ is not None
    elif isinstance(error, KeyboardInterrupt):
        text = f"interrupted; go on with the same command: {shlex.join(['gapcert', *argv])}"
    elif isinstance(error, OSError) and error.errno in NO_ROOM | MACHINE:
        what = f"{error.filename or 'output'}: {(error.strerror or str(error)).lower()}"
        room = "make room, or choose another folder with --out" if error.errno in NO_ROOM else _SEE_TO
        text = f"{what}; {room}, and run it again"
    elif isinstance(error, MemoryError):
        what = f"memory ran out ({clipped(str(error))[0] or 'no more is given to this process'})"
        less = "ask for less (sampling.chunk, cells, starts, steps) or find more"
        text = f"{what}; {less}; what is finished is kept: run it again"
    else:
        from gapcert import blame

        what = f"{type(error).__name__}: {clipped(str(error))[0]}"
        text = f"internal error: {what}; --debug shows where; please report it"
        if (plugins := blame.told(error)) is not None:
            text = f"{plugins}; --debug shows all of it"
    if debug and not isinstance(error, KeyboardInterrupt):
        import traceback

        traceback.print_exception(error)
    with suppress(OSError):  # nobody is there to be told
        print(harmless(text), file=sys.stderr, flush=True)
    try:
        if "--json" in argv:
            problems = list(getattr(error, "problems", ()))
            print(json.dumps({"error": text, "exit_code": code} | ({"problems": problems} if problems else {})))
        sys.stdout.flush()
    except OSError:
        _discard()
    return code


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    print(f"warning: {harmless(message)}", file=sys.stderr)


def _streams() -> None:
    """Standard streams that take every text: what was closed goes nowhere, and what has no γ writes it otherwise."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream.closed:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _discard() -> None:
    """Standard output goes nowhere from here on: what is left in it would fail once more at the end of the process."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _ended() -> Iterator[None]:
    """A request to end (SIGTERM, or SIGHUP where a terminal goes away) is answered like Ctrl-C: resumable, and told."""
    before: dict[signal.Signals, Any] = {}

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    for number in (signal.SIGTERM, signal.SIGHUP):
        with suppress(ValueError):  # not the main thread
            if signal.getsignal(number) is signal.SIG_DFL:  # nohup ignores, and others have an answer of their own
                before[number] = signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _answer(options: Options, data: object, words: Iterable[str]) -> None:
    """The words on stdout; or, for --json, one object there and the words on stderr."""
    if options.json:
        print(json.dumps(data, indent=1, default=str))
    for line in words:
        print(harmless(line), file=sys.stderr if options.json else sys.stdout)


@final
class _Parser(argparse.ArgumentParser):
    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, more = self.parse_known_args(args, namespace)
        # What a pattern such as runs/stage-* stands for is often more than one folder.
        if more and hasattr(options, "run") and not hasattr(options, "log") and not any(a.startswith("-") for a in more):
            found = ", ".join([options.run, *more])
            raise UsageError(f"{self.prog}: one run at a time; found {1 + len(more)} ({found}); name one of them")
        if more:
            self.error(f"unrecognized arguments: {' '.join(more)}")
        return options

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{self.prog}: {message}; see {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    about = "How wrong can a model be, and why? Certified gaps between models, simulators and reality."
    parser = _Parser("gapcert", description=about, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name: str, command: Callable[[Options], int], text: str, *arguments: str) -> argparse.ArgumentParser:
        one = commands.add_parser(name, help=text, description=text, allow_abbrev=False)
        for argument in arguments:
            one.add_argument(argument.lower(), metavar=argument, help=_MEANING[argument])
        one.add_argument("--json", action="store_true", help="print one JSON object on stdout, and all else on stderr")
        one.add_argument("--debug", action="store_true", help="show where an internal error happened (or set GAPCERT_DEBUG)")
        one.set_defaults(command=command)
        return one

    executed = [
        add("run", run, "execute a spec; the same command again resumes an interrupted run", "SPEC"),
        add("diagnose", diagnose, "execute a spec that has a diagnosis: why is the model wrong?", "SPEC"),
        add("compare", compare, "execute a spec that compares simulators: which, how far apart, and by which setting?", "SPEC"),
    ]
    validated = add("validate", validate, "check a spec; nothing is run, and all errors are told", "SPEC")
    for one in (*executed, validated):
        one.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", help="override a value of the spec")
    for one in executed:
        one.add_argument("--out", type=Path, default=Path("runs"), metavar="DIR", help="where run folders go (runs)")
        one.add_argument("--executor", metavar="NAME", help="what computes samples: processes, threads, dask, dask:ADDRESS")
        one.add_argument("--allow-code", action="store_true", help="run Python functions that the spec names")
        one.add_argument("--view", action="store_true", help="open a live Rerun viewer")
        one.add_argument("--quiet", "-q", action="store_true", help="no progress; warnings, as of repaired data, stay")
    looked = add("inspect", inspect, "show what is in a log: rates, gaps, ranges, noise; with a page of plots", "LOG")
    looked.add_argument("--out", type=Path, default=Path("runs"), metavar="DIR", help="where the page goes (runs)")
    offered = add("schema", schema, "print the JSON Schema of a spec, or put it where editors find it")
    offered.add_argument(
        "--install", nargs="?", const=Path(), type=Path, metavar="DIR", help="into the folder of your editor (.)"
    )
    offered.add_argument("--modeline", action="append", default=[], type=Path, metavar="SPEC", help="name it at a spec's top")
    _growing(add("plugins", plugins, "list what is installed and what is missing, or begin a plugin"))
    add("verify", verify, "check a certificate again from its stored data", "RUN")
    checked = add("check", check, "hold a new log against a certificate: does γ still hold?", "RUN", "LOG")
    checked.add_argument(
        "--noise",
        action="append",
        default=[],
        metavar="CHANNEL=VALUE",
        help="by how much a channel may err, such as theta=1e-4",
    )
    checked.add_argument("--allow-code", action="store_true", help="run Python functions that the spec names")
    add("report", report, "write the HTML report of a run again", "RUN")
    extended = add("extend", extend, "write the extended model of a diagnosis as a spec", "RUN")
    extended.add_argument("-o", dest="output", type=Path, metavar="FILE", help="where to (standard output)")
    exported = add("export", export, "write a run's controller as a program that needs no Gapcert", "RUN")
    exported.add_argument("--to", choices=("c", "numpy"), required=True, help="C without libraries, or Python with NumPy")
    exported.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="where the files go")
    exported.add_argument("--without-gamma", action="store_true", help="the controller that trusts the model")
    examined = add("doctor", doctor, "say what this machine can do")
    examined.add_argument("--paste", action="store_true", help="as a short block to paste into a report of a fault")
    examined.add_argument("--licences", action="store_true", help="the licence of every package that is needed, and by what")
    declare(add, _answer)
    return parser


def _growing(listed: argparse.ArgumentParser) -> None:
    """`gapcert plugins new KIND NAME`, beside the list that `gapcert plugins` alone is."""
    parts = listed.add_subparsers(title="commands", metavar="COMMAND")
    text = "write a plugin of your own: a working component, its contract test, and a spec that uses it"
    one = parts.add_parser("new", help=text, description=text, allow_abbrev=False)
    kinds = "model, backend, gap_family, lipschitz, synthesizer, effect, reader, executor or observer"
    one.add_argument("kind", metavar="KIND", help=kinds)
    one.add_argument("name", metavar="NAME", help="its name in specs, such as my-robot")
    one.add_argument("--out", type=Path, metavar="DIR", help="a new or empty folder for it (gapcert-NAME)")
    # What stands before `new` counts as well.
    one.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help="print one JSON object on stdout")
    one.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help="show where an internal error happened")
    one.set_defaults(command=new_plugin)


_MEANING = {
    "SPEC": "a spec file (YAML)",
    "RUN": "the folder of a finished run",
    "LOG": "a log: CSV, Parquet, HDF5, .mat, MCAP, a ROS 2 bag, a LeRobot data set; or a spec that names one",
}


def run(options: Options) -> int:
    from gapcert.presentation import view
    from gapcert.terminal import Terminal

    with Terminal(sys.stderr, options.quiet) as terminal:
        terminal.line(f"reading {options.spec} ...")  # at once: what reads it takes a second to import
        from gapcert.spec import load_spec

        spec = load_spec(options.spec, options.set, options.out)
        asked = next((name for name, one in (("diagnose", diagnose), ("compare", compare)) if options.command is one), None)
        for task in [member.task for member in spec.expand()]:
            if asked not in (None, task):
                raise spec.error("", f"there is no {asked}: section to carry out", "use `gapcert run`")
        from gapcert.run import run as execute

        how: dict[str, Any] = {k: getattr(options, k) for k in ("out", "executor", "allow_code", "view")}
        done = execute(spec, observers=[terminal], **how)
    _answer(options, done.summary, view("Run").lines(done.summary))
    return done.exit_code


def diagnose(options: Options) -> int:
    return run(options)


def compare(options: Options) -> int:
    return run(options)


def validate(options: Options) -> int:
    from gapcert.spec import load_spec

    spec = load_spec(options.spec, options.set)
    names = [s.name for s in spec.expand()]
    answer = {"valid": True, "name": spec.name, "digest": spec.digest, "runs": names}
    _answer(options, answer, [f"{options.spec}: valid" + (f" ({len(names)} runs)" if len(names) > 1 else "")])
    return 0


def inspect(options: Options) -> int:
    from gapcert.inspect import in_words
    from gapcert.inspect import inspect as look
    from gapcert.report.log import write_log_page

    tables = look(options.log)
    stem = Path(options.log).resolve().name
    page = write_log_page(options.out / f"inspect-{stem}" / "report.html", stem, tables)
    _answer(
        options,
        {"log": options.log, "tables": [t.facts() for t in tables], "report": str(page)},
        [*in_words(tables), f"plots in {page}"],
    )
    return 0


def schema(options: Options) -> int:
    from gapcert.spec import editor
    from gapcert.spec import schema as make

    if options.install is None and not options.modeline:
        print(json.dumps(make(), indent=1))
        return 0
    done = {} if options.install is None else editor.install(options.install, make())
    words = editor.in_words(done) if done else []
    lines = {str(path): editor.modeline(path) for path in options.modeline}
    _answer(options, done | ({"modelines": lines} if lines else {}), [*words, *(f"{k}: {v}" for k, v in lines.items())])
    return 0


def plugins(options: Options) -> int:
    from gapcert.components import installed
    from gapcert.texts import columns

    rows = installed().listing()
    table = [(r["kind"], r["name"], r["distribution"], "yes" if r["available"] else f"no: {r['reason']}") for r in rows]
    _answer(options, rows, () if options.json else columns(("kind", "name", "from", "available"), table))
    return _collisions()


def new_plugin(options: Options) -> int:
    from gapcert.scaffold import new

    _answer(options, *new(options.kind, options.name, options.out))
    return 0


def _collisions() -> int:
    """Tell, after a listing, what `run` refuses; returns the exit code."""
    from gapcert.components import installed

    sentences = installed().collisions()
    for text in sentences:
        print(text, file=sys.stderr)
    return UsageError.exit_code if sentences else 0


def verify(options: Options) -> int:
    from gapcert.texts import columns
    from gapcert.verify import verify_run

    answer = verify_run(Path(options.run))
    rows = [("passed" if c["passed"] else "FAILED", c["check"], c["detail"]) for c in answer["checks"]]
    rows += [("trusted", sentence, "") for sentence in answer.get("trusted", ())]
    _answer(options, answer, [f"{options.run}: {answer['verdict']}", *columns(("", "check", ""), rows)])
    return 0 if answer["verdict"] == "holds" else 1


def check(options: Options) -> int:
    from gapcert.check import Certified, in_words, read_log, stated_noise
    from gapcert.check import check as hold_against

    certified = Certified.load(options.run, options.allow_code)
    found = hold_against(certified, read_log(options.log, certified), stated_noise(options.noise, certified))
    _answer(options, found.summary(), in_words(found))
    return {"holds": 0, "violated": 1, "outside": 5}[found.verdict]


def report(options: Options) -> int:
    from gapcert.components import registry

    path = str(registry().get("report", "html").load()(Path(options.run)))
    _answer(options, {"report": path}, [path])
    return 0


def extend(options: Options) -> int:
    from gapcert.diagnosis.extended import extended_spec, write_extended

    text, data = extended_spec(Path(options.run))
    if options.output is None:
        _answer(options, data, [text.rstrip()])
        return 0
    path = str(write_extended(text, options.output))
    _answer(options, {"extended": path, **data}, [path])
    return 0


def export(options: Options) -> int:
    from gapcert.export import export as write
    from gapcert.export import find

    controller = find(options.run, "without_gamma" if options.without_gamma else "with_gamma")
    done = write(controller, options.to, options.out)
    _answer(options, done, done["files"])
    return 0


def doctor(options: Options) -> int:
    from gapcert.doctor import examine, pasted
    from gapcert.texts import columns

    if options.licences:
        from gapcert.licences import licences

        rows = licences()
        table = [(r.package, r.version or "-", r.licence or "not stated", ", ".join(r.needed_by)) for r in rows]
        _answer(options, [r.facts() for r in rows], columns(("package", "version", "licence", "needed by"), table))
        return 0
    found = examine()
    if options.paste:
        _answer(options, found, pasted(found))
        return 0
    facts = [(k, v) for k, v in found.items() if not isinstance(v, list | dict)]
    packages = [(name, version or "not installed") for name, version in found["packages"].items()]
    parts = [(c["kind"], c["name"], "yes" if c["available"] else c["reason"]) for c in found["components"]]
    words = [*columns(("machine", ""), facts), "", *columns(("package", "version"), packages), ""]
    _answer(options, found, [*words, *columns(("component", "", "available"), parts)])
    return _collisions()
