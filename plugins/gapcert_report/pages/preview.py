"""What a log could show, as part of its page: a picture of sizes, a table, and sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from gapcert_figures import called
from gapcert_report.pictures.svg import FAINT, WITH, Picture, draw
from gapcert_report.words.diagnosis import least_size
from gapcert_report.words.preview import beside, of_what, sentences
from gapcert_report.words.words import Summary

from .html import Html, folded, gallery, h, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_BARS = 30  # of one picture: more rows are no longer read
ROW = 0.24  # inches


def could_show(found: Summary) -> Iterator[Html | None]:
    """Its section."""
    yield h("h2", "What this log could show")
    if told := found.get("instead"):
        yield h("p", f"{told[:1].upper()}{told[1:]}.")
        return
    seen = sorted(found["seen"], key=lambda s: (s["site"], beside(s)))
    rows = [(called(s["effect"], s["site"]), s["parameter"].replace("_", " "), least_size(s), of_what(s)) for s in seen]
    head = ("effect", "parameter", "would be seen from", "share")
    drawn = [s for s in seen if s["share"] is not None]
    yield gallery([_sizes(i, drawn[i : i + MOST_BARS]) for i in range(0, len(drawn), MOST_BARS)])
    yield folded(f"All {len(rows)}", table("The smallest size of each effect that would be seen", head, rows, 2))
    yield h("ul", *(h("li", f"{text[:1].upper()}{text[1:]}.") for text in sentences(found)))


def _sizes(i: int, seen: Sequence[Summary]) -> Picture:
    def on(ax: Axes) -> None:
        least, most = (f(s["share"] for s in seen) for f in (min, max))
        for k, s in enumerate(seen):
            ax.plot([least / 2, s["share"]], [k, k], color=FAINT, linewidth=0.5)
            ax.plot(s["share"], k, "o", ms=4, color=WITH)
            named = f"{called(s['effect'], s['site'])}: {least_size(s)}"
            ax.text(least / 2, k - 0.12, named.replace("$", r"\$"), fontsize=8.5, va="bottom", clip_on=False)
        ax.set(xscale="log", ylim=(len(seen) - 0.5, -0.9), xlim=(least / 2, most * 2), xlabel="share", yticks=[])
        ax.spines["left"].set_visible(False)

    caption = (
        "From which size on each effect would be seen: as a share of the effort at its site, of the deviation of an output, "
        "or of a stated value; the smaller, the better this log shows it."
    )
    return draw(f"sizes{i}", "The smallest that would be seen", caption, on, ROW * len(seen) + 0.6)
