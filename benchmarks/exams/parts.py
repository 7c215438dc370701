"""The parts of the exam: how many cases, how each is drawn and asked, and which figures come out of the answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from exams import gears as toothed
from exams import outputs as misfits
from exams import plain as plants
from exams import play, score, sit
from exams.hidden import draw
from exams.score import Rate, Record


@dataclass(frozen=True)
class Figure:
    """A quantity with its one-sided 95 % limit (where it is a rate) and its goal; more: is more better?"""

    quantity: str
    unit: str
    value: float
    limit: float | None = None
    goal: float | None = None
    more: bool = False

    @property
    def ratio(self) -> float | None:
        """More than 1 where the goal is met."""
        if self.goal is None or not self.value:
            return None
        return self.value / self.goal if self.more else self.goal / self.value


@dataclass(frozen=True)
class Part:
    """cases: of the published table; quick: of a quick run; ask (seed, index, limit) → record; figures (records)."""

    cases: int
    quick: int
    ask: Callable[[int, int, float], Record]
    figures: Callable[[Sequence[Record]], list[Figure]]


def least(name: str, r: Rate, goal: float | None = None) -> Figure:
    return Figure(name, "share", r.share, r.at_least, goal, more=True)


def most(name: str, r: Rate, goal: float) -> Figure:
    return Figure(name, "share", r.share, r.at_most, goal)


def singles(records: Sequence[Record]) -> list[Figure]:
    records = [r for r in records if r["label"] == "clear"]
    lone = [r for r in records if score.alone(r)]
    sizes, right = score.sizes(records), [r for r in records if score.in_class(r)]
    names = sum(map(score.outside, records)) / max(len(records), 1)
    return [
        least(f"exact name and site first, class of one ({len(lone)})", score.rate(lone, score.exact), 0.97),
        least(f"class first, all ({len(records)})", score.rate(records, score.in_class), 0.99),
        Figure("names from outside the class, per answer", "names", names, goal=0.5),
        Figure("numbers of right answers within 5 %", "share", sum(e <= 0.05 for e in sizes) / max(len(sizes), 1)),
        Figure("median error of these numbers", "share", score.median(sizes), goal=0.02),
        Figure("right answers with a doubt on them", "share", sum(map(score.flagged, right)) / max(len(right), 1)),
        Figure("CPU time, median", "s", score.median([r["cpu"] for r in records])),
    ]


def faint(records: Sequence[Record]) -> list[Figure]:
    return [
        most("a wrong name stated as certain", score.rate(records, score.certain_and_wrong), 0.03),
        least("class first", score.rate(records, score.in_class)),
        least("nothing", score.rate(records, score.silent)),
    ]


def nothing(records: Sequence[Record]) -> list[Figure]:
    return [
        most("false alarms", score.rate(records, lambda r: bool(score.named(r)) or "error" in r), 0.005),
        most("unexplained", score.rate(records, lambda r: r.get("verdict") == "unexplained"), 0.005),
    ]


def pairs(records: Sequence[Record]) -> list[Figure]:
    spare = sum(map(score.extra, records)) / max(len(records), 1)
    return [
        least("both named", score.rate(records, score.both), 0.92),
        least("both named, or what fits as well with as few causes and numbers", score.rate(records, score.both_or_as_well)),
        Figure("names beyond the two, per answer", "names", spare),
    ]


def unknown(records: Sequence[Record]) -> list[Figure]:
    def honest(r: Record) -> bool:
        return r.get("verdict") in ("unexplained",) or (r.get("verdict") in score.NAMED and score.flagged(r))

    def confident(r: Record) -> bool:
        return r.get("verdict") == "causes" and bool(r["causes"]) and not score.flagged(r)

    # Where what was named fits the noiseless data as well as the truth does, these data hold nothing against it.
    equal = sum(r["stands"] for r in records)
    records = [r for r in records if not r["stands"]]
    return [
        Figure("answers that fit as well as the truth, not counted below", "cases", equal),
        least("unexplained, or flagged as inadequate", score.rate(records, honest), 0.97),
        most("a confident wrong name", score.rate(records, confident), 0.02),
    ]


def dirty(records: Sequence[Record]) -> list[Figure]:
    soiled, clean = [r for r in records if r["dirt"]], [r for r in records if not r["dirt"]]
    a, b = score.rate(soiled, score.in_class), score.rate(clean, score.in_class)
    return [
        least("class first, dirty", a),
        least("class first, the same logs clean", b),
        Figure("lost to dirt", "share", b.share - a.share, goal=0.03),
    ]


def joints(records: Sequence[Record]) -> list[Figure]:
    out = []
    for plant in sorted({r["plant"] for r in records}):
        some = [r for r in records if r["plant"] == plant]
        out.append(least(f"{plant}: right joint and cause", score.rate(some, score.in_class), 0.9))
    return out


def experiments(records: Sequence[Record]) -> list[Figure]:
    asked = [r for r in records if "designed" in r and score.open_question(r)]
    resolved = score.rate(asked, score.resolved)
    pairs = [p for r in asked for p in r["apart"] if p["promised"] > 0.03]
    kept = score.rate(pairs, lambda p: abs(p["found"] / p["promised"] - 1) <= 0.3)
    return [
        least(f"resolved by the proposed experiment ({len(asked)})", resolved, 0.9),
        least("within the range of the recording, to 2 %", score.rate(asked, lambda r: r["beyond"] <= 0.02), 1.0),
        least(f"separation within 30 % of what was promised, of pairs ({len(pairs)})", kept, 0.9),
        Figure("separation found over promised, median", "share", score.median([p["found"] / p["promised"] for p in pairs])),
    ]


def engines(records: Sequence[Record]) -> list[Figure]:
    out = [least("class first", score.rate(records, score.in_class), 0.95)]
    for engine in sorted({r["engine"] for r in records}):
        some = [r for r in records if r["engine"] == engine]
        out.append(least(f"class first, {engine}", score.rate(some, score.in_class)))
    return out


def plain(records: Sequence[Record]) -> list[Figure]:
    clear = [r for r in records if r["label"] == "clear"]
    lone, loops = [r for r in clear if score.alone(r)], [r for r in clear if r["excitation"].startswith("feedback")]
    return [
        least(f"exact name and site first, class of one ({len(lone)})", score.rate(lone, score.exact), 0.95),
        least(f"class first, all ({len(clear)})", score.rate(clear, score.in_class), 0.98),
        least(f"class first, under feedback ({len(loops)})", score.rate(loops, score.in_class), 0.93),
        most("a wrong name stated as certain", score.rate(clear, score.certain_and_wrong), 0.01),
        Figure("median error of the numbers of right answers", "share", score.median(score.sizes(clear)), goal=0.02),
        Figure("CPU time, median", "s", score.median([r["cpu"] for r in records])),
    ]


def looped(records: Sequence[Record]) -> list[Figure]:
    hidden, still = ([r for r in records if bool(r["hidden"]) is some] for some in (True, False))
    clear = [r for r in hidden if r["label"] == "clear"]
    return [
        least(f"class first ({len(clear)})", score.rate(clear, score.in_class), 0.93),
        most("a wrong name stated as certain", score.rate(clear, score.certain_and_wrong), 0.01),
        most(f"false alarms, nothing hidden ({len(still)})", score.rate(still, lambda r: bool(score.named(r))), 0.005),
    ]


def outputs(records: Sequence[Record]) -> list[Figure]:
    loud = [r for r in records if "error" not in r]
    return [
        most("nothing, where an output is misfitted", score.rate(loud, score.silent), 0.0),
        least(
            "unexplained, or with causes that are flagged", score.rate(loud, lambda r: score.flagged(r) or not score.named(r))
        ),
        Figure("CPU time, median", "s", score.median([r["cpu"] for r in records])),
    ]


def gears(records: Sequence[Record]) -> list[Figure]:
    played, still = ([r for r in records if bool(r["hidden"]) is some] for some in (True, False))
    sizes = score.sizes(played)
    return [
        least(f"play first ({len(played)})", score.rate(played, score.in_class), 0.95),
        most("a wrong name stated as certain", score.rate(played, score.certain_and_wrong), 0.01),
        Figure("median error of the shift", "share", score.median(sizes), goal=0.05),
        most(f"false alarms, no play ({len(still)})", score.rate(still, lambda r: bool(score.named(r))), 0.005),
        Figure("CPU time, median", "s", score.median([r["cpu"] for r in records])),
    ]


def _dirty(seed: int, index: int, limit: float) -> Record:
    """Even cases are clean, odd ones are the case before, soiled."""
    from exams.hidden.log import DIRT

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
    "engines": Part(128, 4, lambda s, i, t: sit.sit(draw.on_engine("engines", s, i), t), engines),
    "experiments": Part(120, 2, play.experiment, experiments),
    "plain": Part(400, 20, lambda s, i, t: plants.ask(plants.single("plain", s, i), t), plain),
    "plain-nothing": Part(600, 9, lambda s, i, t: plants.ask(plants.nothing("plain-nothing", s, i), t), nothing),
    "plain-pairs": Part(140, 4, lambda s, i, t: plants.ask(plants.pair("plain-pairs", s, i), t), pairs),
    "plain-loops": Part(125, 5, lambda s, i, t: plants.ask(plants.looped("plain-loops", s, i), t), looped),
    "plain-unknown": Part(150, 4, lambda s, i, t: plants.unknown("plain-unknown", s, i, t), unknown),
    "outputs": Part(600, 11, lambda s, i, t: misfits.ask("outputs", s, i, t, True), outputs),
    "outputs-nothing": Part(120, 6, lambda s, i, t: misfits.ask("outputs-nothing", s, i, t, False), nothing),
    "gears": Part(64, 4, lambda s, i, t: toothed.ask("gears", s, i, t), gears),
    "joints": Part(
        72, 2, lambda s, i, t: sit.sit(draw.single("joints", s, i, (("arm",), ("cartpole",), ("chain",))[i % 3]), t), joints
    ),
}
