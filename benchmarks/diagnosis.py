"""Exams: effects hidden in data by an independent generator, and what the diagnosis makes of them.

Every case is drawn from (seed, part, index) alone. With --store, answers are kept in a file of JSON lines, and a run that was
stopped goes on where it stood. Another seed is another exam.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from exams import cost, files
from exams.parts import PARTS
from exams.store import sittings
from exams.tables import page
from harness import Row, main

QUICK = ("singles", "nothing", "cost")
Task = tuple[str, int, int, float]


def ask(task: Task) -> dict[str, Any]:
    part, seed, index, limit = task
    return PARTS[part].ask(seed, index, limit)


def measure(options: argparse.Namespace) -> list[Row]:
    rows = []
    for name in options.part or (QUICK if options.quick else (*PARTS, "cost")):
        if name == "cost":
            rows += cost.measure(options.quick) + files.measure(options.quick, options.limit)
            continue
        part = PARTS[name]
        count = options.cases or (part.quick if options.quick else part.cases)
        records = list(
            sittings(ask, [(name, options.seed, i, options.limit) for i in range(count)], options.jobs, options.store)
        )
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
