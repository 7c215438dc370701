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
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NoReturn, final

from gapcert.cli.commands import COMMANDS
from gapcert.contracts.plugins.component import Answer, Argument, Arguments, Component
from gapcert.contracts.plugins.registry import installed
from gapcert.numerics.errors import MACHINE, NO_ROOM, GapcertError, UsageError, clipped, exit_code, harmless
from gapcert.version import __version__

_ALWAYS = (
    Argument("--json", "print one JSON value on stdout, and all else on stderr", {"action": "store_true"}),
    Argument("--debug", "show where an internal error happened (or set GAPCERT_DEBUG)", {"action": "store_true"}),
)
_SEE_TO = "expected a file that can be used; see to the machine"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; every error becomes one sentence."""
    argv = list(sys.argv[1:] if arguments is None else arguments)
    _streams()
    with warnings.catch_warnings(), _ended():
        warnings.showwarning = _warn
        try:
            options = _parser().parse_args(argv)
            code = _carried_out(options)
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
        from gapcert.contracts.plugins import fault_owner as blame

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


@final
class _Parser(argparse.ArgumentParser):
    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        options, more = self.parse_known_args(args, namespace)
        # A pattern such as runs/stage-* often matches more than one folder.
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
    groups: dict[str, Any] = {"": parser.add_subparsers(title="commands", required=True, metavar="COMMAND")}
    made: dict[str, tuple[argparse.ArgumentParser, set[str]]] = {"": (parser, set())}
    for command in (*COMMANDS, *installed().of("command")):
        above, _, name = command.name.rpartition(" ")
        if command.name in made or above not in made:
            why = "which is Gapcert's own" if command.name in made else f"and there is no command '{above}'"
            _warn(f"{command.distribution} declares command '{command.name}', {why}; it is left out")
            continue
        outer, before = made[above]
        if above not in groups:
            groups[above] = outer.add_subparsers(title="commands", metavar="COMMAND")
        one = groups[above].add_parser(name, help=command.summary, description=command.summary, allow_abbrev=False)
        for argument in (*command.arguments, *_ALWAYS):
            names = argument.flags.split()
            how = {"metavar": names[0], **argument.how} if names[0].isupper() else dict(argument.how)
            # What stands before the name of an inner command counts as well: a default would undo it.
            again = {"default": argparse.SUPPRESS} if argument.flags in before else {}
            one.add_argument(*(n.lower() if n.isupper() else n for n in names), help=argument.help, **how | again)
        one.set_defaults(command=command)
        made[command.name] = one, {a.flags for a in (*command.arguments, *_ALWAYS)}
    return parser


def _carried_out(options: Arguments) -> int:
    command: Component = options.command
    answer: Answer = command.load()(options)
    if answer.data is not None and options.json:
        print(json.dumps(answer.data, indent=1, default=str))
    for line in answer.words:
        print(harmless(line), file=sys.stderr if options.json else sys.stdout)
    return answer.code
