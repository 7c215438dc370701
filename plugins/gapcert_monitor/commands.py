"""`gapcert check` and `gapcert verify`."""

from __future__ import annotations

from pathlib import Path

from gapcert.plugin import Answer, Arguments


def check(options: Arguments) -> Answer:
    from .check import Certified, in_words, read_log, stated_noise
    from .check import check as hold_against

    certified = Certified.load(options.run, options.allow_code)
    found = hold_against(certified, read_log(options.log, certified), stated_noise(options.noise, certified))
    return Answer(found.summary(), in_words(found), {"holds": 0, "violated": 1, "outside": 5}[found.verdict])


def verify(options: Arguments) -> Answer:
    import sys

    from gapcert.plugin import Terminal, columns
    from gapcert_verify import verify_run

    with Terminal(sys.stderr, options.quiet) as terminal:
        answer = verify_run(Path(options.run), terminal, allow_code=options.allow_code, again=options.again)
    rows = [("passed" if c["passed"] else "FAILED", c["check"], c["detail"]) for c in answer["checks"]]
    rows += [("trusted", sentence, "") for sentence in answer.get("trusted", ())]
    words = [f"{options.run}: {answer['verdict']}", *columns(("", "check", ""), rows)]
    return Answer(answer, words, 0 if answer["verdict"] == "holds" else 1)
