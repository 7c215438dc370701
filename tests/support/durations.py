"""What every test costs: CPU seconds of set-up, call and tear-down, its child processes included.

As a pytest plugin it records a run (`--record FILE`) and starts long tests first. As a program it answers for the list of
record, `tests/durations.tsv`:

    python tests/support/durations.py slowest FILE      what took longest
    python tests/support/durations.py check FILE...     recorded runs against the list, and the budget of the daily part
    python tests/support/durations.py accept FILE...    makes recorded runs the list

Seconds are divided by those of a reference loop, timed by the same workers in the same run, and multiplied by what that loop
took where the budget was set; then by how much longer than in the list most tests took, since a loop of one kind does not tell
what a slow machine does to all kinds of work. So a slower or busier machine changes nothing.

Parameters of a test count together.
"""

from __future__ import annotations

import random
import re
import resource
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median

import pytest
from tiers import DAILY, TIERS, tier

ROOT = Path(__file__).parents[2]
LIST = ROOT / "tests/durations.tsv"
REFERENCE = 0.0105
"""CPU seconds of the reference loop on two noisy cores that both run tests: the machine of the budget."""
BUDGET = 660.0
"""CPU seconds of the daily part on a fresh machine, where all is compiled: a sixth more than it took. Five minutes are 600."""
TELLS = 0.2
"""CPU seconds in the list from which a test tells how fast a machine is: what takes less may hang on what ran before it."""
PACE = 2.0
"""How much slower than the loop says a machine may be, at most (1.5 was seen): more is ours."""
LONG = 10.0
"""CPU seconds from which a test starts before all others: less than that leaves no worker idle for long at the end."""
ROWS_BETWEEN = 200
"""Tests of a worker between two timings of the loop: often enough that the load of the whole run is seen."""


@cache
def _chain() -> list[tuple[int, float]]:
    """Numbers that lie all over the memory, each with the place of the next: more than the cache of a core holds."""
    order = list(range(100_000))
    random.Random(0).shuffle(order)
    return [(k, float(k)) for k in order]


def reference() -> float:
    """CPU seconds of a fixed piece of work: half of it waits for the interpreter, half of it for the memory."""
    chain = _chain()
    start = time.process_time()
    total, table = 0, {}
    for i in range(40_000):
        total = (total * 31 + i) % 1_000_003
        table[total & 255] = str(total)
    at, far = 0, 0.0
    for _ in range(10_000):
        at, value = chain[at]
        far += value
    return time.process_time() - start


@dataclass(frozen=True)
class Durations:
    """Seconds of each (tier, test function), and what the reference loop took meanwhile."""

    loop: float
    rows: dict[tuple[str, str], float]

    def scaled(self) -> Durations:
        """As on the machine of the budget."""
        return Durations(REFERENCE, {row: seconds * REFERENCE / self.loop for row, seconds in self.rows.items()})

    def sums(self) -> dict[str, float]:
        """Seconds of each tier."""
        return {t: sum(seconds for (own, _), seconds in self.rows.items() if own == t) for t in TIERS}

    def daily(self) -> float:
        """Seconds of the daily part."""
        return sum(seconds for own, seconds in self.sums().items() if own in DAILY)

    def text(self) -> str:
        """A line a test: seconds, tier, name; the first line is the loop's."""
        lines = [_line(row, self.rows[row]) for row in sorted(self.rows, key=lambda row: row[::-1])]
        return "\n".join([f"{self.loop:.5f}\tloop\treference", *lines]) + "\n"

    @classmethod
    def of(cls, text: str) -> Durations:
        """What `text` wrote."""
        head, *rows = (line.split("\t") for line in text.splitlines())
        return cls(float(head[0]), {(own, name): float(seconds) for seconds, own, name in rows})


def _line(row: tuple[str, str], seconds: float) -> str:
    return f"{seconds:.2f}\t{row[0]}\t{row[1]}"


def function(nodeid: str) -> str:
    """The name of a test without its parameters."""
    return re.sub(r"\[.*", "", nodeid, flags=re.DOTALL)


def cpu() -> float:
    """CPU seconds of this process and of the children that have ended."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


# --- the plugin


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record", metavar="FILE", help="write the CPU seconds of every test there")
    parser.addoption("--shuffle", type=int, metavar="SEED", help="files in a random order, and the tests of each as well")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Long tests come first, or chance decides."""
    if (seed := config.getoption("shuffle")) is not None:
        draw = random.Random(seed)
        place = {path: draw.random() for path in sorted({item.path for item in items})}
        items.sort(key=lambda item: (place[item.path], draw.random()))
    elif LIST.exists():
        known = Durations.of(LIST.read_text()).rows
        seconds = {item: known.get((tier(item), function(item.nodeid)), 0.0) for item in items}
        items.sort(key=lambda item: -seconds[item] if seconds[item] >= LONG else 0.0)


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        config.pluginmanager.register(_Clock(config), "durations clock")
    if not hasattr(config, "workerinput") and config.getoption("record"):
        config.pluginmanager.register(_Recorder(Path(config.getoption("record")).absolute()), "durations recorder")


class _Clock:
    """In whatever process runs tests: gives every report the CPU seconds of its phase."""

    def __init__(self, config: pytest.Config) -> None:
        self.config, self.last, self.count, self.loops = config, cpu(), 0, [reference()]

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> Iterator[None]:
        report = yield
        now = cpu()
        report.cpu, report.tier, self.last = now - self.last, tier(item), now
        if report.when == "teardown":
            self.count += 1
            if self.count % ROWS_BETWEEN == 0:
                self.loops.append(reference())
                self.last = cpu()
        return report

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self.loops.append(reference())
        getattr(self.config, "workeroutput", {})["loops"] = self.loops
        if recorder := self.config.pluginmanager.get_plugin("durations recorder"):
            recorder.loops += self.loops


class _Recorder:
    """In the process that reports: adds up and writes the file."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows, self.loops = path, {}, []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        row = getattr(report, "tier", "unit"), function(report.nodeid)
        self.rows[row] = self.rows.get(row, 0.0) + getattr(report, "cpu", 0.0)

    def pytest_testnodedown(self, node: object) -> None:
        self.loops += getattr(node, "workeroutput", {}).get("loops", [])

    @pytest.hookimpl(trylast=True)
    def pytest_sessionfinish(self) -> None:
        if self.rows and self.loops:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.write_text(Durations(median(self.loops), self.rows).text())


# --- the program


def merged(paths: Sequence[str], known: Durations) -> Durations:
    """Several runs as one, as on the machine of the budget; what was skipped in one of them costs what another says."""
    rows: dict[tuple[str, str], float] = {}
    for path in paths:
        for row, seconds in Durations.of(Path(path).read_text()).scaled().rows.items():
            rows[row] = rows.get(row, 0.0) + seconds
    ratios = [seconds / known.rows[row] for row, seconds in rows.items() if seconds and known.rows.get(row, 0.0) >= TELLS]
    pace = min(max(median(ratios or [1.0]), 1 / PACE), PACE)
    return Durations(REFERENCE, {row: seconds / pace for row, seconds in rows.items()})


def problems(run: Durations, known: Durations) -> Iterator[str]:
    """Tests that the list lacks, tests of the list that did not run, and a daily part over its budget."""
    for row in sorted(run.rows.keys() - known.rows.keys()):
        yield f"tests/durations.tsv: add the line\n{_line(row, run.rows[row])}"
    for own, name in sorted(known.rows.keys() - run.rows.keys()):
        yield f"tests/durations.tsv: {name} did not run as {own}; remove its line if the test is gone"
    if run.daily() > BUDGET:
        worst = sorted(((s, n) for (own, n), s in run.rows.items() if own in DAILY), reverse=True)[:10]
        listed = "\n".join(f"  {s:7.1f} s  {n}" for s, n in worst)
        yield f"the daily part took {run.daily():.0f} CPU s of {BUDGET:.0f}; longest:\n{listed}"


def main(what: str, *paths: str) -> int:
    """The exit code."""
    known = Durations.of(LIST.read_text())
    run = merged(paths, known)
    if what == "slowest":
        for (own, name), seconds in sorted(run.rows.items(), key=lambda one: -one[1]):
            print(f"{seconds:8.2f}  {own:8s}  {name}")
    elif what == "accept":
        LIST.write_text(run.text())
    else:
        found = list(problems(run, known))
        print(*found, ", ".join(f"{t} {s:.0f} s" for t, s in run.sums().items()) + " of CPU", sep="\n")
        return bool(found)
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `| head` is no error
    sys.exit(main(*sys.argv[1:]))
