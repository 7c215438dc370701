"""How wrong a model is: maps of the gap beside γ, residuals in their bands, and the windows of a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gapcert.plugin import Array
from gapcert_figures import Band, GapFigure, RecordedFigure, Slice, Stretch, held
from gapcert_report.words.words import number

from .svg import BAD, FAINT, GOOD, TRUTH, WITH, Paint, Picture, draw, heat, scaled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_BANDS = 12  # beside those that lead: more make a page that nobody scrolls through
GAP = "gap"  # pictures with one cursor
_HOLLOW: dict[str, Any] = {"facecolor": "none", "edgecolor": FAINT, "lw": 0.8}  # no bound, and nothing like one


def slice_pictures(gap: GapFigure, refuted: bool = False) -> list[Picture]:
    """Per state the true gap and γ over the first two axes, on one colour scale."""
    called = "Refuted" if refuted else "Certified"
    at, dots = held(gap.fixed), len(gap.samples) <= 2000
    sampled = f"; dots: the {len(gap.samples):,} sampled points, projected" if dots else ""

    def paint(s: Slice, values: Array, symbol: str, dots: bool) -> Paint:
        unit, label = scaled(s.unit, s.gamma, s.gap)
        top = float(np.nanmax([s.gamma, s.gap])) / unit

        def on(ax: Axes) -> None:
            heat(ax, gap.axes, values / unit, top, f"{symbol} [{label}]")
            if dots:
                ax.scatter(gap.samples[:, 0], gap.samples[:, 1], s=7, c="white", edgecolors="black", linewidths=0.5, zorder=3)

        return on

    pictures = []
    for i, s in enumerate(gap.slices):
        truth, bound = f"|f̂ − f| of {s.state}{at}, evaluated afresh.", f"γ of {s.state}{at}, on the same colours{sampled}."
        pictures += [
            draw(f"gap{i}", f"True gap of {s.state}", truth, paint(s, s.gap, "|r|", False), link=GAP),
            draw(f"gamma{i}", f"{called} bound γ of {s.state}", bound, paint(s, s.gamma, "γ", dots), link=GAP),
        ]
    return pictures


def band_pictures(gap: GapFigure, refuted: bool = False) -> tuple[list[Picture], list[Picture]]:
    """The residual in its band: the one that leads for each state, and the others. A refuted band is hatched, not filled."""
    leads = gap.leads.values()
    others = [i for i in range(len(gap.bands)) if i not in leads][:MOST_BANDS]
    first, rest = ([_band(f"band{i}", gap.bands[i], refuted) for i in part] for part in (leads, others))
    return first, rest


def _band(key: str, b: Band, refuted: bool) -> Picture:
    unit, label = scaled(b.unit, b.gamma, np.asarray(b.constant))

    def on(ax: Axes) -> None:
        for low, high, alpha, hatch, name in ((-b.gamma, b.gamma, 0.16, "", "±γ"), (b.low, b.high, 0.55, "////", "[l, u]")):
            hollow = {**_HOLLOW, "hatch": hatch, "label": f"{name}, refuted"}
            shown = hollow if refuted else {"color": WITH, "alpha": alpha, "label": name, "lw": 0}
            if (some := low <= high).any():
                ax.fill_between(b.at, low / unit, high / unit, where=some, **shown)
        if b.empty.any():
            crossed = {**_HOLLOW, "edgecolor": BAD, "hatch": "xxxx", "label": "no band: l above u"}
            ax.fill_between(b.at, b.high / unit, b.low / unit, where=b.empty, **crossed)
        ax.plot(b.at, b.residual / unit, color=TRUTH, lw=1.1, label="f̂ − f")
        for sign in (-1, 1):
            ax.axhline(sign * b.constant / unit, color=FAINT, ls="--", lw=1, label="constant bound")
        ax.set(xlabel=b.axis.label, ylabel=f"gap of {b.state} [{label}]", xlim=(b.axis.low, b.axis.high))
        ax.set_ylim(-1.15 * b.constant / unit, 1.15 * b.constant / unit)

    where, band = "stays inside" if b.inside else "leaves", "refuted" if refuted else "certified"
    caption = f"Along {b.axis.name} through the middle of the domain: f̂ − f of {b.state} {where} its {band} band."
    if b.empty.any():
        caption += f" Over {100 * b.empty.mean():.2g} % of the way no value is left in it: its ends have crossed."
    return draw(key, f"Gap of {b.state} along {b.axis.name}", caption, on, link=f"along {b.axis.name}")


def recorded_pictures(f: RecordedFigure) -> list[Picture]:
    """Of a calibration on a recording: the scores, and per state the stretch that set the band."""
    return [_scores(f), *(_stretch(f, i, s) for i, s in enumerate(f.stretches))]


def _scores(f: RecordedFigure) -> Picture:
    n, rank = len(f.scores), f.rank

    def on(ax: Axes) -> None:
        ax.plot(np.arange(1, n + 1), f.scores, ".", ms=5, color=WITH, label="held windows")
        ax.plot(rank, f.scores[rank - 1], "o", ms=9, mfc="none", mew=1.8, color=GOOD, label=f"rank {rank}: sets the band")
        ax.axhline(0, color=FAINT, ls="--", lw=1, label="the band of the fit")
        ax.set(xlabel="window, from the best to the worst", ylabel="score")

    what = "by how many scales the worst transition of a window leaves the band that was fitted"
    return draw("scores", "Scores of the held windows", f"A score says {what}; {n:,} windows that the fit has not seen.", on)


def _stretch(f: RecordedFigure, i: int, s: Stretch) -> Picture:
    unit, label = scaled(s.unit, s.low, s.high)

    def on(ax: Axes) -> None:
        ax.fill_between(s.t, s.low / unit, s.high / unit, color=WITH, alpha=0.4, lw=0, label="[l, u]")
        ax.plot(s.t, s.residual / unit, ".-", ms=3, lw=0.9, color=TRUTH, label="x⁺ − f")
        ax.set(xlabel=f"time since {f.at:.6g} s [s]", ylabel=f"gap of {s.state} [{label}]")

    room, width = float(np.min(np.minimum(s.residual - s.low, s.high - s.residual))), float(np.max(s.high - s.low))
    left = f"the least that is left is {number(room, 3)} {s.unit}" if room > 1e-6 * width else "it touches its band"
    caption = f"{s.state} in the window whose score set the band; {left}."
    return draw(f"stretch{i}", f"Gap of {s.state} as it was measured", caption, on, link="stretch")
