"""Engines that answer by more than their arguments: how often they get a claim, and how often it is false.

Kinds of `tests/support/impure.py`, with drawn sizes, and drawn ones. A claim is held against new engines, asked row by row, all
at once and along closed loops: deterministic, one step outside of [l, u] makes it false; statistical, more than ε of them and
five deviations. Rows are kept in a file and not asked again.
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import gapcert as gc
from gapcert_bounds.constants.declared_constants import Declared

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from impure import CONSTANTS, FORGETFUL, KINDS, Circumstantial, Forgetful, domain, nominal, violated

ONE = functools.partial(ThreadPoolExecutor, 1)
EPSILON = 1e-3


def asked(kind: str, claim: str, clean: bool, seed: int) -> dict[str, object]:
    """What certify says of one engine, and how many steps of new ones contradict it."""
    size = float(10 ** np.random.default_rng([seed, len(kind)]).uniform(-2.5, -0.7))
    made = functools.partial(Forgetful if kind in FORGETFUL else Circumstantial, kind, size, clean)
    more = {"sampling": gc.GridSampling((9, 10, 8)), "lipschitz": Declared(CONSTANTS), "predictor": "none"}
    row: dict[str, object] = {"kind": kind, "claim": claim, "clean": clean, "seed": seed}
    with tempfile.TemporaryDirectory() as folder:
        try:
            request = gc.Request(claim, epsilon=EPSILON)
            options = more if claim == "deterministic" else {}
            c = gc.certify(
                nominal(), made(), domain(), request=request, seed=seed, folder=f"{folder}/c", executor=ONE, **options
            )
        except gc.UsageError as error:
            return row | {"got": "refused", "why": str(error)[:120]}
        out, steps = violated(c, made, 3000, seed)
    allowed = {"deterministic": 0.0, "statistical": EPSILON * steps + 5 * (EPSILON * steps) ** 0.5}
    return row | {"got": c.claim.kind, "outside": out, "steps": steps, "false": out > allowed.get(c.claim.kind, steps)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--drawn", type=int, default=100, help="so many drawn kinds besides")
    parser.add_argument("--rows", type=Path, default=Path("runs/impurity.jsonl"))
    options = parser.parse_args()
    options.rows.parent.mkdir(parents=True, exist_ok=True)
    known = [json.loads(line) for line in options.rows.read_text().splitlines()] if options.rows.exists() else []
    done = {(r["kind"], r["claim"], r["clean"], r["seed"]) for r in known}
    kinds = [(kind, seed) for kind in (*KINDS, *FORGETFUL) for seed in range(options.seeds)]
    kinds += [(f"drawn {k}", k) for k in range(options.drawn)]
    for kind, seed in kinds:
        for claim in ("deterministic", "statistical"):
            for clean in (False, True):
                if (kind, claim, clean, seed) not in done:
                    known.append(asked(kind, claim, clean, seed))
                    with options.rows.open("a") as file:
                        file.write(json.dumps(known[-1]) + "\n")
                    if known[-1].get("false"):
                        print("FALSE", known[-1], flush=True)
    for clean in (False, True):
        for claim in ("deterministic", "statistical"):
            rows = [r for r in known if (r["clean"], r["claim"]) == (clean, claim)]
            told = ", ".join(f"{n} {got}" for got, n in sorted(Counter(r["got"] for r in rows).items()))
            print(f"{'clean' if clean else 'impure'}, {claim} asked: {told}; false {sum(bool(r.get('false')) for r in rows)}")


if __name__ == "__main__":
    main()
