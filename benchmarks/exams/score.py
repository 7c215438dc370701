"""What the answers are worth: rates with one-sided 95 % limits, errors of numbers, who is taken for whom."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from scipy.stats import beta

Record = dict[str, Any]
NAMED = ("causes", "ambiguous")


@dataclass(frozen=True)
class Rate:
    """good of count, and the one-sided 95 % Clopper–Pearson limit on the side that hurts."""

    good: int
    count: int

    @property
    def share(self) -> float:
        return self.good / self.count if self.count else float("nan")

    @property
    def at_least(self) -> float:
        return float(beta.ppf(0.05, self.good, self.count - self.good + 1)) if self.good else 0.0

    @property
    def at_most(self) -> float:
        return float(beta.ppf(0.95, self.good + 1, self.count - self.good)) if self.good < self.count else 1.0


def rate(records: Sequence[Record], holds: Callable[[Record], bool]) -> Rate:
    return Rate(sum(map(holds, records)), len(records))


def first(r: Record) -> tuple[str, str] | None:
    """What is named first, if anything is."""
    if r.get("verdict") not in NAMED or not r["causes"]:
        return None
    return r["causes"][0]["effect"], r["causes"][0]["site"]


def named(r: Record) -> list[tuple[str, str]]:
    return [(c["effect"], c["site"]) for c in r.get("causes", [])] if r.get("verdict") in NAMED else []


def truth(r: Record) -> tuple[str, str]:
    return r["hidden"][0]["effect"], r["hidden"][0]["site"]


def alike(r: Record) -> set[tuple[str, str]]:
    return {(k[0], k[1]) for k in r["classes"][0]}


def alone(r: Record) -> bool:
    return len(r["classes"][0]) == 1


def exact(r: Record) -> bool:
    return first(r) == truth(r)


def open_question(r: Record) -> bool:
    """Is the truth among the members of an ambiguous answer, and was it promised that the experiment separates it from one?"""
    return bool(r.get("apart")) and list(truth(r)) in r["members"]


def resolved(r: Record) -> bool:
    """Does the answer to both logs name the truth, or what was said to stay alike, and nothing from which it was to be told?"""
    after = r["designed"]
    said = set(named(after)) | {(k[0], k[1]) for group in after.get("ambiguous_with", []) for k in group}
    return truth(r) in said and not said & {(p["rival"][0], p["rival"][1]) for p in r["apart"]}


def in_class(r: Record) -> bool:
    return first(r) in alike(r)


def outside(r: Record) -> int:
    """Names in the whole answer that do not belong to the class."""
    said = set(named(r)) | {(k[0], k[1]) for group in r.get("ambiguous_with", []) for k in group}
    return len(said - alike(r)) if r.get("verdict") in NAMED else 0


def certain_and_wrong(r: Record) -> bool:
    return r.get("verdict") == "causes" and bool(r["causes"]) and not flagged(r) and first(r) not in alike(r)


def flagged(r: Record) -> bool:
    """Is a cause of this answer itself called doubtful?"""
    return any(c["flags"] for c in r.get("causes", []))


def both(r: Record) -> bool:
    """Is each hidden effect, or one of its class, among the names?"""
    said = set(named(r))
    return all(said & {(k[0], k[1]) for k in c} for c in r["classes"])


def both_or_as_well(r: Record) -> bool:
    """Or do as few causes and numbers fit the noiseless data as well as the truth?"""
    few = [sum(len(h["numbers"].keys() - {"soft"}) for h in r.get(side, [])) for side in ("causes", "hidden")]
    as_well = r.get("stands") and r["verdict"] in NAMED and len(r["causes"]) <= len(r["hidden"]) and few[0] <= few[1]
    return both(r) or bool(as_well)


def extra(r: Record) -> int:
    known = {(k[0], k[1]) for c in r["classes"] for k in c}
    return len(set(named(r)) - known)


def silent(r: Record) -> bool:
    return r.get("verdict") == "nothing"


def errors(records: Iterable[Record]) -> dict[str, list[float]]:
    """Relative error of every number of what was named rightly, by effect and number."""
    out: dict[str, list[float]] = {}
    for r in records:
        if not exact(r):
            continue
        found = r["causes"][0]["numbers"]
        for name, value in r["hidden"][0]["numbers"].items():
            if name in found and name not in ("phase", "time"):
                out.setdefault(f"{truth(r)[0]}.{name}", []).append(abs(found[name] - value) / max(abs(value), 1e-12))
    return out


def sizes(records: Iterable[Record]) -> list[float]:
    """Relative error of the first number of every right answer whose class has one member.

    Where a parameter could stand for the effect, its tolerance is what limits the number.
    """
    out = []
    for r in records:
        if exact(r) and alone(r):
            name, value = next(iter(r["hidden"][0]["numbers"].items()))
            found = r["causes"][0]["numbers"].get(name)
            if found is not None:
                out.append(abs(found - value) / max(abs(value), 1e-12))
    return out


def median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else float("nan")
