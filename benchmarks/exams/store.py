"""Records of an exam: drawn in processes, kept as lines of JSON with the commit, and not made twice."""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from harness import commit

Record = dict[str, Any]


def answered(store: Path | None) -> dict[tuple[str, int, int], Record]:
    """Records of earlier runs by (part, seed, index); a line that was cut off is none."""
    lines = store.read_text().splitlines() if store is not None and store.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}")]
    return {(r["part"], r["seed"], r["index"]): r for r in records}


def sittings(ask: Callable[[Any], Record], tasks: Sequence[tuple[Any, ...]], jobs: int, store: Path | None) -> Iterator[Record]:
    """Records of tasks (part, seed, index, …), each written down as soon as it is there; says how long the rest will take."""
    done = answered(store)
    yield from (done[t[:3]] for t in tasks if t[:3] in done)
    left = [t for t in tasks if t[:3] not in done]
    if not left:
        return
    at, began = commit(), time.monotonic()
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=50) as pool:
        records: Iterable[Record] = pool.imap_unordered(ask, left)
        for n, record in enumerate(records, 1):
            record["commit"] = at
            if n in (4, 10, 20) or n % 50 == 0:
                rest = (time.monotonic() - began) / n * (len(left) - n) / 60
                print(f"{left[0][0]}: {n} of {len(left)}, some {rest:.0f} min left", file=sys.stderr, flush=True)
            if store is not None:
                with store.open("a") as file:
                    file.write(json.dumps(record) + "\n")
            yield record
