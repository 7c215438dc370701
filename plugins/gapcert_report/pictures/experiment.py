"""What runs are drawn to where that moves, and how they follow."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert_figures import LoopFigure

from .prediction import LOOP
from .svg import TRUTH, WITH, Picture, axis_label, draw, figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def wanted_pictures(loop: LoopFigure) -> list[Picture]:
    """Of the state whose reference moves most, as a share of where it may be; none where nothing moves."""
    if not len(loop.wanted):
        return []
    moved = np.ptp(loop.wanted, axis=0) / np.ptp(loop.stay, axis=1)
    return [_over_time(loop, int(np.argmax(moved)))]


def _over_time(loop: LoopFigure, i: int) -> Picture:
    axis, runs = loop.axes[i], next(runs for runs in loop.runs if runs.gamma)

    def on(ax: Axes) -> None:
        for k, trace in enumerate(runs.traces[:, :, i]):
            ax.plot(np.arange(len(trace)) * loop.period, trace, color=WITH, lw=1, alpha=0.7, label="runs" if k == 0 else None)
        wanted = loop.wanted[:, i]
        ax.step(np.arange(len(wanted)) * loop.period, wanted, color=TRUTH, lw=1.2, ls="--", where="post", label="wanted")
        ax.set(xlabel="time [s]", ylabel=axis_label(axis))
        figure_of(ax).legend(loc="outside upper center", ncols=2, handlelength=1.4)

    caption = f"{axis.name} of some runs with γ, and what they are drawn to. That is no part of what is promised."
    return draw("wanted", f"{axis.name} and what is wanted of it", caption, on, link=LOOP)
