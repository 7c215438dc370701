"""Pictures over the first two states: where a controller may start, what it promises there, and runs on their way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from gapcert_figures import Axis, LoopFigure, WinningFigure, held

from .svg import BAD, CARD, GOOD, INK, ROLES, Picture, classes, draw, heat, name_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.patches import Patch

_TITLES = {"stay": "to stay in", "region": "named region"}
PLANE = "plane"  # pictures with one cursor
FIRST = 60  # steps of runs that lead nowhere
_SIMILAR = 2.5  # ranges of one unit that differ by less are drawn to scale


def _to_scale(axes: tuple[Axis, ...]) -> bool:
    spans = [a.high - a.low for a in axes[:2]]
    return axes[0].unit == axes[1].unit and max(spans) < _SIMILAR * min(spans)


def plane_height(axes: tuple[Axis, ...]) -> float:
    return min(5.0, 0.6 + 3.6 * (axes[1].high - axes[1].low) / (axes[0].high - axes[0].low)) if _to_scale(axes) else 3.3


def goal_parts(ax: Axes, w: WinningFigure, cut: bool) -> list[Any]:
    """The parts of the goal, as the plane cuts them or as shadows, and the legend's entries for them."""
    from matplotlib.patches import Polygon

    shown = [o for o in w.outlines if (o.cut if cut else o.where != "section")]
    for o in shown:
        colour, line = ROLES[o.role], ":" if o.dotted else "-"
        if o.role in ("target", "region") and not o.dotted:
            ax.add_patch(Polygon(o.points, fill=False, ec=CARD, lw=3.5, zorder=4))
        ax.add_patch(Polygon(o.points, fill=False, ec=colour, lw=1.5, ls=line, clip_on=False, zorder=4))
        if o.role != "stay" and not o.dotted:
            ax.add_patch(Polygon(o.points, fc=colour, alpha=0.45 if o.role == "avoid" else 0.25, lw=0, zorder=3))
    for name in dict.fromkeys(o.name for o in shown if o.name):
        largest = max((o for o in shown if o.name == name), key=lambda o: float(np.ptp(o.points, axis=0).prod()))
        x, y = largest.points.mean(axis=0)
        box = {"boxstyle": "round,pad=0.2", "fc": CARD, "ec": GOOD, "lw": 0.8}
        ax.text(x, y, name, color=INK, ha="center", va="center", fontsize=8.5, bbox=box, zorder=6)
    name_axes(ax, w.axes)
    ax.locator_params(axis="x", nbins=6)
    margin = [0.04 * (a.high - a.low) for a in w.axes[:2]]
    ax.set(
        xlim=(w.axes[0].low - margin[0], w.axes[0].high + margin[0]),
        ylim=(w.axes[1].low - margin[1], w.axes[1].high + margin[1]),
    )
    if _to_scale(w.axes):
        ax.set_aspect("equal")
    return [_part(*part) for part in dict.fromkeys((o.role, o.dotted) for o in shown)]


def _part(role: str, dotted: bool) -> Patch:
    """A part of the goal in the legend."""
    from matplotlib.colors import to_rgba
    from matplotlib.patches import Patch

    name, colour = _TITLES.get(role, role), ROLES[role]
    if dotted or role == "stay":
        return Patch(
            fc=to_rgba(colour, 0.0), ec=colour, ls=":" if dotted else "-", label=f"{name}, elsewhere" if dotted else name
        )
    return Patch(fc=colour, ec=colour, ls="-", alpha=0.55, label=name)


def _dotted(w: WinningFigure, cut: bool) -> str:
    shown = any(o.dotted and (o.cut or not cut) for o in w.outlines)
    others = ", ".join(a.name for a in w.axes[2:])
    return (f" Dotted: not at {w.fixed}." if cut else f" Dotted: at some values of {others} alone.") if shown else ""


def winning_picture(w: WinningFigure) -> Picture:
    """Where each controller may start."""
    areas, (first, second) = w.areas, w.labels

    def on(ax: Axes) -> list[Any]:
        shown = classes(ax, w.axes, [(mask, ROLES[role], name, 1.0) for role, name, mask in areas])
        return [*shown, *goal_parts(ax, w, True)]

    shares = f"{w.with_gamma.mean():.1%} {first}, {w.without_gamma.mean():.1%} {second}"
    caption = f"Share of the set{held(w.fixed)} from which the goal can be kept: {shares}."
    if areas[1][2].any() and first == "with γ":
        caption += " The band [l, u] is signed: where the simulator errs to the safe side, knowing it wins states."
    caption = caption.replace("%", " %") + _dotted(w, True)
    return draw("winning", "Where the controller may start", caption, on, plane_height(w.axes), PLANE)


_NEXT = {"recurrence": "the target is met next", "automaton": "the automaton comes next to a state that it accepts"}


def value_picture(w: WinningFigure) -> Picture:
    """What is promised of the time that the goal takes."""

    def on(ax: Axes) -> list[Any]:
        heat(ax, w.axes, w.values, float(np.nanmax(w.values)), "steps", "bottom")
        return goal_parts(ax, w, True)

    where = f"{w.labels[0]}, at {w.fixed}" if w.fixed else w.labels[0]
    comes = _NEXT.get(w.goal, "the goal is reached")
    caption = f"In at most so many steps {comes}, {where}; no colour: not for certain.{_dotted(w, True)}"
    return draw("values", "How long it takes", caption, on, plane_height(w.axes) + 0.7, PLANE)


def runs_picture(loop: LoopFigure, w: WinningFigure) -> Picture:
    """Runs on the simulator among the parts of the goal; where it leads nowhere, their first steps: more hide each other."""
    leads = any(o.role in ("target", "region") for o in w.outlines)
    most = loop.runs[0].steps if leads else min(loop.runs[0].steps, FIRST)

    def on(ax: Axes) -> list[Any]:
        handles = goal_parts(ax, w, False)
        for runs in loop.runs:
            wide, alpha = (1.1, 1.0) if runs.gamma else (4.0, 0.4)
            style: Any = {"color": ROLES[runs.name], "label": runs.name, "lw": wide, "alpha": alpha, "zorder": 5}
            for trace, end in zip(runs.traces, runs.ended, strict=True):
                seen = trace[: most + 1]
                for piece in loop.pieces(seen):
                    (line,) = ax.plot(piece[:, 0], piece[:, 1], **style)
                ax.plot(seen[0, 0], seen[0, 1], "o", mfc=CARD, mec=INK, ms=4.5, mew=1, zorder=7)
                last = int(np.isfinite(trace).all(axis=1).sum()) - 1
                if 0 <= end <= most:
                    ax.plot(*trace[int(end), :2], "x", color=BAD, ms=7, mew=2, zorder=8)
                elif end < 0 and last < runs.steps:
                    ax.plot(*trace[last, :2], "o", color=GOOD, ms=5, zorder=8)
            handles.append(line)
        return handles

    first = f"The first {most} steps of " if most < loop.runs[0].steps else ""
    over = f"{w.axes[0].name} and {w.axes[1].name}"
    caption = f"{first}{len(loop.runs[0].traces)} runs on the simulator over {over}. Circles: starts; "
    caption += ("green dots: the goal is reached; " if leads else "") + "crosses: violations." + _dotted(w, False)
    return draw("plane", "Runs on their way", caption, on, plane_height(w.axes), PLANE)
