"""The sections of a comparison: who agrees with whom, what separates the others, and the matrix of certificates."""

from __future__ import annotations

from gapcert_figures import Figures
from gapcert_report.pictures import compare as pictures
from gapcert_report.pictures.svg import Picture
from gapcert_report.words.compare import apart, groups, made, setting_name, share
from gapcert_report.words.words import Summary, number

from .html import Html, h, section, table

OPEN = 3
"""Pairs whose pictures are seen at once; those of the others are folded."""


def tiles(summary: Summary) -> list[tuple[str, str, str, str]]:
    """(class, value, unit, what it is)."""
    found = [("", number(len(summary["backends"])), "", "simulators compared")]
    largest = max((len(g) for g in groups(summary)), default=0)
    if largest > 1:
        found.append(("with", number(largest), f"of {len(summary['backends'])}", "give one answer"))
    if summary["agree"]["max"] is not None:
        found.append(("", number(summary["agree"]["max"], 2), "", "largest difference between those that agree"))
    for p in apart(summary)[:1]:
        found.append(("without", share(p["relative"]), "", f"of a step: mean difference of {p['a']} and {p['b']}"))
        found += [("with", share(e["reduction"]), "of that", f"is {setting_name(e)}") for e in p["explained_by"][:1]]
    return found


def hero(summary: Summary, figures: Figures) -> list[Picture]:
    """The pictures that carry the answer."""
    first = next(iter(apart(summary)), None)
    found = [
        pictures.pair_matrix(summary),
        pictures.settings_picture("hero", first) if first else None,
        pictures.drift_picture(summary, figures.compare) if figures.compare else None,
    ]
    return [p for p in found if p is not None]


def differences(summary: Summary) -> Html | None:
    """All pairs as a table."""
    if not (rows := [_pair(p) for p in summary["pairs"]]):
        return None
    steps = "bits differ from", "beyond rounding from"
    head = ("pair", "agree", "largest in", "where", "mean", "largest", "share of a step", *steps)
    text = (
        "Every pair was asked for one step from the same points, and for runs under the same random inputs. Two agree "
        "where no more lies between them than the resolution of their arithmetic."
    )
    told = "After one step, in the unit of each state; the last columns are steps of a common run"
    return section("Which simulators differ?", h("p", text), table(told, head, rows, 4))


def _pair(p: Summary) -> tuple[object, ...]:
    name = f"{p['a']} – {p['b']}"
    if "refused" in p:
        return name, p["refused"], *["–"] * 7
    # Each equation stays in one line.
    where = ", ".join(f"{k} = {number(v, 3)}".replace(" ", "\u00a0") for k, v in p["where"].items()) if p["max"] else "–"
    step = p["first_differing_step"]
    same = h("b", "✗ no", class_="bad") if p["resolved"] else h("b", "✓ yes", class_="good")
    numbers = (p["mean"], p["max"])
    last = (number(step["bits"]), number(step["resolved"]))
    return name, same, p["state"] if p["max"] else "–", where, *map(number, numbers), share(p["relative"]), *last


def gallery_of(summary: Summary, figures: Figures) -> tuple[list[Picture], list[Picture]]:
    """Maps and bars of the pairs that differ: those seen at once, and those that are folded."""
    drawn = {(p.a, p.b): p for p in figures.compare.pairs} if figures.compare else {}
    seen: list[Picture] = []
    folded: list[Picture] = []
    for k, p in enumerate(apart(summary)):
        figure = drawn.get((p["a"], p["b"]))
        both = (pictures.where_picture(str(k), figure) if figure else None, pictures.settings_picture(str(k), p))
        (seen if k < OPEN else folded).extend(one for one in both if one is not None)
    return seen, folded


def causes(summary: Summary) -> Html | None:
    """Every verified change, best first."""
    rows = [
        (
            f"{p['a']} – {p['b']}",
            setting_name(e),
            "the simulator" if made(e) else "its equations",
            share(e["reduction"]),
            "yes" if e["closes"] else "no",
        )
        for p in apart(summary)
        for e in p["explained_by"]
    ]
    head = ("pair", "change", "made in", "of the mean difference gone", "within resolution")
    return table("Changes that were made and measured again on the same points", head, rows, 3)


def matrix(summary: Summary) -> Html | None:
    """The certificates, one row each."""
    states = list(dict.fromkeys(s for r in summary["rows"] for s in r.get("states", {})))
    head = ("backend", "family", "Lipschitz", "claim", "seed", *(f"tightness of {s}" for s in states))
    if not (rows := [_row(r, states) for r in summary["rows"]]):
        return None
    text = (
        "Tightness is mean γ over mean gap: 1 is the gap itself. A gap below ten resolutions has none. "
        "Samples are the transitions behind the bound and its constants."
    )
    head = (*head, "samples", "CPU seconds", "violations")
    shown = table("One certificate per row; violations are of fresh points", head, rows, 4)
    return section("How wrong is the model against each?", h("p", text), shown)


def _row(r: Summary, states: list[str]) -> tuple[object, ...]:
    if "refused" in r:
        return r["backend"], r["family"], r["lipschitz"], f"refused: {r['refused']}", r["seed"], *["–"] * (len(states) + 3)
    tight = (number(s["tightness"]) if (s := r["states"][n])["resolved"] else "not resolved" for n in states)
    rest = (number(r["samples"]), number(r["cpu_s"]), number(r["violations"]))
    return r["backend"], r["family"], r["lipschitz"], r["claim"], r["seed"], *tight, *rest


def unavailable(summary: Summary) -> Html | None:
    """Simulators that this machine lacks."""
    rows = [(u["backend"], u["reason"]) for u in summary["unavailable"]]
    return section("Not available here", table("Left out of the comparison", ("backend", "reason"), rows, 2))
