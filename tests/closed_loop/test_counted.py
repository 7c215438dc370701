"""A closed loop is an audit like others: the book counts it, and no controller knows from where it will be run."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert_closed_loop.loop_audit import largest

LINE: dict[str, Any] = {
    "kind": "equations",
    "states": {"p": "1"},
    "inputs": {"u": "1"},
    "next": {"p": "0.9*p + u"},
    "period": "1 s",
}
SPEC: dict[str, Any] = {
    "version": 1,
    "name": "kept",
    "model": LINE,
    "backend": {**LINE, "next": {"p": "0.9*p + u + 0.01*abs(p)"}},
    "domain": {"p": [-1, 1], "u": [-0.5, 0.5]},
    "sampling": {"kind": "adaptive", "budget": 40, "executor": "threads"},
    "lipschitz": {"residual": {"kind": "interval"}},
    "gap": {"kind": "constant"},
    "certificate": {"claim": "deterministic", "violation": 0.1, "confidence": 0.9},
    "controller": {"kind": "symbolic", "goal": {"invariance": {"p": [-0.5, 0.5]}}, "cells": {"p": 20}, "inputs": {"u": 9}},
    "closed_loop": {"steps": 5, "starts": 70, "policies": ["first"], "confidence": 0.99},
    "report": {"html": False, "rerun": False},
}


def looped(out: Path, **sections: Any) -> tuple[dict[str, Any], np.ndarray]:
    """The claim of the closed loop, and its starts."""
    run = gc.run({**copy.deepcopy(SPEC), **sections}, out=out)
    return dict(run.summary["closed_loop"]["claim"]), run.closed_loop.with_gamma.x[:, 0]


@pytest.mark.run
def test_each_controller_of_a_question_spends_half_of_what_the_one_before_did(tmp_path: Path) -> None:
    first, starts = looped(tmp_path)
    assert (first["number"], first["beta"], first["epsilon"]) == (1, 0.01, largest(0, 70, 0.005))
    assert first["epsilon"] == pytest.approx(1 - 0.005 ** (1 / 70), abs=1e-4)
    again, same = looped(tmp_path)
    assert (again, np.array_equal(same, starts)) == (first, True)

    finer = {**SPEC["controller"], "cells": {"p": 25}}
    respelled = {"name": "other", "model": {**LINE, "next": {"p": "u + 9*p/10"}}, "controller": finer}
    second, others = looped(tmp_path, **respelled)
    assert (second["number"], second["epsilon"]) == (2, largest(0, 70, 0.0025))
    assert second["book"]["question"] == first["book"]["question"]
    assert not np.isin(others, starts).any()
    third, _ = looped(tmp_path, name="more", closed_loop={**SPEC["closed_loop"], "starts": 80})
    assert (third["number"], third["epsilon"]) == (3, largest(0, 80, 0.00125))

    kinds = [kind for _, kind, _, _ in json.loads((tmp_path / "ledger.json").read_text())["lines"]]
    assert (kinds.count("closed loop"), kinds.count("audit")) == (3, 2)
    another, _ = looped(tmp_path, backend={**LINE, "next": {"p": "0.9*p + u + 0.02*abs(p)"}})
    assert another["number"] == 1


@pytest.mark.run
def test_a_lost_book_is_told_of_a_closed_loop_too(tmp_path: Path) -> None:
    looped(tmp_path)
    (tmp_path / "ledger.json").unlink()
    claim, _ = looped(tmp_path, name="later", seed=1)
    assert claim["number"] == 2
    assert "lacks 2 that run folders beside it tell of" in claim["warnings"][0]
