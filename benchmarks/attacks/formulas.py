"""Automata of formulas against the meaning of the formula on lassos: words that end in a loop."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from attacks import Attempt
from gapcert_cells.ltl import automaton_of

WORDS = 50
NAMES = "abc"
DEEPEST = 4


def drawn(rng: np.random.Generator, depth: int) -> Any:
    if depth == 0 or rng.random() < 0.15:
        return str(rng.choice(list(NAMES)))
    operator = str(rng.choice(["!", "X", "F", "G", "&", "|", "->", "U", "R", "W", "M"]))
    parts = [drawn(rng, depth - 1) for _ in range(1 if operator in ("!", "X", "F", "G") else 2)]
    return (operator, *parts)


def text(f: Any) -> str:
    if isinstance(f, str):
        return f
    return f"({f[0]} {text(f[1])})" if len(f) == 2 else f"({text(f[1])} {f[0]} {text(f[2])})"


def truth(f: Any, word: np.ndarray, loop: int) -> np.ndarray:
    """(letters,): does f hold from each letter on? After the last one the word goes on at `loop`. Fixed points of one step."""
    if isinstance(f, str):
        return np.asarray(word[:, NAMES.index(f)])
    after = np.append(np.arange(1, len(word)), loop)
    a, *rest = (truth(part, word, loop) for part in f[1:])
    b, none = (rest[0] if rest else a), np.zeros(len(word), dtype=bool)
    if f[0] in ("!", "X", "&", "|", "->"):
        return np.asarray({"!": ~a, "X": a[after], "&": a & b, "|": a | b, "->": ~a | b}[f[0]])
    steps = {
        "F": (none, lambda v: a | v[after]),
        "G": (~none, lambda v: a & v[after]),
        "U": (none, lambda v: b | (a & v[after])),
        "W": (~none, lambda v: b | (a & v[after])),
        "R": (~none, lambda v: b & (a | v[after])),
        "M": (none, lambda v: b & (a | v[after])),
    }
    value, step = steps[f[0]]
    for _ in range(len(word) + 1):
        value = step(value)
    return np.asarray(value)


def accepted(automaton: Any, word: np.ndarray, loop: int) -> bool:
    """Does the run over the lasso visit accepting states again and again?"""
    bits = [sum(1 << p for p, n in enumerate(automaton.propositions) if letter[NAMES.index(n)]) for letter in word]
    state, at, seen, trail = automaton.start, 0, dict[tuple[int, int], int](), list[int]()
    while (state, at) not in seen:
        seen[state, at] = len(trail)
        trail.append(state)
        state = automaton.after[state][bits[at]]
        if state < 0:
            return False
        at = at + 1 if at + 1 < len(word) else loop
    return any(automaton.accepting[q] for q in trail[seen[state, at] :])


def attempt(rng: np.random.Generator, folder: Path, tries: int = WORDS) -> Attempt:
    f = drawn(rng, int(rng.integers(1, DEEPEST + 1)))
    words = [(rng.random((int(rng.integers(1, 8)), len(NAMES))) < rng.choice([0.2, 0.5, 0.8])) for _ in range(tries)]
    lassos = [(word, int(rng.integers(len(word)))) for word in words]
    meant = [bool(truth(f, *lasso)[0]) for lasso in lassos]
    try:
        automaton = automaton_of(text(f))
    except gc.GapcertError as error:
        nothing = "accepts nothing" in str(error)
        return Attempt(
            "deterministic" if nothing else "refused", tries, sum(meant) if nothing else 0, case={"formula": text(f)}
        )
    wrong = sum(accepted(automaton, *lasso) != want for lasso, want in zip(lassos, meant, strict=True))
    return Attempt("deterministic", tries, wrong, case={"formula": text(f)})
