"""`expect:` — what a spec says about its own result."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any

OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}
_KEY = re.compile(r"\s*(?P<path>[^\s<>=!]+)\s*(?P<operator>[<>=!]*)\s*")


def parse_key(key: str) -> tuple[list[str], str]:
    """`certificate.states.*.tightness <=` → (segments, operator); ValueError says what is wrong."""
    match = _KEY.fullmatch(key)
    if match is None:
        raise ValueError(f"'{key}' is no expectation; write path.to.value, and an operator after a space if it is not ==")
    segments, symbol = match["path"].split("."), match["operator"] or "=="
    if symbol not in OPERATORS:
        raise ValueError(f"unknown operator '{symbol}'; expected one of {' '.join(OPERATORS)}")
    if "" in segments:
        raise ValueError(f"'{match['path']}' has an empty part; write path.to.value")
    return segments, symbol


def key_problem(key: str, value: Any) -> str | None:
    """What is wrong with one line of `expect:`, or None."""
    try:
        _, symbol = parse_key(key)
    except ValueError as error:
        return str(error)
    if symbol in ("<=", ">=", "<", ">") and (isinstance(value, bool) or not isinstance(value, int | float)):
        return f"'{symbol}' compares numbers; found {value!r}"
    return None


def evaluate_expectations(expect: Mapping[str, Any], summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One `{"text", "value", "met"}` per line of `expect:`; a key that the summary lacks is not met and has value None.

    `*` stands for every key or item: all must hold, and there must be one. A list of texts also equals a list of causes
    that carry them as their `effect`, in any order.
    """
    out = []
    for key, wanted in expect.items():
        segments, symbol = parse_key(key)
        found = list(_find(summary, segments))
        met = bool(found) and all(_holds(symbol, value, wanted) for value in found)
        value = found if "*" in segments and found else (found[0] if found else None)
        out.append({"text": f"{'.'.join(segments)} {symbol} {_text(wanted)}", "value": value, "met": met})
    return out


def _find(node: Any, segments: list[str]) -> Iterator[Any]:
    """Every value that a path reaches; a branch of `*` that lacks the rest of the path yields None."""
    if not segments:
        yield node
    elif segments[0] == "*":
        for child in node.values() if isinstance(node, Mapping) else node if isinstance(node, list) else ():
            below = list(_find(child, segments[1:]))
            yield from below or [None]
    elif isinstance(node, Mapping):
        # A key may itself hold dots (`gain.0.5.q.after`).
        for n in range(1, len(segments) + 1):
            if (key := ".".join(segments[:n])) in node:
                yield from _find(node[key], segments[n:])
                return
    elif isinstance(node, list) and segments[0].isdigit() and int(segments[0]) < len(node):
        yield from _find(node[int(segments[0])], segments[1:])


def _holds(symbol: str, value: Any, wanted: Any) -> bool:
    if symbol in ("==", "!="):
        if (
            isinstance(wanted, list)
            and isinstance(value, list)
            and all(isinstance(v, Mapping) and "effect" in v for v in value)
        ):
            value, wanted = sorted(v["effect"] for v in value), sorted(map(str, wanted))
        same = value == wanted and isinstance(value, bool) == isinstance(wanted, bool)
        return same == (symbol == "==")
    return isinstance(value, int | float) and not isinstance(value, bool) and OPERATORS[symbol](value, wanted)


def _text(value: Any) -> str:
    return "[" + ", ".join(map(_text, value)) + "]" if isinstance(value, list) else str(value)
