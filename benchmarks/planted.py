"""Planted faults: what the suite notices of a sign, a bound rounded inwards, a margin dropped; one at a time, in a copy.

`planted.toml` has them, each by the text that it changes. The tests named there come first; where they pass, the rest of the
daily part does, and then the exams. What fails must pass without the fault. Answers are kept, and asked again only where the
fault, its file or its tests have changed. Peer: all faults. As a pytest plugin (`-p planted`) it notes what fails.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import importlib.util
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import harness

ROOT = Path(__file__).resolve().parents[1]
TABLE, RESULTS = ROOT / "benchmarks/planted.toml", ROOT / "runs/planted.jsonl"
DAILY, EXAM, EVERY = "not exam", "exam", "exam or not exam"
DEAF = ("tests/test_planted.py", "tests/browser", "tests/spec/test_editor.py", "tests/rerun/test_rerun_views.py")
"""What decides nothing here: whether anchors are there tells any fault, and a bare machine has no Chromium, Node or Vulkan."""
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
        names = [self.file, *sorted({t.partition("::")[0] for t in self.tests})]
        texts = [(ROOT / n).read_text() for n in names if (ROOT / n).is_file()]
        return digest([self.file, self.old, self.new, self.tests, *texts])


@dataclass(frozen=True)
class Answer:
    """What noticed a fault (None: nothing did) in which part, in CPU seconds; `whole`: no part is left to be asked."""

    key: str
    broken: str
    by: str | None
    part: str | None
    seconds: float
    whole: bool


def faults() -> list[Fault]:
    """The table."""
    return [Fault(**{**row, "tests": tuple(row["tests"])}) for row in tomllib.loads(TABLE.read_text())["fault"]]


def digest(data: Any) -> str:
    return hashlib.sha256(json.dumps(data).encode()).hexdigest()[:16]


def _note(report: Any) -> None:
    if report.failed and (path := os.environ.get("PLANTED")):
        with open(path, "a") as file:
            file.write(report.nodeid.replace("\n", " ") + "\n")


pytest_runtest_logreport = pytest_collectreport = _note


@dataclass(frozen=True)
class Copy:
    """The tracked files in a folder that stays, with what Python and Numba have compiled there; `code`: what it is."""

    folder: Path
    code: str

    @classmethod
    @contextmanager
    def made(cls) -> Iterator[Copy]:
        folder = Path(tempfile.gettempdir(), f"gapcert-planted-{digest(str(ROOT))}")
        with open(folder.with_suffix(".lock"), "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                sys.exit(f"{folder}: faults are being planted there already; wait for that run")
            tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
            contents = {n: (ROOT / n).read_bytes() for n in tracked.split("\0") if (ROOT / n).is_file()}
            for name, content in contents.items():
                there = folder / name
                if not there.is_file() or there.read_bytes() != content:
                    there.parent.mkdir(parents=True, exist_ok=True)
                    there.write_bytes(content)
                    there.chmod((ROOT / name).stat().st_mode)
            for left in {p for part in ("core", "plugins", "tests") for p in (folder / part).rglob("*.py")}:
                if str(left.relative_to(folder)) not in contents:
                    left.unlink()
            code = [c.hex() for n, c in contents.items() if n.startswith(("core/", "plugins/", "tests/support/"))]
            yield cls(folder, digest(code))

    @contextmanager
    def broken(self, fault: Fault) -> Iterator[None]:
        """With the fault."""
        path = self.folder / fault.file
        text, compiled = path.read_text(), Path(importlib.util.cache_from_source(str(path)))
        try:
            path.write_text(fault.planted(text))
            compiled.unlink(missing_ok=True)
            yield
        finally:
            path.write_text(text)
            compiled.unlink(missing_ok=True)

    def failing(self, tests: Iterable[str], part: str, without: Iterable[str] = (), fault: Fault | None = None) -> list[str]:
        """The first test of a part that fails; without a fault, all of them."""
        whole, ways = "tests" in tests, (self.folder / "core", self.folder / "plugins", ROOT / "benchmarks")
        command = [sys.executable, "-m", "pytest", "-q", "--tb=no", "-p", "no:cacheprovider", "-p", "planted", "-m", part]
        command += [*(["-x"] if fault else []), *(f"--deselect={t}" for t in (*without, *DEAF)), *tests]
        with tempfile.TemporaryDirectory() as place, self.broken(fault) if fault else nullcontext():
            noted, told = Path(place, "failed"), Path(place, "told")
            # Kernels of faulty packages push none of the user's own out of where those are kept.
            kept = {"XDG_CACHE_HOME": str(self.folder.with_suffix(".cache"))}
            own = {"PYTHONPATH": os.pathsep.join(map(str, ways)), "PLANTED": str(noted), **kept}
            with told.open("w") as out:
                streams = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": out}
                run = subprocess.Popen(command, cwd=self.folder, env=os.environ | own, start_new_session=True, **streams)
                try:
                    code = run.wait(PATIENCE[fault is not None and not whole])
                except subprocess.TimeoutExpired:
                    return ["the time-out"]
                finally:
                    if run.poll() is None:
                        os.killpg(run.pid, signal.SIGKILL)
                        run.wait()
            if noted.exists():
                return noted.read_text().splitlines()
            if code < 0:
                return [f"the end of the process by signal {-code}"]
            if code not in (0, 5):  # 5: the part has no test there
                raise RuntimeError(f"{' '.join(command)} ended with code {code}:\n{told.read_text()[-2000:]}")
        return []


class Book:
    """Answers, and tests known to pass without a fault: a line of JSON each, in a file that only grows."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
        self.answers = {line["key"]: Answer(**line) for line in lines if "key" in line}
        self.sound = {line["sound"]: line["passes"] for line in lines if "sound" in line}
        self.bad = set[str]()

    def write(self, line: dict[str, Any]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")

    def confirm(self, copy: Copy, answers: Iterable[Answer]) -> bool:
        """Do the tests that noticed faults pass without any? Forgets the answers of those that do not."""
        real = {a.by: (copy.folder / a.by.partition("::")[0]) for a in answers if a.by}
        keys = {test: digest([copy.code, path.read_text(), test]) for test, path in real.items() if path.is_file()}
        if unsure := [test for test, key in keys.items() if key not in self.sound]:
            failing = copy.failing(unsure, EVERY)
            for test in unsure:
                self.sound[keys[test]] = test not in failing
                self.write({"sound": keys[test], "test": test, "passes": test not in failing})
        bad = {test for test, key in keys.items() if not self.sound[key]}
        self.bad |= bad
        self.answers = {k: a for k, a in self.answers.items() if a.by not in bad}
        return not bad

    def ask(self, fault: Fault, key: str, copy: Copy, near: bool) -> Answer:
        """The tests of the area, the rest of the daily part, the area's exams, the other exams; `near`: the first of these."""
        begin, by = cpu(), None
        first, rest = (fault.tests, self.bad), (("tests",), {*fault.tests, *self.bad})
        stages = [(DAILY, *first), (DAILY, *rest), (EXAM, *first), (EXAM, *rest)]
        for part, tests, without in stages[:1] if near else stages:
            if by := next(iter(copy.failing(tests, part, without, fault)), None):
                break
        name = None if by is None else "exam" if part == EXAM else "daily"
        made = Answer(key, fault.broken, by, name, round(cpu() - begin, 1), by is not None or not near)
        self.answers[key] = made
        self.write(asdict(made))
        return made


def cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def rows_of(found: list[tuple[Fault, Answer]]) -> list[harness.Row]:
    """Faults that are noticed, per area and in all, and by the daily part, beside all that were planted."""

    def row(case: str, hits: list[bool], quantity: str = "faults noticed") -> harness.Row:
        return harness.row(case, quantity, "1", sum(hits), len(hits), "planted", less_is_better=False)

    rows = [
        row(area, [a.by is not None for f, a in found if f.area == area]) for area in dict.fromkeys(f.area for f, _ in found)
    ]
    daily = row("all", [a.part == "daily" for _, a in found], "noticed by the daily part")
    return [*rows, row("all", [a.by is not None for _, a in found]), daily]


def listed(found: list[tuple[Fault, Answer]]) -> str:
    """Each fault with what noticed it."""
    lines = ["| fault | file | noticed by | part | CPU s |", "| --- | --- | --- | --- | ---: |"]
    for f, a in found:
        by = "**nothing**" if a.by is None else "`" + a.by.replace("|", "\\|") + "`"
        lines.append(f"| {f.broken} | {f.file} | {by} | {a.part or ('–' if a.whole else 'not all asked')} | {a.seconds:.0f} |")
    return "\n".join(lines)


def main() -> int:
    """Asks for what is not known, and prints all; 1 where a fault goes unnoticed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--only", metavar="AREA", help="the faults of one area, or of one plugin")
    parser.add_argument("--near", action="store_true", help="only the tests that the table names, without exams")
    parser.add_argument("--quick", action="store_true", help="a fixed sample, in at most three minutes")
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE", help="where answers are kept")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    table = [f for f in faults() if options.only in (None, f.area) and (f.quick or not options.quick)]
    if not table:
        parser.error(f"no area '{options.only}'; there are {', '.join(dict.fromkeys(f.area for f in faults()))}")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what has been started ends as well
    book, sure = Book(options.results), False
    with Copy.made() as copy:
        keys = {fault: fault.key() for fault in table}
        while not sure:
            for fault, key in keys.items():
                answer = book.answers.get(key)
                if answer is None or not (answer.whole or options.near):
                    answer = book.ask(fault, key, copy, options.near)
                    told = f"{fault.area}: {fault.broken}: {answer.by or 'NOTHING noticed it'} ({answer.seconds:.0f} s)"
                    print(told, file=sys.stderr, flush=True)
            found = [(fault, book.answers[key]) for fault, key in keys.items()]
            sure = book.confirm(copy, [a for _, a in found])
    here, rows = harness.machine(), rows_of(found)
    if options.json:
        data = [asdict(f) | asdict(a) for f, a in found]
        print(json.dumps({"machine": here, "rows": [asdict(r) for r in rows], "faults": data}, indent=2))
    else:
        print(", ".join(f"{k}: {v}" for k, v in here.items()), harness.table(rows), listed(found), sep="\n\n")
    return int(any(a.by is None and a.whole for _, a in found))


if __name__ == "__main__":
    sys.exit(main())
