"""The parts of the exam: how many cases, how each is drawn and asked, and which figures come out of the answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from exams import score, sit
from exams.score import Rate, Record

from gapcert.testing.hidden import draw

Figure = tuple[str, str, float, float, float | None]  # quantity, unit, value, limit, goal


@dataclass(frozen=True)
class Part:
    """cases: of the published table; quick: of a quick run; ask (seed, index, limit) → record; figures (records)."""

    cases: int
    quick: int
    ask: Callable[[int, int, float], Record]
    figures: Callable[[Sequence[Record]], list[Figure]]


def least(name: str, r: Rate, goal: float) -> Figure:
    return name, "share", r.share, r.at_least, goal


def most(name: str, r: Rate, goal: float) -> Figure:
    return name, "share", r.share, r.at_most, goal


def singles(records: Sequence[Record]) -> list[Figure]:
    records = [r for r in records if r["label"] == "clear"]
    lone = [r for r in records if score.alone(r)]
    sizes = score.sizes(records)
    names = sum(map(score.outside, records)) / max(len(records), 1)
    return [
        least(f"exact name and site first, class of one ({len(lone)})", score.rate(lone, score.exact), 0.97),
        least(f"class first, all ({len(records)})", score.rate(records, score.in_class), 0.99),
        ("names from outside the class, per answer", "names", names, names, 0.5),
        ("numbers within 5 %", "share", sum(e <= 0.05 for e in sizes) / max(len(sizes), 1), 0.0, None),
        ("median error of the number", "share", score.median(sizes), 0.0, 0.02),
        ("CPU time, median", "s", score.median([r["cpu"] for r in records]), 0.0, None),
    ]


def faint(records: Sequence[Record]) -> list[Figure]:
    return [
        most("a wrong name stated as certain", score.rate(records, score.certain_and_wrong), 0.03),
        least("class first", score.rate(records, score.in_class), 0.0),
        least("nothing", score.rate(records, score.silent), 0.0),
    ]


def nothing(records: Sequence[Record]) -> list[Figure]:
    return [
        most("false alarms", score.rate(records, lambda r: bool(score.named(r)) or "error" in r), 0.005),
        most("unexplained", score.rate(records, lambda r: r.get("verdict") == "unexplained"), 0.005),
    ]


def pairs(records: Sequence[Record]) -> list[Figure]:
    spare = sum(map(score.extra, records)) / max(len(records), 1)
    return [
        least("both named", score.rate(records, score.both), 0.9),
        ("names beyond the two", "names", spare, spare, None),
    ]


def unknown(records: Sequence[Record]) -> list[Figure]:
    def honest(r: Record) -> bool:
        return r.get("verdict") in ("unexplained",) or (r.get("verdict") in score.NAMED and score.flagged(r))

    def confident(r: Record) -> bool:
        return r.get("verdict") == "causes" and bool(r["causes"]) and not score.flagged(r)

    return [
        least("unexplained, or flagged as inadequate", score.rate(records, honest), 0.95),
        most("a confident wrong name", score.rate(records, confident), 0.03),
    ]


def dirty(records: Sequence[Record]) -> list[Figure]:
    soiled, clean = [r for r in records if r["dirt"]], [r for r in records if not r["dirt"]]
    a, b = score.rate(soiled, score.in_class), score.rate(clean, score.in_class)
    return [
        least("class first, dirty", a, 0.0),
        least("class first, the same logs clean", b, 0.0),
        ("points lost to dirt", "share", b.share - a.share, 0.0, 0.03),
    ]


def joints(records: Sequence[Record]) -> list[Figure]:
    out = []
    for plant in sorted({r["plant"] for r in records}):
        some = [r for r in records if r["plant"] == plant]
        out.append(least(f"{plant}: right joint and cause", score.rate(some, score.in_class), 0.9))
    return out


def _dirty(seed: int, index: int, limit: float) -> Record:
    """Even cases are clean, odd ones are the case before, soiled."""
    from gapcert.testing.hidden.log import DIRT

    kinds = () if index % 2 == 0 else (DIRT[(index // 2) % len(DIRT)],) if index % 4 == 1 else DIRT
    case = draw.single("dirty", seed, index // 2, dirt=kinds)
    return sit.sit(case, limit) | {"index": index}


PARTS = {
    "singles": Part(480, 16, lambda s, i, t: sit.sit(draw.single("singles", s, i), t), singles),
    "faint": Part(160, 4, lambda s, i, t: sit.sit(draw.single("faint", s, i, faint=True), t), faint),
    "nothing": Part(600, 8, lambda s, i, t: sit.sit(draw.nothing("nothing", s, i), t), nothing),
    "pairs": Part(140, 4, lambda s, i, t: sit.sit(draw.pair("pairs", s, i), t), pairs),
    "unknown": Part(120, 4, lambda s, i, t: sit.unknown(draw.single("unknown", s, i), t), unknown),
    "dirty": Part(160, 4, _dirty, dirty),
    "joints": Part(
        90, 2, lambda s, i, t: sit.sit(draw.single("joints", s, i, (("arm",), ("cartpole",), ("chain",))[i % 3]), t), joints
    ),
}
