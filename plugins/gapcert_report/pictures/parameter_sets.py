"""What runs learned of a parameter, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert_closed_loop import Learned
from gapcert_figures import LoopFigure
from gapcert_report.words.words import between

from .prediction import LOOP
from .svg import TRUTH, WITH, Picture, draw, figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

THIN = 0.01  # of the first range


def learned_pictures(loop: LoopFigure) -> list[Picture]:
    """One per parameter; none where nothing is learned."""
    return [_over_time(loop.period, k, one) for k, one in enumerate(loop.learned)]


def _over_time(period: float, k: int, one: Learned) -> Picture:
    known = one.run[np.isfinite(one.run).all(axis=1)]
    wide = np.ptp(one.hull, axis=1)
    # What follows could not be told from a line.
    shown = min(len(wide), 2 + int(np.flatnonzero(wide > THIN * wide[0]).max(initial=4) * 1.25))
    t, hull, run = np.arange(shown) * period, one.hull[:shown], one.run[:shown]
    unit = "" if one.unit in ("", "1") else f" [{one.unit}]"

    def on(ax: Axes) -> None:
        ax.fill_between(t, hull[:, 0], hull[:, 1], step="post", color=WITH, alpha=0.2, lw=0, label="all runs")
        ax.fill_between(t, run[:, 0], run[:, 1], step="post", color=WITH, alpha=0.6, lw=0.8, label="one run")
        ax.axhline(one.stated, color=TRUTH, lw=1.2, ls="--", label="the model of γ")
        ax.set(xlabel="time [s]", ylabel=f"{one.name}{unit}", xlim=(0, t[-1]))
        figure_of(ax).legend(loc="outside upper center", ncols=3, handlelength=1.4)

    of = f" {one.unit}" if unit else ""
    caption = (
        f"What {one.name} may still be: {between(*known[0])}{of} when one run began, {between(*known[-1])}{of} when it ended. "
        f"Dashed: its value in the model that γ is about."
    )
    return draw(f"learned{k}", f"What is learned of {one.name}", caption, on, link=LOOP)
