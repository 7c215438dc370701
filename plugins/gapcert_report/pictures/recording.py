"""Pictures of a calibration on a recording."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert_figures import RecordedFigure, Stretch
from gapcert_report.words.words import number

from .svg import FAINT, GOOD, TRUTH, WITH, Picture, draw, figure_of, scaled

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def recorded_pictures(f: RecordedFigure) -> list[Picture]:
    """The scores, and per state the stretch that set the band."""
    return [_scores(f), *(_stretch(f, i, s) for i, s in enumerate(f.stretches))]


def _scores(f: RecordedFigure) -> Picture:
    n, rank = len(f.scores), f.rank

    def on(ax: Axes) -> None:
        ax.plot(np.arange(1, n + 1), f.scores, ".", ms=5, color=WITH, label="held windows")
        ax.plot(rank, f.scores[rank - 1], "o", ms=9, mfc="none", mew=1.8, color=GOOD, label=f"rank {rank}: sets the band")
        ax.axhline(0, color=FAINT, ls="--", lw=1, label="the band of the fit")
        ax.set(xlabel="window, from the best to the worst", ylabel="score")
        figure_of(ax).legend(loc="outside upper center", ncols=3, handlelength=1.2)

    what = "by how many scales the worst transition of a window leaves the band that was fitted"
    return draw("scores", "Scores of the held windows", f"A score says {what}; {n:,} windows that the fit has not seen.", on)


def _stretch(f: RecordedFigure, i: int, s: Stretch) -> Picture:
    unit, label = scaled(s.unit, s.low, s.high)

    def on(ax: Axes) -> None:
        ax.fill_between(s.t, s.low / unit, s.high / unit, color=WITH, alpha=0.4, lw=0, label="[l, u]")
        ax.plot(s.t, s.residual / unit, ".-", ms=3, lw=0.9, color=TRUTH, label="x⁺ − f")
        ax.set(xlabel=f"time since {f.at:.6g} s [s]", ylabel=f"gap of {s.state} [{label}]")
        figure_of(ax).legend(loc="outside upper center", ncols=2, handlelength=1.2)

    room, width = float(np.min(np.minimum(s.residual - s.low, s.high - s.residual))), float(np.max(s.high - s.low))
    left = f"the least that is left is {number(room, 3)} {s.unit}" if room > 1e-6 * width else "it touches its band"
    caption = f"{s.state} in the window whose score set the band; {left}."
    return draw(f"stretch{i}", f"Gap of {s.state} as it was measured", caption, on, link="stretch")
