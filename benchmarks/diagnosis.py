"""Exams: effects hidden in data by an independent generator, and what the diagnosis makes of them.

Every case is drawn from (seed, part, index) alone. With --store, answers are kept in a file of JSON lines, and a run that was
stopped goes on where it stood. Another seed is another exam.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from exams import cost, files
from exams.parts import PARTS
from exams.tables import page
from harness import Row, main

QUICK = ("singles", "nothing", "cost")
Task = tuple[str, int, int, float]


def ask(task: Task) -> dict[str, Any]:
    part, seed, index, limit = task
    return PARTS[part].ask(seed, index, limit)


def answered(store: Path | None) -> dict[tuple[str, int, int], dict[str, Any]]:
    """Records of earlier runs by (part, seed, index)."""
    lines = store.read_text().splitlines() if store is not None and store.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}")]
    return {(r["part"], r["seed"], r["index"]): r for r in records}


def sittings(tasks: list[Task], jobs: int, store: Path | None) -> Iterable[dict[str, Any]]:
    """Records of the tasks, each written down as soon as it is there."""
    done = answered(store)
    yield from (done[t[:3]] for t in tasks if t[:3] in done)
    left = [t for t in tasks if t[:3] not in done]
    if not left:
        return
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=50) as pool:
        for record in pool.imap_unordered(ask, left):
            if store is not None:
                with store.open("a") as file:
                    file.write(json.dumps(record) + "\n")
            yield record


def measure(options: argparse.Namespace) -> list[Row]:
    rows = []
    for name in options.part or (QUICK if options.quick else (*PARTS, "cost")):
        if name == "cost":
            rows += cost.measure(options.quick) + files.measure(options.quick, options.limit)
            continue
        part = PARTS[name]
        count = options.cases or (part.quick if options.quick else part.cases)
        records = list(sittings([(name, options.seed, i, options.limit) for i in range(count)], options.jobs, options.store))
        if options.verbose:
            print(page(name, records))
        if options.tables:
            with options.tables.open("a") as file:
                file.write(page(name, records) + "\n")
        for f in part.figures(records):
            what = "goal" if f.limit is None else f"goal; one-sided 95 % limit {f.limit:.3g}"
            rows.append(Row(f"{name}, {len(records)} cases", f.quantity, f.unit, f.value, f.goal, what, f.ratio))
        lost = sum("error" in r for r in records)
        rows.append(Row(f"{name}, {len(records)} cases", "no answer: an error, or out of time", "cases", lost, 0, "goal", None))
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", action="append", choices=[*PARTS, "cost"], help="one part of the exam; may be repeated")
    parser.add_argument("--cases", type=int, help="cases of each part, instead of its own number")
    parser.add_argument("--seed", type=int, default=1, help="another seed is another exam")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--limit", type=float, default=300.0, help="CPU seconds for one diagnosis")
    parser.add_argument("--store", type=Path, help="JSON lines of the answers; a run goes on where this file ends")
    parser.add_argument("--verbose", action="store_true", help="print who was taken for whom, and every miss")
    parser.add_argument("--tables", type=Path, help="append the same, as Markdown, to a file")
    main(measure, parser)
