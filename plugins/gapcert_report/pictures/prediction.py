"""What a controller foresaw of one run, and what came of it: over time, and over the first two states."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert.plugin import Array, times
from gapcert_closed_loop import Ahead
from gapcert_figures import LoopFigure, WinningFigure
from gapcert_report.words.words import number

from .plane import goal_parts, plane_height
from .svg import BAD, CARD, INK, TRUTH, WITH, Picture, axis_label, draw, figure_of, scaled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOOP = "closed loop"  # pictures with one cursor
BOXES = 12  # of a tube that are drawn over two states
SEEN = 0.02  # of a picture: what is narrower is a line


def foresight_pictures(loop: LoopFigure, winning: WinningFigure | None) -> list[Picture]:
    """The first shows whether each step ended in the box that was foreseen for it. None where nothing is foreseen."""
    if not loop.foreseen:
        return []
    ahead = [] if loop.ahead is None else [_one_step(loop, loop.ahead)]
    over_time = [*ahead, _over_time(loop, _widest(loop))]
    return over_time if winning is None or _thin(loop) else [*over_time, _in_the_plane(loop, winning)]


def _trace(loop: LoopFigure) -> Array:
    """The run that was foreseen, as far as the last tube reaches."""
    last = loop.foreseen[-1]
    whole: Array = next(runs.traces[0] for runs in loop.runs if runs.gamma)[: last.step + len(last.low)]
    return whole[np.isfinite(whole).all(axis=1)]


def _widths(loop: LoopFigure) -> Array:
    """(nx,): the widest box of all tubes."""
    return np.asarray(np.stack([(f.high - f.low).max(axis=0) for f in loop.foreseen]).max(axis=0))


def _widest(loop: LoopFigure) -> int:
    """The state whose tube is widest, as a share of where it may be."""
    return int(np.argmax(_widths(loop) / np.ptp(loop.stay, axis=1)))


def _thin(loop: LoopFigure) -> bool:
    """Are the boxes too small to be seen beside the run, over the first two states?"""
    return bool((_widths(loop)[:2] < SEEN * np.ptp(_trace(loop)[:, :2], axis=0)).all())


def _one_step(loop: LoopFigure, ahead: Ahead) -> Picture:
    """Of the state that came nearest to an end of its boxes."""
    half = np.maximum(np.maximum(ahead.high, -ahead.low).max(axis=0), 1e-300)
    i = int(np.argmax(np.abs(ahead.error).max(axis=0) / half))
    axis = loop.axes[i]
    unit, label = scaled(axis.unit, ahead.low[:, i], ahead.high[:, i], ahead.error[:, i])

    def on(ax: Axes) -> None:
        t = (1 + np.arange(len(ahead.error))) * loop.period
        ax.fill_between(t, ahead.low[:, i] / unit, ahead.high[:, i] / unit, color=WITH, alpha=0.25, lw=0.8, label="foreseen")
        ax.plot(t, ahead.error[:, i] / unit, color=TRUTH, lw=1.1, label="simulator")
        if (out := ~ahead.kept).any():
            ax.plot(t[out], ahead.error[out, i] / unit, "x", color=BAD, ms=6, mew=1.8, label="outside")
        ax.set(xlabel="time [s]", ylabel=f"{axis.name} − plan" + (f" [{label}]" if label not in ("", "1") else ""))
        figure_of(ax).legend(loc="outside upper center", ncols=3, handlelength=1.4)

    inside, of = int(ahead.kept.sum()), len(ahead.kept)
    told = "All" if inside == of else f"{inside:,}"
    caption = (
        f"At each step of one run, how far from its plan {axis.name} may be a step later, and where it then was. {told} of the "
        f"{of:,} next states lie in their box."
    )
    return draw("ahead", f"{axis.name} one step ahead", caption, on, link=LOOP)


def _over_time(loop: LoopFigure, i: int) -> Picture:
    axis, trace = loop.axes[i], _trace(loop)

    def on(ax: Axes) -> None:
        for k, f in enumerate(loop.foreseen):
            t, label = (f.step + np.arange(len(f.low))) * loop.period, k == 0
            ax.fill_between(t, f.low[:, i], f.high[:, i], color=WITH, alpha=0.25, lw=0.8, label="foreseen" if label else None)
            ax.plot(t, f.centre[:, i], color=WITH, lw=1, ls="--", label="its centre" if label else None)
            ax.plot(t[0], f.centre[0, i], "o", mfc=CARD, mec=INK, ms=4.5, mew=1, zorder=5)
        for piece, start in _pieces(trace[:, i], axis.angle):
            ax.plot(
                (start + np.arange(len(piece))) * loop.period, piece, color=TRUTH, lw=1.3, label=None if start else "simulator"
            )
        low, high = ax.get_ylim()
        for limit in loop.stay[i]:
            if low - 0.3 * (high - low) <= limit <= high + 0.3 * (high - low):
                ax.axhline(limit, color=BAD, ls="--", lw=1.2)
        ax.set(xlabel="time [s]", ylabel=axis_label(axis))
        figure_of(ax).legend(loc="outside upper center", ncols=3, handlelength=1.4)

    moments = times(len(loop.foreseen), "moment")
    wide = _widths(loop)[i] / 2
    thin = (
        ""
        if wide > SEEN / 2 * np.ptp(loop.stay[i])
        else f" Its tube is ± {number(wide, 2)} at its widest: a line in this picture."
    )
    caption = (
        f"Where the controller with γ says at {moments} that {axis.name} of one run will be if it keeps to its plan, whatever "
        f"the gap does. It plans again at each step.{thin}"
    )
    return draw("foreseen", f"{axis.name} as it is foreseen", caption, on, link=LOOP)


def _pieces(values: Array, angle: bool) -> list[tuple[Array, int]]:
    """Cut where an angle comes round, with the index at which each piece begins."""
    cuts = (np.flatnonzero(angle & (np.abs(np.diff(values)) > np.pi)) + 1).tolist()
    return list(zip(np.split(values, cuts), [0, *cuts], strict=True))


def _in_the_plane(loop: LoopFigure, w: WinningFigure) -> Picture:
    trace = _trace(loop)
    ends = np.concatenate([trace, *(f.low for f in loop.foreseen), *(f.high for f in loop.foreseen)])[:, :2]
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = np.maximum(0.1 * (high - low), 1e-3 * np.ptp(loop.stay[:2], axis=1))

    def on(ax: Axes) -> None:
        from matplotlib.patches import Patch, Rectangle

        handles = goal_parts(ax, w, False)
        for part in (*ax.patches, *ax.texts):
            part.set_clip_on(True)
        for f in loop.foreseen:
            # The last box is always drawn.
            for a, b in list(zip(f.low[:, :2], f.high[:, :2], strict=True))[:: -max(1, len(f.low) // BOXES)]:
                ax.add_patch(Rectangle((a[0], a[1]), *(b - a), fc=WITH, ec="none", alpha=0.06, zorder=5))
                ax.add_patch(Rectangle((a[0], a[1]), *(b - a), fill=False, ec=WITH, alpha=0.6, lw=0.8, zorder=5))
            ax.plot(f.centre[0, 0], f.centre[0, 1], "o", mfc=CARD, mec=INK, ms=4.5, mew=1, zorder=7)
        handles.append(Patch(fc=WITH, ec=WITH, alpha=0.4, label="foreseen"))
        for piece in loop.pieces(trace):
            (line,) = ax.plot(piece[:, 0], piece[:, 1], color=TRUTH, lw=1.2, label="simulator", zorder=6)
        ax.set(xlim=(low[0] - margin[0], high[0] + margin[0]), ylim=(low[1] - margin[1], high[1] + margin[1]), aspect="auto")
        figure_of(ax).legend(handles=[*handles, line], loc="outside upper center", ncols=3, handlelength=1.2)

    over = f"{w.axes[0].name} and {w.axes[1].name}"
    caption = f"The same over {over}, boxes of some steps. Circles: where the controller looked ahead."
    return draw("foreseen-plane", "A run in its tubes", caption, on, plane_height(w.axes))
