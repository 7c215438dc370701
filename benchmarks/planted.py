"""Planted faults: what the suite notices of a sign, a bound rounded inwards, a margin dropped; one at a time, in a copy.

`planted.toml` has the faults, each by the text that it changes. The tests named there come first; where they pass, the rest of
the daily part does, and then the exams. What fails must pass without the fault. Answers are kept (`--results`), and asked anew
only where the fault, its file or its tests have changed. Peer: all faults.

As a pytest plugin (`-p planted`) it writes down which test fails first.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import importlib.util
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import harness

ROOT = Path(__file__).resolve().parents[1]
TABLE, RESULTS = ROOT / "benchmarks/planted.toml", ROOT / "runs/planted.jsonl"
AREAS = (
    "contracts", "certification", "bounded functions", "verification", "networks", "control", "figures", "commands",
    "recordings", "diagnosis", "specs", "report", "compare", "check", "gates", "engines", "export", "run folders",
    "contract tests", "hidden effects",
)  # fmt: skip
"""Of core/; a plugin is an area of its own, by the name of its package."""
DAILY, EXAM = "not exam", "exam"
BARE = ("tests/browser", "tests/core/test_editor.py")
"""Tests that need Chromium or Node, which a bare machine has not: they decide nothing here."""
COMPILED = re.compile(r"njit|[cC]ompiled|Threaded")
PATIENCE = {True: 900, False: 7200}
"""Seconds for the tests that come first, and for a whole part."""


@dataclass(frozen=True)
class Fault:
    """What is `broken`, in words: in this file `new` stands in place of `old`. tests: those that come first."""

    area: str
    broken: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    quick: bool = False

    def planted(self, text: str) -> str:
        """The text of the file with the fault; ValueError where its anchor is not there exactly once."""
        if (count := text.count(self.old)) != 1:
            raise ValueError(f"{self.file}: the text that '{self.broken}' changes occurs {count} times; expected once")
        return text.replace(self.old, self.new)

    def key(self) -> str:
        """Of all that an answer is about."""
        files = [self.file, *sorted({t.partition("::")[0] for t in self.tests})]
        return digest([asdict(self), *((ROOT / f).read_text() for f in files if (ROOT / f).is_file())])


@dataclass(frozen=True)
class Answer:
    """What noticed a fault (None: nothing did) in which part, in CPU seconds; `whole`: all parts were asked."""

    key: str
    area: str
    broken: str
    by: str | None
    part: str | None
    seconds: float
    whole: bool


def faults(path: Path = TABLE) -> list[Fault]:
    """The table."""
    rows = tomllib.loads(path.read_text())["fault"]
    return [Fault(**{**row, "tests": tuple(row["tests"])}) for row in rows]


def digest(data: Any) -> str:
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]


# --- the plugin


def _note(report: Any) -> None:
    if report.failed and (path := os.environ.get("PLANTED")):
        with open(path, "a") as file:
            file.write(report.nodeid.replace("\n", " ") + "\n")


pytest_runtest_logreport = pytest_collectreport = _note


# --- the copy


@contextmanager
def copied() -> Iterator[Copy]:
    """The tracked files as they are now; the folder stays, with what Python and Numba have compiled there."""
    folder = Path(tempfile.gettempdir()) / f"gapcert-planted-{digest(str(ROOT))}"
    folder.mkdir(exist_ok=True)
    with open(folder.with_suffix(".lock"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        names = [n for n in tracked.split("\0") if (ROOT / n).is_file()]
        for name in names:
            there, content = folder / name, (ROOT / name).read_bytes()
            if not there.is_file() or there.read_bytes() != content:
                there.parent.mkdir(parents=True, exist_ok=True)
                there.write_bytes(content)
                there.chmod((ROOT / name).stat().st_mode)
        for left in {p for part in ("core", "plugins", "tests") for p in (folder / part).rglob("*.py")} - {
            folder / n for n in names
        }:
            left.unlink()
        code = [n for n in names if n.startswith(("core/", "plugins/", "tests/support/", "tests/conftest.py"))]
        yield Copy(folder, digest([(ROOT / n).read_bytes().hex() for n in code]))


@dataclass(frozen=True)
class Copy:
    """A folder with all of the repository, and what its code is."""

    folder: Path
    code: str

    @contextmanager
    def broken(self, fault: Fault) -> Iterator[dict[str, str]]:
        """With the fault; yields what the environment needs."""
        path = self.folder / fault.file
        text = path.read_text()
        with tempfile.TemporaryDirectory() as cache:
            try:
                path.write_text(fault.planted(text))
                Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)
                # What Numba has compiled of other files may hold what it inlined from this one.
                yield {"NUMBA_CACHE_DIR": cache} if COMPILED.search(text) else {}
            finally:
                path.write_text(text)
                Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)

    def fails(
        self, tests: Iterable[str], part: str, without: Iterable[str], patience: int, extra: dict[str, str]
    ) -> str | None:
        """The first test of a part that fails, else None."""
        options = ["-x", "-q", "--tb=no", "-p", "no:cacheprovider", "-p", "planted", "-m", part]
        options += [f"--deselect={t}" for t in (*without, *BARE)]
        own = {
            "PYTHONPATH": os.pathsep.join(str(p) for p in (self.folder / "core", self.folder / "plugins", ROOT / "benchmarks"))
        }
        with tempfile.TemporaryDirectory() as place:
            noted, told = Path(place, "failed"), Path(place, "told")
            environment = {**os.environ, **own, **extra, "PLANTED": str(noted)}
            with told.open("w") as out:
                run = subprocess.Popen(
                    [sys.executable, "-m", "pytest", *options, *tests],
                    cwd=self.folder, env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=out, start_new_session=True,
                )  # fmt: skip
                try:
                    code = run.wait(patience)
                except subprocess.TimeoutExpired:
                    return f"the time-out of {patience} s"
                finally:
                    if run.poll() is None:
                        os.killpg(run.pid, signal.SIGKILL)
                        run.wait()
            if noted.exists():
                return noted.read_text().splitlines()[0]
            if code not in (0, 5):  # 5: no test of this part
                if code < 0:
                    return f"the end of the process by signal {-code}"
                raise RuntimeError(f"pytest {' '.join(tests)} ended with code {code}:\n{told.read_text()[-2000:]}")
        return None


# --- the answers


class Book:
    """Answers and tests known to pass, a line of JSON each, in a file that only grows."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        self.answers = {line["key"]: Answer(**line) for line in lines if "key" in line}
        self.sound = {(line["test"], line["code"]): line["passes"] for line in lines if "test" in line}

    def write(self, line: dict[str, Any]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")

    def answer(self, answer: Answer) -> None:
        self.answers[answer.key] = answer
        self.write(asdict(answer))

    def passes(self, copy: Copy, test: str) -> bool:
        """Without a fault; what is no test is no test's fault."""
        path = copy.folder / test.partition("::")[0]
        if not path.is_file():
            return True
        key = (test, digest([copy.code, path.read_text()]))
        if key not in self.sound:
            self.sound[key] = copy.fails([test], f"{DAILY} or {EXAM}", (), PATIENCE[True], {}) is None
            self.write({"test": key[0], "code": key[1], "passes": self.sound[key]})
        return self.sound[key]


def asked(fault: Fault, copy: Copy, book: Book, near: bool) -> Answer:
    """The tests of the area, the rest of the daily part, the exams of the area, the rest of them; `near`: those of the area."""
    begin, alike = cpu(), list[str]()
    stages = [
        (DAILY, fault.tests, ()),
        (DAILY, ("tests",), fault.tests),
        (EXAM, fault.tests, ()),
        (EXAM, ("tests",), fault.tests),
    ]
    for part, tests, done in stages[::2] if near else stages:
        while True:
            with copy.broken(fault) as extra:
                by = copy.fails(tests, part, (*done, *alike), PATIENCE[tests == fault.tests], extra)
            if by is None:
                break
            if book.passes(copy, by):
                name = "exam" if part == EXAM else "daily"
                return Answer(fault.key(), fault.area, fault.broken, by, name, round(cpu() - begin, 1), True)
            print(f"{by} fails without the fault as well; it is left out", file=sys.stderr)
            alike.append(by)
    return Answer(fault.key(), fault.area, fault.broken, None, None, round(cpu() - begin, 1), not near)


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def rows_of(table: list[Fault], found: dict[str, Answer]) -> list[harness.Row]:
    """Per area and in all: faults that are noticed, and those that the daily part notices, beside all that were planted."""
    every = {
        area: [found[f.key()] for f in table if f.area == area and f.key() in found]
        for area in dict.fromkeys(f.area for f in table)
    }
    rows = [_share(area, "faults noticed", [a.by is not None for a in some], "planted") for area, some in every.items() if some]
    whole = [a for some in every.values() for a in some]
    rows += [_share("all", "faults noticed", [a.by is not None for a in whole], "planted")] if whole else []
    return rows + ([_share("all", "noticed by the daily part", [a.part == "daily" for a in whole], "planted")] if whole else [])


def _share(case: str, quantity: str, hits: list[bool], peer: str) -> harness.Row:
    return harness.row(case, quantity, "1", sum(hits), len(hits), peer, less_is_better=False)


def listed(table: list[Fault], found: dict[str, Answer]) -> str:
    """Each fault with what noticed it."""
    lines = ["| fault | file | noticed by | part | CPU s |", "| --- | --- | --- | --- | ---: |"]
    for f in table:
        if (a := found.get(f.key())) is not None:
            by = "**nothing**" if a.by is None else "`" + a.by.replace("|", "\\|") + "`"
            lines.append(
                f"| {f.broken} | {f.file} | {by} | {a.part or ('–' if a.whole else 'not all asked')} | {a.seconds:.0f} |"
            )
    return "\n".join(lines)


def main() -> int:
    """Asks for what is not known, prints all, and ends in 1 where a fault that was fully asked about goes unnoticed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--only", metavar="AREA", help="the faults of one area, or of one plugin")
    parser.add_argument("--near", action="store_true", help="only the tests that the table names, not the rest of the suite")
    parser.add_argument("--quick", action="store_true", help="a fixed sample, in at most three minutes")
    parser.add_argument("--anew", action="store_true", help="ask again for what is known")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE", help="where answers are kept (%(default)s)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    table = [f for f in faults() if options.only in (None, f.area) and (f.quick or not options.quick)]
    if not table:
        parser.error(f"no area is called '{options.only}'; there are {', '.join(dict.fromkeys(f.area for f in faults()))}")
    book = Book(options.results)
    with copied() as copy:
        for fault in table:
            known = None if options.anew else book.answers.get(fault.key())
            if known is None or not (known.whole or options.near):
                book.answer(answer := asked(fault, copy, book, options.near))
                print(
                    f"{fault.area}: {fault.broken}: {answer.by or 'NOT NOTICED'} ({answer.seconds:.0f} s)",
                    file=sys.stderr,
                    flush=True,
                )
    rows, here = rows_of(table, book.answers), harness.machine()
    if options.json:
        answers = [asdict(book.answers[f.key()]) for f in table]
        print(json.dumps({"machine": here, "rows": [asdict(r) for r in rows], "faults": answers}, indent=2))
    else:
        print(", ".join(f"{k}: {v}" for k, v in here.items()), harness.table(rows), listed(table, book.answers), sep="\n\n")
    return int(any(book.answers[f.key()].by is None and book.answers[f.key()].whole for f in table))


if __name__ == "__main__":
    sys.exit(main())
