"""Automata from formulas and from HOA text: the words they accept, and what is refused in one sentence."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from gapcert import UsageError
from gapcert.plugin import Automaton
from gapcert_cells import automaton_of, read_hoa

ROCS = "F(a1 & F(a2 & F(a3 & (!a2 U a1))))"


def satisfied(f: Any, word: list[set[str]], i: int = 0) -> bool:
    """Textbook semantics: does this finite beginning suffice, however it goes on? `f` is a nested tuple; ! stands at names."""
    if i >= len(word):
        return False
    kind = f[0]
    if kind == "!":
        return f[1] not in word[i]
    if kind == "p":
        return f[1] in word[i]
    if kind == "X":
        return satisfied(f[1], word, i + 1)
    if kind == "&":
        return satisfied(f[1], word, i) and satisfied(f[2], word, i)
    if kind == "|":
        return satisfied(f[1], word, i) or satisfied(f[2], word, i)
    if kind == "F":
        return any(satisfied(f[1], word, j) for j in range(i, len(word)))
    found = range(i, len(word))
    return any(satisfied(f[2], word, j) and all(satisfied(f[1], word, m) for m in range(i, j)) for j in found)


def written(f: Any) -> str:
    if f[0] in ("p", "!"):
        return ("!" if f[0] == "!" else "") + f[1]
    if len(f) == 2:
        return f"{f[0]} ({written(f[1])})"
    return f"(({written(f[1])}) {f[0]} ({written(f[2])}))"


def drawn(rng: np.random.Generator, depth: int) -> Any:
    if depth == 0 or rng.random() < 0.15:
        return (str(rng.choice(["p", "!"])), str(rng.choice(["a", "b", "c"])))
    kind = str(rng.choice(["X", "F", "&", "|", "U"]))
    return (kind, *(drawn(rng, depth - 1) for _ in range(1 if kind in "XF" else 2)))


def accepts(automaton: Automaton, word: list[set[str]]) -> bool:
    q = np.array([automaton.start])
    for holds in word:
        q = automaton.advance(q, np.array([sum(1 << p for p, n in enumerate(automaton.propositions) if n in holds)]))
        if q[0] >= 0 and automaton.done[q[0]]:
            return True
    return False


def words(rng: np.random.Generator, names: list[str], n: int, longest: int = 7) -> Any:
    for _ in range(n):
        share = rng.random((rng.integers(1, longest), len(names)))
        yield [{name for name, s in zip(names, row, strict=True) if s < 0.4} for row in share]


def test_progression_accepts_the_words_of_the_semantics() -> None:
    rng, accepted, empty = np.random.default_rng(0), 0, 0
    for _ in range(150):
        f = drawn(rng, 3)
        if not any(satisfied(f, word) for word in words(rng, ["a", "b", "c"], 200, 9)):
            empty += 1
            with pytest.raises(UsageError, match="accepts nothing"):
                automaton_of(written(f))
            continue
        automaton = automaton_of(written(f))
        assert automaton.ends
        for word in words(rng, ["a", "b", "c"], 40):
            # Of X (a | !a) the one knows earlier than the other; both agree once the word has gone on for long enough.
            longer = word + [set[str]()] * 4
            assert accepts(automaton, longer) == satisfied(f, longer), (written(f), longer)
            accepted += satisfied(f, longer)
    assert 1000 < accepted < 5500
    assert 0 < empty < 15


STEPS: dict[str, Callable[[bool, bool, bool], bool]] = {
    "F": lambda a, b, later: b or later,
    "G": lambda a, b, later: b and later,
    "U": lambda a, b, later: b or (a and later),
    "W": lambda a, b, later: b or (a and later),
    "R": lambda a, b, later: b and (a or later),
}


def lasso(f: Any, stem: list[set[str]], loop: list[set[str]]) -> bool:
    """Textbook semantics on stem · loop · loop · …: fixpoints over positions, from false the least, from true the greatest."""
    word, n = stem + loop, len(stem) + len(loop)
    after = [*range(1, n), len(stem)]

    def at(f: Any) -> list[bool]:
        if f[0] in ("p", "!"):
            return [(f[1] in letter) == (f[0] == "p") for letter in word]
        parts = [at(part) for part in f[1:]]
        a, b = parts[0], parts[-1]
        if f[0] == "X":
            return [b[after[i]] for i in range(n)]
        if f[0] in ("&", "|"):
            return [(a[i] and b[i]) if f[0] == "&" else (a[i] or b[i]) for i in range(n)]
        left = [f[0] in ("G", "R", "W")] * n
        for _ in range(n):
            left = [STEPS[f[0]](a[i], b[i], left[after[i]]) for i in range(n)]
        return left

    return at(f)[0]


def lasting(rng: np.random.Generator, depth: int) -> Any:
    """A formula in which nothing lasts for ever within what need only come at some time."""
    if depth == 0 or rng.random() < 0.3:
        return drawn(rng, min(depth, 2))
    kind = str(rng.choice(["X", "G", "&", "|", "R", "W", "G"]))
    return (kind, *(lasting(rng, depth - 1) for _ in range(1 if kind in "XG" else 2)))


def recurs(automaton: Automaton, stem: list[set[str]], loop: list[set[str]]) -> bool:
    """Is an accepting state met again and again? After as many turns as there are states, one more turn is like all others."""
    letters = [sum(1 << p for p, n in enumerate(automaton.propositions) if n in holds) for holds in stem + loop]
    q, seen, turns = np.array([automaton.start]), False, len(automaton.after)
    for turn in range(2 * turns + 1):
        for letter in letters if turn == 0 else letters[len(stem) :]:
            q = automaton.advance(q, np.array([letter]))
            if q[0] < 0:
                return False
            seen |= turn > turns and automaton.accepting[q[0]]
    return bool(seen)


def test_what_lasts_for_ever_is_accepted_as_the_semantics_have_it() -> None:
    rng, counts = np.random.default_rng(1), np.zeros(2, dtype=int)
    for _ in range(200):
        f = lasting(rng, 3)
        automaton = Automaton(("a",), ((-1, -1),), (False,))
        with suppress(UsageError):  # that it accepts nothing, which the words below confirm
            automaton = automaton_of(written(f))
        for stem, loop in zip(words(rng, ["a", "b", "c"], 30, 4), words(rng, ["a", "b", "c"], 30, 5), strict=True):
            holds = lasso(f, stem, loop)
            assert recurs(automaton, stem, loop) == holds, (written(f), stem, loop)
            counts[int(holds)] += 1
    assert counts.min() > 1500


def test_automata_are_small() -> None:
    assert len(automaton_of(ROCS).after) == 5
    assert automaton_of(ROCS).propositions == ("a1", "a2", "a3")
    assert len(automaton_of("F a & F b").after) == 4
    assert automaton_of("a U b").after == ((-1, 0, 1, 1), (1, 1, 1, 1))
    assert automaton_of("a -> b").after == ((1, -1, 1, 1), (1, 1, 1, 1))
    assert automaton_of("!(a W b)").after == automaton_of("!b U (!a & !b)").after
    assert [automaton_of(f).after for f in ("!G a", "F !a")] == [((1, 0), (1, 1))] * 2
    assert automaton_of("G F a").after == ((1, 0), (1, 0))
    assert automaton_of("!a W b").after == automaton_of("!(a & !b) W b").after
    assert [len(automaton_of(f).after) for f in ("G a", "G !c & G F a", "G F a & G F b", "G (a -> F b)")] == [1, 2, 4, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("F G a", r"'F G a' asks for something to hold for ever \(G\) from a moment on .* use the goal reach_and_stay, or"),
        ("!(G F a)", r"for ever \(a negated F\)"),
        ("a U (b R c)", r"for ever \(R\)"),
        ("G a & F !a", "accepts nothing"),
        ("F (a & b", "a \\) is missing"),
        ("F a b", "'b' is not expected there"),
        ("a & ", "ends too early"),
        ("U a", "'U' is not expected there; a formula is missing"),
        ("F a = b", "'=' is not understood"),
        ("a & !a", "accepts nothing"),
        (" | ".join(f"a{i}" for i in range(9)), "9 regions; at most 8"),
    ],
)
def test_other_formulas_are_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        automaton_of(text)


HOA = """HOA: v1
name: "GFa & GFb"
tool: "by hand"
States: 2
Start: 0
AP: 2 "a" "b"
acc-name: Buchi
Acceptance: 1 Inf(0)
properties: trans-labels explicit-labels state-acc complete deterministic
--BODY--
State: 0 "waits for a"
[!0] 0   /* nothing yet */
[0 & !1] 1
[0&1] 2
State: 1
[!1] 1
[1] 2
State: 2 {0}
[!0] 0
[(0&!1)] 1
[0&1] 2
--END--
""".replace("States: 2", "States: 3")
EDGES = """HOA: v1 States: 2 Start: 0 AP: 2 "a" "b" Acceptance: 1 Inf(0)
--BODY-- State: 0 [!0] 0 [0 & !1] 1 [0 & 1] 0 {0} State: 1 [!1] 1 [1] 0 {0} --END--"""


def visits(automaton: Automaton, word: list[set[str]]) -> int:
    q, total = np.array([automaton.start]), 0
    for holds in word:
        q = automaton.advance(q, np.array([sum(1 << p for p, n in enumerate(automaton.propositions) if n in holds)]))
        total += bool(q[0] >= 0 and automaton.accepting[q[0]])
    return total


def test_hoa_with_marks_on_states_and_on_edges() -> None:
    states, edges = read_hoa(HOA), read_hoa(EDGES)
    assert (states.propositions, len(states.after), states.ends) == (("a", "b"), 3, False)
    assert states.after[0] == (0, 1, 0, 2)
    for automaton in (states, edges):
        assert visits(automaton, [{"a"}, {"b"}] * 20) in (19, 20)
        assert visits(automaton, [{"a", "b"}] * 20) in (19, 20)
        assert visits(automaton, [{"b"}, {"b"}] * 20) == 0
        assert visits(automaton, [{"b"}] * 3 + [{"a"}] * 30) == 0


def test_hoa_accepts_what_its_language_says_over_all_short_loops() -> None:
    letters = [set[str](), {"a"}, {"b"}, {"a", "b"}]
    for automaton in (read_hoa(HOA), read_hoa(EDGES)):
        for loop in itertools.product(letters, repeat=3):
            wanted = any("a" in x for x in loop) and any("b" in x for x in loop)
            assert (visits(automaton, list(loop) * 8) >= 3) == wanted


def test_hoa_of_a_safety_property() -> None:
    made = read_hoa('HOA: v1 States: 1 Start: 0 AP: 1 "a" Acceptance: 0 t --BODY-- State: 0 [!0] 0 --END--')
    assert (made.after, made.accepting) == (((0, -1),), (True,))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("HOA: v1", "HOA: v2", "version v2 is not supported"),
        ("HOA: v1", "HAO v1", "expected HOA:"),
        ("Start: 0", "Start: 0\nStart: 1", "'Start:' is there more than once"),
        ("Start: 0", "Start: 7", "Start: 7 is not one of 3 states"),
        ("Start: 0", "", "'Start:' is missing"),
        ("1 Inf(0)", "2 Inf(0)&Inf(1)", "acceptance 2 Inf"),
        ("1 Inf(0)", "1 Fin(0)", "make it Büchi"),
        ("acc-name: Buchi", "Alias: @p 0", "'Alias:' is not supported"),
        ("[!0] 0   ", "0   ", "state 0 has an edge without a label"),
        ("[!0] 0   ", "[!3] 0   ", "names proposition 3"),
        ("[!0] 0   ", "[@p] 0   ", "aliases are not supported"),
        ("[!0] 0   ", "[t] 0   ", r"state 0 is not deterministic \(a holds\)"),
        ("[1] 2", "[1] 9", "state 9 is not one of the 3 states"),
        ("State: 1", "State: [0] 1", "labels of states are not supported"),
        ('AP: 2 "a" "b"', 'AP: 3 "a" "b"', "AP: says 3 and names 2"),
        ("--END--", "", "expected --END--"),
        ("[1] 2", "[1 2", "expected \\]"),
        ("[1] 2", "[1] §", "is not HOA"),
    ],
)
def test_other_hoa_is_refused(old: str, new: str, message: str) -> None:
    assert old in HOA
    with pytest.raises(UsageError, match=message) as caught:
        read_hoa(HOA.replace(old, new, 1), "file.hoa")
    assert str(caught.value).startswith("file.hoa: ")


def test_a_table_that_does_not_fit() -> None:
    for after in (((0, 1),), ((0,), (0,)), ((2, 0), (0, 0))):
        with pytest.raises(UsageError, match="does not fit"):
            Automaton(("a",), after, (True,) * len(after))
