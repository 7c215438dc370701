"""Which thresholds that were chosen, not measured, decide an answer of the battery: each halved or doubled.

All are changed at once, each halved or doubled at random, and a second time the other way round. One by one it would be two
batteries for each of some five hundred, which takes weeks. Where the verdict or a cause of a question changes, halves of the
changes are tried, and halves of these, until single thresholds are left (or a few that act together alone). These are set back
for this question and all that follow; the cheapest are asked first. An answer that moves yet again after four of these lies on
an edge, and is told.
A threshold that is left at the end was changed in every question, one way and the other, and the answers of all others stayed,
as far as changes do not make up for each other.

A share stays below 1, and of a factor between 1 and 2 the distance to 1 is halved or doubled; of a grid of values every other
one stays, or means come between them. Which way a threshold goes depends on its name and the seed; both ways are asked side by
side. An answer that takes ten times as long counts as changed. Answers are kept in runs/thresholds.jsonl, and asked again where
the code has changed.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import golden
import harness
import numpy as np

RESULTS = golden.ROOT / "runs/thresholds.jsonl"
QUICK = ("nothing 0", "nothing 1", "faint 0", "singles 0")
"""Questions that take some ten seconds together."""
SECONDS = 540.0
"""Of a quick run: what is open then goes on with the next one."""
NO_SHARES = ("wide_interval", "counted_floor", "recurrence", "often_errors")
"""Widths, mean squares, seconds and standard errors: 1 is a number like others to them."""
MOST = 4
"""Times that what moves one answer is looked for. One that still moves lies on an edge, and many small changes tip it."""
PATIENCE = 3600.0
"""Seconds for an answer under no changes; others get ten times what that took, and a minute."""
Changes = Mapping[str, Any]
"""`module:name` → another value."""


def tables() -> dict[str, Any]:
    """Module → the thresholds of a room."""
    found = sorted(path for top in ("core", "plugins") for path in (golden.ROOT / top).rglob("thresholds.py"))
    names = [".".join(path.relative_to(golden.ROOT).with_suffix("").parts[1:]) for path in found]
    return {name: importlib.import_module(name).THRESHOLDS for name in names}


def changed(value: Any, up: bool, share: bool = True) -> Any:
    """A value halved, or doubled; in Python's own types. `share`: a number below 1 stays there."""
    if isinstance(value, tuple) and len(value) > 2:
        means = [(a + b) / 2 for a, b in itertools.pairwise(value)]
        kept = [*value, *means] if up else value[::2]
        return tuple(sorted({type(value[0])(v) for v in kept}, reverse=value[0] > value[-1]))
    if isinstance(value, tuple):
        return tuple(changed(v, up) for v in value)
    if isinstance(value, int):
        return 2 * value if up else max(1, round(value / 2))
    if share and 0.5 <= value < 1:
        return 1 - (1 - value) / 2 if up else value / 2
    if 1 < value < 2:
        return 1 + (value - 1) * (2.0 if up else 0.5)
    return value * (2.0 if up else 0.5)


def draws(seed: int, only: str) -> list[dict[str, Any]]:
    """All that was chosen, changed at random, and the other way round."""
    rooms = {name: table for name, table in tables().items() if only in name}
    chosen = [
        (f"{name}:{f.name}", getattr(table, f.name))
        for name, table in rooms.items()
        for f in fields(table)
        if f.metadata["reason"].endswith("chosen, not measured")
    ]
    ways = {key: bool(hashlib.sha256(f"{seed} {key}".encode()).digest()[0] & 1) for key, _ in chosen}
    shares = {key: key.partition(":")[2] not in NO_SHARES for key, _ in chosen}
    both = ({key: changed(v, ways[key] ^ turn, shares[key]) for key, v in chosen} for turn in (False, True))
    return [{key: new for (key, v) in chosen if (new := made[key]) != v} for made in both]


def ask(question: str, changes: Changes) -> Any:
    """In this process, in which nothing of ours has been imported yet."""
    for key, value in changes.items():
        name, _, threshold = key.partition(":")
        module: Any = importlib.import_module(name)
        module.THRESHOLDS = replace(module.THRESHOLDS, **{threshold: tuple(value) if isinstance(value, list) else value})
    return list(told(golden.ask(question)))


def told(answer: Any, path: str = "") -> Iterator[str]:
    """What is compared of an answer: verdicts, what causes what, errors."""
    if isinstance(answer, dict):
        for key, value in answer.items():
            if key in ("verdict", "effect", "site", "error") and isinstance(value, str):
                yield f"{path}{key}: {value.splitlines()[0] if value else ''}"
            elif key not in ("hidden", "classes"):
                yield from told(value, f"{path}{key} ")
    elif isinstance(answer, list):
        for k, value in enumerate(answer):
            yield from told(value, f"{path}{k} ")


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Battery:
    """Answers under changes, each asked in a process of its own, and kept."""

    def __init__(self, questions: list[str], results: Path, until: float) -> None:
        self.questions, self.results, self.until, self.asked = questions, results, until, 0
        sources = sorted(path for top in ("core", "plugins") for path in (golden.ROOT / top).rglob("*.py"))
        self.code = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
        lines = map(json.loads, results.read_text().splitlines()) if results.exists() else ()
        self.known: dict[str, dict[str, Any]] = {line["key"]: line for line in lines}

    def answer(self, question: str, changes: Changes) -> list[str]:
        """TimeoutError where the run has no time left."""
        key = hashlib.sha256(json.dumps([self.code, question, changes], sort_keys=True).encode()).hexdigest()
        if key not in self.known:
            if time.monotonic() > self.until:
                raise TimeoutError
            limit = 60 + 10 * self.known[self.key(question)]["seconds"] if changes else PATIENCE
            begin = time.monotonic()
            made = {"key": key, "question": question, "answer": self.run(question, changes, limit)}
            self.known[key] = made | {"seconds": round(time.monotonic() - begin, 1)}
            self.results.parent.mkdir(exist_ok=True)
            with self.results.open("a") as file:
                file.write(json.dumps(self.known[key]) + "\n")
            self.asked += 1
            say(f"{self.asked}: {question}, {len(changes)} changed, {self.known[key]['seconds']} s")
        found: list[str] = self.known[key]["answer"]
        return found

    def key(self, question: str) -> str:
        return hashlib.sha256(json.dumps([self.code, question, {}], sort_keys=True).encode()).hexdigest()

    def run(self, question: str, changes: Changes, limit: float) -> list[str]:
        paths = [str(golden.ROOT / part) for part in ("core", "plugins", "benchmarks")]
        env = os.environ | golden.ONE | {"PYTHONPATH": os.pathsep.join(paths)}
        command = [sys.executable, __file__, "--ask", question]
        try:
            done = subprocess.run(
                command, cwd=golden.ROOT, env=env, input=json.dumps(changes), capture_output=True, text=True, timeout=limit
            )
        except subprocess.TimeoutExpired:
            return [f"error: more than {limit:.0f} s"]
        return json.loads(done.stdout) if done.returncode == 0 else [f"error: {done.stderr.splitlines()[-1:]}"]

    def moved(self, question: str, changes: Changes) -> bool:
        return self.answer(question, changes) != self.answer(question, {})

    def culprits(self, question: str, changes: Changes, held: Changes) -> dict[str, Any]:
        """Of changes that move an answer beside those that are held: single ones, or a few that do together."""
        if len(changes) == 1:
            return dict(changes)
        keys = list(changes)
        one, two = ({k: changes[k] for k in part} for part in (keys[: len(keys) // 2], keys[len(keys) // 2 :]))
        for part in (one, two):
            if self.moved(question, {**held, **part}):
                return self.culprits(question, part, held)
        first = self.culprits(question, one, {**held, **two})
        return first | self.culprits(question, two, {**held, **first})

    def decided(self, changes: dict[str, Any], found: dict[str, tuple[Any, str]], edges: list[str]) -> None:
        """Asks one question after another; what moves an answer goes from the changes to `module:name` → (value, question)."""
        for question in self.questions:
            for _ in range(MOST):
                if not self.moved(question, changes):
                    break
                for key, value in self.culprits(question, changes, {}).items():
                    found[key] = value, question
                    del changes[key]
                    say(f"{key} = {value} decides {question}")
            else:
                if self.moved(question, changes):
                    edges.append(question)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few questions, in at most ten minutes; it goes on where it ended")
    parser.add_argument("--only", default="", metavar="ROOM", help="thresholds of rooms with this text in their names")
    parser.add_argument("--specs", action="store_true", help="ask the published specs as well")
    parser.add_argument("--seed", type=int, default=golden.SEED)
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE", help="where answers are kept")
    parser.add_argument("--ask", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.ask:
        print(json.dumps(ask(given.ask, json.load(sys.stdin))))
        return 0
    sys.path[:0] = [str(golden.ROOT / part) for part in ("core", "plugins")]
    asked = [q for q in golden.questions(golden.ROOT) if given.specs or not q.endswith(".yaml")]
    battery = Battery(
        list(QUICK) if given.quick else asked, given.results, time.monotonic() + SECONDS if given.quick else np.inf
    )
    ways = draws(given.seed, given.only)
    now, every, found = tables(), len(ways[0].keys() | ways[1].keys()), [dict[str, tuple[Any, str]]() for _ in ways]
    items, ended, edges = list[tuple[str, Any, str, str]](), False, [list[str]() for _ in ways]
    with ThreadPoolExecutor(2) as pool, suppress(TimeoutError):
        list(pool.map(lambda question: battery.answer(question, {}), battery.questions))
        battery.questions.sort(key=lambda question: battery.known[battery.key(question)]["seconds"])
        list(pool.map(battery.decided, ways, found, edges))
        decisive = sorted((key, *of) for one in found for key, of in one.items())
        moved = pool.map(lambda item: battery.moved(item[2], {item[0]: item[1]}), decisive)
        items = [(*item, "yes" if moves else "no") for item, moves in zip(decisive, moved, strict=True)]
        ended = True
    rows = list[str]()
    for key, value, question, alone in items or [(key, *of, "") for one in found for key, of in sorted(one.items())]:
        module, _, name = key.partition(":")
        cells = (module.removesuffix(".thresholds"), f"`{name}`", getattr(now[module], name), value, question, alone)
        rows.append(f"| {' | '.join(map(str, cells))} |")
    print(", ".join(f"{k}: {v}" for k, v in harness.machine().items()), "\n")
    print("| room | threshold | is | changed to | moves the answer to | alone |", f"|{' --- |' * 6}", *rows, sep="\n")
    tipped = sorted({question for one in edges for question in one})
    cleared = f"{len(ways[0].keys() & ways[1].keys())} of {every} thresholds change nothing, halved or doubled"
    cleared += f", but for {', '.join(tipped)}, whose answers lie on an edge: many changes tip them" if tipped else ""
    state = cleared if ended else "not all is asked: call again"
    print(f"\n{len(battery.questions)} questions: {state}.")
    print("\n*Alone*: halved or doubled by itself it moves that answer. Others do so only together with some that stand here.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
