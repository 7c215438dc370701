"""What every benchmark shares: the machine, ours and a peer in turn, and the table or JSON of the rows."""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One measured pair; ratio = peer / ours where less is better (so more is always better), None without a peer run."""

    case: str
    quantity: str
    unit: str
    ours: float
    peer: float | None
    peer_name: str
    ratio: float | None


def row(
    case: str, quantity: str, unit: str, ours: float, peer: float | None, peer_name: str, *, less_is_better: bool = True
) -> Row:
    """A Row with its ratio."""
    ratio = None if peer is None else (peer / ours if less_is_better else ours / peer)
    return Row(case, quantity, unit, ours, peer, peer_name, ratio)


def alternate(
    ours: Callable[[], object],
    peer: Callable[[], object],
    *,
    repeats: int = 5,
    clock: Callable[[], float] = time.process_time,
    long: float = 10.0,
    warm: float = 0.0,
) -> tuple[float, float]:
    """Median seconds of each, run in turn so that noise hits both; a peer that takes longer than `long` runs once.

    A turn goes on for `warm` seconds, of either, and counts as the median of its runs: what the other left in the caches is
    then no part of it.
    """
    times: tuple[list[float], list[float]] = [], []
    for _ in range(repeats):
        for run, seen in zip((ours, peer), times, strict=True):
            if run is peer and seen and max(seen) > long:
                continue
            turn, begin = list[float](), clock()
            while not turn or clock() - begin < warm:
                start = clock()
                run()
                turn.append(clock() - start)
            seen.append(statistics.median(turn))
    return statistics.median(times[0]), statistics.median(times[1])


def machine() -> dict[str, str | int | float]:
    """What the figures depend on."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = names[0] if names else cpu
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {
        "cpu": cpu,
        "cores": cores,
        "memory_gib": round(memory, 1),
        "load": round(os.getloadavg()[0], 1),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def commit() -> str:
    """Short, with a + where files differ from it."""
    asked = ("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "../core", "../plugins")
    here = Path(__file__).parent
    at, changed = (subprocess.run(["git", *a], cwd=here, capture_output=True, text=True).stdout.strip() for a in asked)
    return at + ("+" if changed else "")


def table(rows: Iterable[Row]) -> str:
    """The rows as a Markdown table."""
    lines = ["| case | quantity | unit | ours | peer | peer is | ratio |", "| --- | --- | --- | ---: | ---: | --- | ---: |"]
    for r in rows:
        peer, ratio = ("–" if v is None else f"{v:.4g}" for v in (r.peer, r.ratio))
        lines.append(f"| {r.case} | {r.quantity} | {r.unit} | {r.ours:.4g} | {peer} | {r.peer_name} | {ratio} |")
    return "\n".join(lines)


def main(measure: Callable[[argparse.Namespace], list[Row]], parser: argparse.ArgumentParser) -> None:
    """Runs one benchmark: `--quick` for a short run, `--json` for one JSON object instead of a table."""
    parser.add_argument("--quick", action="store_true", help="at most three minutes; keeps the headline rows")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    here = machine()
    rows = measure(options)
    if options.json:
        print(json.dumps({"machine": here, "rows": [asdict(r) for r in rows]}, indent=2))
    else:
        print(", ".join(f"{k}: {v}" for k, v in here.items()), table(rows), sep="\n\n")
