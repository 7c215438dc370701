"""Attacks on the book of audits: another spelling for fresh β, a fit that knows its points, a book that is lost or edited."""

from __future__ import annotations

import json

import numpy as np
from spellings import another, asked, drawn, respelled

from gapcert.certification.fingerprint import Fingerprint, Known


def kept(question: Fingerprint) -> Known:
    """As the book hands it back."""
    return Known.of(json.loads(json.dumps(question.known.to_data())))


def held(question: Fingerprint, other: Fingerprint) -> float:
    """By how many times 4 e two questions of the same axes differ at the points of the first; a twin of what the book does."""
    z, nx = question.known.z, question.domain.nx
    axes = [a.name for a in question.domain.axes]
    whole = np.tile(question.domain.centre, (len(z), 1))
    counting = [k for k, name in enumerate(axes) if name in counted(question)]
    whole[:, counting] = z
    x, u = (np.ascontiguousarray(part) for part in (whole[:, :nx], whole[:, nx:]))
    pairs = ((question.model, other.model), (question.backend, other.backend))
    d = np.max([np.abs(a.step(x, u).x - b.step(x, u).x).max(axis=0) for a, b in pairs], axis=0)
    states = [k for k in counting if k < nx]
    return float((d[states] / (4 * question.known.e)).max(initial=0.0))


def counted(question: Fingerprint) -> list[str]:
    return [question.domain.axes[k].name for k in question._measured[1]]


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
            moved = (found.domain.high != first.domain.high)[first._measured[1]].any()
            if moved or held(first, found) > 2:
                assert not found.same(old), (spec, found.backend.to_spec(), found.model.to_spec())
                apart += 1
    return same, apart


def test_a_question_is_the_same_whatever_its_spelling() -> None:
    same, apart = attacked(1, 6, 3)
    assert same == 18
    assert apart > 5
