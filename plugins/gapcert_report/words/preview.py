"""What a log could show, in words and rows, from the JSON of a preview."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence

from gapcert.plugin import columns
from gapcert_figures import called, spoken

from .diagnosis import least_size, measured
from .words import Summary, listed, number

MOST_ROWS = 100  # on a terminal, before each effect has one row for all of its sites


def of_what(entry: Summary) -> str:
    """`1.2 %`: how large a size is beside what is there; `–` where there is nothing."""
    return "–" if entry["share"] is None else f"{100 * entry['share']:.2g} %"


def beside(entry: Summary) -> float:
    """The share as a number, infinite where there is nothing."""
    return math.inf if entry["share"] is None else float(entry["share"])


def in_words(found: Summary) -> list[str]:
    """For the terminal."""
    if told := found.get("instead"):
        return [f"{told[:1].upper()}{told[1:]}."]
    head = ("effect", "site", "its", "would be seen from", "share")
    seen = found["seen"]
    rows = list(_together(seen)) if len(seen) > MOST_ROWS else [_row(s, s["site"], least_size(s)) for s in seen]
    lines = [
        "what this log could show, were noise alone left of it (share: of the effort, of an output's deviation,",
        "or of a stated value):",
        *(f"  {line}" for line in columns(head, rows)),
        "",
    ]
    return lines + [f"- {text}" for text in sentences(found)]


def _row(entry: Summary, site: str, text: str) -> tuple[str, ...]:
    return entry["effect"], site, entry["parameter"].replace("_", " "), text, of_what(entry)


def _together(seen: Sequence[Summary]) -> Iterator[tuple[str, ...]]:
    """One row for an effect at all of its sites."""
    for _, group in itertools.groupby(sorted(seen, key=lambda s: s["effect"]), key=lambda s: s["effect"]):
        some = sorted(group, key=beside)
        least, most = some[0], some[-1]
        if least is most:
            yield _row(least, least["site"], least_size(least))
        else:
            text = f"{least_size(least)} ({least['site']}) to {least_size(most)} ({most['site']})"
            yield _row(least, f"{len(some)} sites", text)


def sentences(found: Summary) -> list[str]:
    """What is left of the channels, what is not excited, what looks alike, what is under feedback."""
    out = []
    for name, c in found["channels"].items():
        floor = f"the noise floor of {name} is {measured(number(c['noise_floor'], 2), c['unit'])}"
        share = 100 * c["noise_floor"] / c["deviation"]
        out.append(f"{floor}, {share:.2g} % of its deviation; before any search the model leaves {c['left']:.3g} noise floors")
    out += found["unexcited"]
    faint = [s for s in found["seen"] if beside(s) > 1 and s["effect"] != "parameter"]
    for head, some in (
        ("no size that is searched would be seen of", found["unseen"]),
        ("what would be seen only if it were more than all that acts there is", faint),
    ):
        for site, group in itertools.groupby(sorted(some, key=lambda e: e["site"]), key=lambda e: e["site"]):
            out.append(f"at {site}, {head} {listed([spoken(e['effect']) for e in group])}")
    if found["alike"]:
        groups = [listed([called(e["effect"], e["site"]) for e in group]) for group in found["alike"]]
        out.append(f"this log does not tell apart, where they are small: {'; '.join(groups)}")
    return [*out, *(one["sentence"] for one in found["feedback"])]
