"""Claims of every kind are drawn, made by the front door, and attacked: how many of them break?

    redteam.py [KIND ...] [--seed N] [--claims N] [--tries N] [--workers N] [--results FILE]     goes on where it ended
    redteam.py --quick                                                                           some of each, in three minutes
    redteam.py --table                                                                           of what is kept; draws nothing

Kinds are the modules of `attacks`. Deterministic claims may not break at all. Of a statistical one (ε, β) the share of violated
points, drawn as its audit draws, may be significantly above ε (one-sided binomial test, 1e-3) in no more claims than β allows
(0.99 quantile of a binomial distribution). Claim k of a seed is always the same. Each is kept as a line of JSON with
the commit that it was asked of, and asked again at another one. An attempt without claim or reason is an error,
and so is an honest run that `verify` refuses.
"""

from __future__ import annotations

import argparse
import importlib
import json
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import harness
import numpy as np
from attacks import KINDS, Attempt
from harness import commit
from scipy.stats import binom

from gapcert_verify import verify_run

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "runs" / "redteam.jsonl"
QUICK = {"certificates": 8, "games": 8, "mpc": 2, "networks": 20, "formulas": 300, "calibrations": 2, "forgeries": 1}
SIGNIFICANT, USUAL = 1e-3, 0.99
PATIENCE = 900
"""Seconds for one claim."""
BATCH = 200
"""Claims that the same workers attack."""


def asked(kind: str, seed: int, k: int, tries: int | None) -> dict[str, Any]:
    """Claim k, attacked, in a folder of its own."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _late)
    signal.alarm(PATIENCE)
    began, more = time.monotonic(), {} if tries is None else {"tries": tries}
    rng = np.random.default_rng([seed, list(KINDS).index(kind), k])
    with tempfile.TemporaryDirectory() as folder:
        try:
            made = importlib.import_module(f"attacks.{kind}").attempt(rng, Path(folder), **more)
            if why := _doubted(Path(folder)):
                made = Attempt("error", case={"why": why, **made.case})
        except TimeoutError:
            made = Attempt("refused", case={"why": f"more than {PATIENCE} s"})
        except Exception as error:
            made = Attempt("error", case={"why": f"{type(error).__name__}: {error}"[:500]})
        finally:
            signal.alarm(0)
    return {"kind": kind, "seed": seed, "k": k, **asdict(made), "seconds": round(time.monotonic() - began, 2)}


def _doubted(folder: Path) -> str:
    """What `verify` finds wrong with the runs that were made here, all of them honest, but for those that claim nothing."""
    runs = [path.parent for path in sorted(folder.glob("*/certificate.json"))]
    runs = [run for run in runs if json.loads((run / "summary.json").read_text(encoding="utf-8"))["verdict"] == "holds"]
    found = [check for run in runs for check in verify_run(run)["checks"] if not check["passed"]]
    return f"verify refuses an honest run: {found[0]['check']}: {found[0]['detail']}" if found else ""


def _late(*_: object) -> None:
    raise TimeoutError


def attack(wanted: Sequence[tuple[str, int, int]], tries: int | None, workers: int, results: Path) -> None:
    """Each claim in a process, what is known already left out; says how long the rest will take."""
    at, known = commit(), {(r["kind"], r["seed"], r["k"]) for r in kept(results) if r["commit"] == commit()}
    todo = [one for one in wanted if one not in known]
    results.parent.mkdir(exist_ok=True)
    began = time.monotonic()
    with results.open("a", encoding="utf-8") as file:
        for n, done in enumerate(_answers(todo, tries, workers), 1):
            row = {"commit": at, **done}
            file.write(json.dumps(row, default=str) + "\n")
            file.flush()
            if row["broken"] or row["claim"] == "error" or n % 50 == 0 or n == len(todo):
                left = (time.monotonic() - began) / n * (len(todo) - n)
                broke = (
                    f"; {row['kind']} {row['k']}: {row['claim']}, {row['broken']} of {row['tries']} break it"
                    if row["broken"]
                    else ""
                )
                print(f"{n} of {len(todo)}, some {left / 60:.0f} min left{broke}", file=sys.stderr, flush=True)


def _answers(todo: Sequence[tuple[str, int, int]], tries: int | None, workers: int) -> Iterator[dict[str, Any]]:
    """As they come. Workers are replaced now and then: engines and solvers keep some memory."""
    for k in range(0, len(todo), BATCH):
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:  # a fork of JAX may hang
            for done in as_completed([pool.submit(asked, *one, tries) for one in todo[k : k + BATCH]]):
                yield done.result()


def kept(results: Path) -> Iterator[dict[str, Any]]:
    """Rows of earlier runs; of a claim that was asked twice the later one."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    yield from {(r["kind"], r["seed"], r["k"]): r for r in map(json.loads, lines)}.values()


def above(row: dict[str, Any]) -> bool:
    """Is the violated share significantly above ε?"""
    points, wrong = row["drawn"]
    return bool(binom.sf(wrong - 1, points, row["level"]) < SIGNIFICANT)


def line(kind: str, rows: list[dict[str, Any]]) -> list[str]:
    """One line of the table."""
    of = {
        claim: [r for r in rows if r["claim"] == claim]
        for claim in ("deterministic", "statistical", "empirical", "refused", "error")
    }
    firm, stated = of["deterministic"], of["statistical"]
    high = sum(map(above, stated))
    may = int(binom.ppf(USUAL, len(stated), max((r["doubt"] or 0.0 for r in stated), default=0.0))) if stated else 0
    broken = f"{sum(bool(r['broken']) for r in firm)} of {len(firm):,}"
    level = f"{high} of {len(stated):,} (may be {may})" if stated else "–"
    others = f"{len(of['empirical']):,} / {len(of['refused']):,} / {len(of['error'])}"
    return [kind, f"{len(rows):,}", f"{sum(r['tries'] for r in rows):,}", broken, level, others]


HEAD = [
    "kind",
    "claims",
    "points, steps, words, forgeries",
    "deterministic, broken",
    "statistical, above ε",
    "empirical / refused / error",
]


def table(results: Path) -> str:
    rows = list(kept(results))
    lines = [line(kind, part) for kind in KINDS if (part := [r for r in rows if r["kind"] == kind])]
    commits = ", ".join(sorted({r["commit"] for r in rows}))
    head = ", ".join(f"{k}: {v}" for k, v in harness.machine().items())
    text = [f"Commit {commits}; {head}.", "", f"| {' | '.join(HEAD)} |", f"| --- |{' ---: |' * (len(HEAD) - 1)}"]
    return "\n".join([*text, *(f"| {' | '.join(cells)} |" for cells in lines)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}; default: all")
    parser.add_argument("--seed", type=int, default=2026)
    parser.add_argument("--claims", type=int, help="how many of each kind; default: as many as a full run asks")
    parser.add_argument("--tries", type=int, help="points, steps or words per claim; default: the kind's own")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--results", type=Path, default=RESULTS, metavar="FILE", help="where rows are kept")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", action="store_true", help="the rows of the table as JSON")
    parser.add_argument("--table", action="store_true", help="the table of what is kept, and no attack")
    given = parser.parse_args()
    if unknown := set(given.kinds) - set(KINDS):
        parser.error(f"found {', '.join(sorted(unknown))}; expected kinds of {', '.join(KINDS)}")
    counts = QUICK if given.quick else {kind: given.claims or most for kind, most in KINDS.items()}
    if not given.table:
        wanted = [(kind, given.seed, k) for kind in (given.kinds or KINDS) for k in range(counts[kind])]
        attack(wanted, given.tries, given.workers, given.results)
    if given.json:
        rows = list(kept(given.results))
        print(
            json.dumps(
                {
                    "machine": harness.machine(),
                    "rows": [line(k, p) for k in KINDS if (p := [r for r in rows if r["kind"] == k])],
                }
            )
        )
    else:
        print(table(given.results))
    bad = [r for r in kept(given.results) if r["claim"] == "error" or (r["claim"] == "deterministic" and r["broken"])]
    return int(bool(bad))


if __name__ == "__main__":
    sys.exit(main())
