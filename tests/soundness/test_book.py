"""Attacks on the book of audits: another spelling for fresh β, a fit that knows its points, a book that is lost or edited."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spellings import another, asked, drawn, respelled

import gapcert as gc
from gapcert.certification.fingerprint import Fingerprint
from gapcert.certification.ledger import Entry, Ledger
from gapcert.contracts.gaps.claim import audit_size
from gapcert.numerics.order_statistics import missed
from gapcert.testing.toys import Drift, Perturbed, ripple


def kept(question: Fingerprint) -> dict[str, Any]:
    """As the book hands it back."""
    return json.loads(json.dumps({k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in question.known.items()}))


def held(question: Fingerprint, other: Fingerprint) -> float:
    """By how many times 4 e two questions of the same axes differ at the points of the first; a twin of what the book does."""
    z, nx = question.known["z"], question.domain.nx
    axes = [a.name for a in question.domain.axes]
    whole = np.tile(question.domain.centre, (len(z), 1))
    counting = [k for k, name in enumerate(axes) if name in counted(question)]
    whole[:, counting] = z
    x, u = (np.ascontiguousarray(part) for part in (whole[:, :nx], whole[:, nx:]))
    pairs = ((question.model, other.model), (question.backend, other.backend))
    d = np.max([np.abs(a.step(x, u).x - b.step(x, u).x).max(axis=0) for a, b in pairs], axis=0)
    states = [k for k in counting if k < nx]
    return float((d[states] / (4 * question.known["e"][0])).max(initial=0.0))


def counted(question: Fingerprint) -> list[str]:
    return [question.domain.axes[k].name for k in question._axes]


def attacked(seed: int, questions: int, spellings: int) -> tuple[int, int]:
    """(meaningless edits, edits that mean something) that were tried."""
    rng, same, apart = np.random.default_rng(seed), 0, 0
    for _ in range(questions):
        spec = drawn(rng)
        first = asked(spec)
        old = kept(first)
        for _ in range(spellings):
            other, edits = respelled(spec, rng, int(rng.integers(1, 4)))
            assert asked(other).same(old), (edits, spec, other)
            same += 1
        for _ in range(spellings):
            found = asked(another(spec, rng))
            (low, high), ends = first.known["ends"], found._all["ends"][:, first._axes]  # what relations leave of ranges
            moved = (np.abs(ends - first.known["ends"]) > 1e-8 * (high - low)).any()
            if moved or held(first, found) > 2:
                assert not found.same(old), (spec, found.backend.to_spec(), found.model.to_spec())
                apart += 1
    return same, apart


def test_a_question_is_the_same_whatever_its_spelling() -> None:
    same, apart = attacked(1, 6, 3)
    assert same == 18
    assert apart > 5
