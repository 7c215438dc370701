"""Run folders of every kind, forged with all digests made anew: what `verify` accepts, and does not say that it trusts."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import numpy as np

from attacks import Attempt

sys.path.append(str(Path(__file__).parents[2] / "tests" / "support"))
from forgeries import Forger, Forgery
from run_kinds import KINDS, made

from gapcert_verify import verify_run

FORGERIES = 10
"""Of one run: that takes longer than one."""


def attempt(rng: np.random.Generator, folder: Path, tries: int = FORGERIES) -> Attempt:
    kind = str(rng.choice(list(KINDS)))
    source = made(kind, folder, rng)
    target, forger = folder / "forged" / source.name, Forger(rng)
    shutil.copytree(source, target)
    forger.mend(target, Forgery("nothing"))
    if failed := [c for run in (source, target) for c in verify_run(run)["checks"] if not c["passed"]]:
        return Attempt("error", case={"kind": kind, "why": f"an honest run of kind {kind} is refused: {failed[0]}"})
    each = list(forger.every(source, target))  # half of the forgeries are of these, each field and array as likely as another
    accepted = []
    for k in range(tries):
        forgery = each[int(rng.integers(len(each)))]() if k % 2 else forger.forge(source, target)
        accepted += [text] if (text := forgery.answered(target)) else []
    return Attempt("deterministic", tries, len(accepted), case={"kind": kind, "accepted": accepted})
