"""What a controller may promise: where it may start, and runs on the simulator, with what was foreseen, wanted and learned."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from gapcert.plugin import Array, times
from gapcert_closed_loop import Ahead, Learned
from gapcert_figures import Axis, Escape, Figures, LoopFigure, Runs, WinningFigure, held, labelled
from gapcert_report.words.words import between, number

from .svg import BAD, CARD, GOOD, INK, ROLES, TRUTH, WITH, WITHOUT, Picture, classes, draw, heat, name_axes, scaled

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


LOOP = "closed loop"  # pictures with one cursor
BOXES = 12  # of a tube that are drawn over two states
SEEN = 0.02  # of a picture: what is narrower is a line
THIN = 0.01  # of the first range


def escape_picture(e: Escape) -> Picture:
    """Where f expected one run without γ to be, and where it was; axes count from the former."""
    origin = [float(v) for v in e.expected]
    (ux, lx), (uy, ly) = (scaled(a.unit, np.asarray(a.high - a.low)) for a in e.axes)

    def on(ax: Axes) -> list[Any]:
        sides = zip(e.axes, origin, (ux, uy), strict=True)
        moved = [replace(a, low=(a.low - o) / u, high=(a.high - o) / u) for a, o, u in sides]
        can = classes(ax, moved, [(e.domain > 0, ROLES["only_without_gamma"], "can go on", 0.45)])
        points = [((p[0] - origin[0]) / ux, (p[1] - origin[1]) / uy) for p in (e.expected, e.actual)]
        ax.annotate("", points[1], points[0], arrowprops={"arrowstyle": "->", "color": INK, "lw": 1.4})
        ax.plot(*points[0], "o", color=WITHOUT, ms=9, label="expected by f")
        ax.plot(*points[1], "x", color=BAD, ms=11, mew=3, label="simulator")
        names = [f"{a.name} − expected" for a in e.axes]
        ax.set(xlabel=f"{names[0]} [{lx}]", ylabel=f"{names[1]} [{ly}]")
        return [*can, *ax.get_legend_handles_labels()[0]]

    where = " and ".join(f"{a.name} = {number(o)} {a.unit}".removesuffix(" 1") for a, o in zip(e.axes, origin, strict=True))
    caption = f"Step {e.step} of one run: f expects {where}, from where its controller can go on; the simulator ends outside."
    return draw("escape", "How a run without γ breaks", caption, on)


def survival_picture(loop: LoopFigure) -> Picture:
    """How many runs are still inside, over time."""

    def on(ax: Axes) -> list[Any]:
        last: list[int] = []
        for runs in loop.runs:
            t, alive, colour = np.arange(runs.steps + 1) * loop.period, runs.alive.tolist(), ROLES[runs.name]
            ax.step(t, alive, where="post", color=colour, lw=2.2, label=runs.name)
            text = f"{runs.name}: {alive[-1]} of {runs.starts}"
            near, low = [n for n in last if abs(n - alive[-1]) < 0.1 * runs.starts], alive[-1] < 0.12 * runs.starts
            offset = (18 if near else 5) if low else (-26 if near else -13)
            place: dict[str, Any] = {"xytext": (-3, offset), "textcoords": "offset points"}
            # The second of two that are close stands a line away from the first, wherever its own curve ends.
            beside = (max if low else min)(alive[-1], *near) if near else alive[-1]
            ax.annotate(text, (t[-1], beside), color=colour, ha="right", weight="bold", **place)
            last.append(alive[-1])
        top = max((r.starts for r in loop.runs), default=1)
        ax.locator_params(axis="y", integer=True)
        ax.set(xlabel="time [s]", ylabel="runs inside", ylim=(0, 1.04 * top), xlim=(0, None))
        return []  # each curve has its name beside it

    words = [f"{r.name} {int((r.broke >= 0).sum())} of {r.starts} break it" for r in loop.runs]
    caption = f"Runs that have kept the specification so far: {', '.join(words)} (policy {loop.runs[0].policy})."
    return draw("survival", "Runs that keep the specification", caption, on, link=LOOP)


def trace_picture(loop: LoopFigure) -> Picture:
    """The state that is broken most, over time, with its limits."""
    i = _most_broken(loop)
    axis, (low, high) = loop.axes[i], loop.stay[i]

    def on(ax: Axes) -> None:
        for runs in loop.runs:
            _traces(ax, runs, i, loop.period, axis.angle)
        whole = axis.angle and high - low >= 2 * np.pi - 1e-9
        for limit in () if whole else (low, high):
            ax.axhline(limit, color=BAD, ls="--", lw=1.2, label="limit")
        ax.set(xlabel="time [s]", ylabel=axis.label)
        pad = 0.12 * (high - low)
        ax.set_ylim(low - pad, high + 2.2 * pad)

    caption = f"{axis.name} of some runs on the simulator; crosses: ends by violation."
    return draw("traces", f"{axis.name} in closed loop", caption, on, link=LOOP)


def _most_broken(loop: LoopFigure) -> int:
    out = np.zeros(len(loop.axes))
    for runs in loop.runs:
        for trace, end in zip(runs.traces, runs.ended, strict=True):
            if end >= 0:
                x = trace[int(end)]
                out += np.maximum(0, np.maximum(loop.stay[:, 0] - x, x - loop.stay[:, 1])) / np.ptp(loop.stay, axis=1)
    return int(np.argmax(out))


def _traces(ax: Axes, runs: Runs, i: int, period: float, angle: bool) -> None:
    step = max(1, runs.traces.shape[1] // 300)
    for trace, end in zip(runs.traces, runs.ended, strict=True):
        last = int(end) if end >= 0 else len(trace) - 1
        at = np.unique(np.append(np.arange(0, last + 1, step), last))
        # Where an angle comes round, the line ends and begins again.
        round_ = np.flatnonzero(angle & (np.abs(np.diff(trace[at, i])) > np.pi)) + 1
        t, y = np.insert(at * period, round_, np.nan), np.insert(trace[at, i], round_, np.nan)
        ax.plot(t, y, color=ROLES[runs.name], lw=1.1, alpha=0.85, label=runs.name)
        if end >= 0:
            ax.plot(last * period, trace[last, i], "x", color=BAD, ms=6, mew=1.8)


def foresight_pictures(loop: LoopFigure, winning: WinningFigure | None) -> list[Picture]:
    """The first shows whether each step ended in the box that was foreseen for it. None where nothing is foreseen."""
    if not loop.foreseen:
        return []
    ahead = [] if loop.ahead is None else [_one_step(loop, loop.ahead)]
    widths = _widths(loop)
    # Of the state whose tube is widest, as a share of where it may be.
    over_time = [*ahead, _over_time(loop, int(np.argmax(widths / np.ptp(loop.stay, axis=1))))]
    thin = (widths[:2] < SEEN * np.ptp(_trace(loop)[:, :2], axis=0)).all()  # too small to be seen beside the run
    return over_time if winning is None or thin else [*over_time, _in_the_plane(loop, winning)]


def _trace(loop: LoopFigure) -> Array:
    """The run that was foreseen, as far as the last tube reaches."""
    last = loop.foreseen[-1]
    whole: Array = next(runs.traces[0] for runs in loop.runs if runs.gamma)[: last.step + len(last.low)]
    return whole[np.isfinite(whole).all(axis=1)]


def _widths(loop: LoopFigure) -> Array:
    """(nx,): the widest box of all tubes."""
    return np.asarray(np.stack([(f.high - f.low).max(axis=0) for f in loop.foreseen]).max(axis=0))


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
        ax.set(xlabel="time [s]", ylabel=labelled(f"{axis.name} − plan", label))

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
        for f in loop.foreseen:
            t = (f.step + np.arange(len(f.low))) * loop.period
            ax.fill_between(t, f.low[:, i], f.high[:, i], color=WITH, alpha=0.25, lw=0.8, label="foreseen")
            ax.plot(t, f.centre[:, i], color=WITH, lw=1, ls="--", label="its centre")
            ax.plot(t[0], f.centre[0, i], "o", mfc=CARD, mec=INK, ms=4.5, mew=1, zorder=5)
        for piece, start in _pieces(trace[:, i], axis.angle):
            ax.plot((start + np.arange(len(piece))) * loop.period, piece, color=TRUTH, lw=1.3, label="simulator")
        low, high = ax.get_ylim()
        for limit in loop.stay[i]:
            if low - 0.3 * (high - low) <= limit <= high + 0.3 * (high - low):
                ax.axhline(limit, color=BAD, ls="--", lw=1.2)
        ax.set(xlabel="time [s]", ylabel=axis.label)

    moments = times(len(loop.foreseen), "moment")
    wide = _widths(loop)[i] / 2
    seen = wide > SEEN / 2 * np.ptp(loop.stay[i])
    thin = "" if seen else f" Its tube is ± {number(wide, 2)} at its widest: a line in this picture."
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

    def on(ax: Axes) -> list[Any]:
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
        return [*handles, line]

    over = f"{w.axes[0].name} and {w.axes[1].name}"
    caption = f"The same over {over}, boxes of some steps. Circles: where the controller looked ahead."
    return draw("foreseen-plane", "A run in its tubes", caption, on, plane_height(w.axes))


def wanted_pictures(loop: LoopFigure) -> list[Picture]:
    """Of the state whose reference moves most, as a share of where it may be; none where nothing moves."""
    if not len(loop.wanted):
        return []
    moved = np.ptp(loop.wanted, axis=0) / np.ptp(loop.stay, axis=1)
    return [_wanted(loop, int(np.argmax(moved)))]


def _wanted(loop: LoopFigure, i: int) -> Picture:
    axis, runs = loop.axes[i], next(runs for runs in loop.runs if runs.gamma)

    def on(ax: Axes) -> None:
        for trace in runs.traces[:, :, i]:
            ax.plot(np.arange(len(trace)) * loop.period, trace, color=WITH, lw=1, alpha=0.7, label="runs")
        wanted = loop.wanted[:, i]
        ax.step(np.arange(len(wanted)) * loop.period, wanted, color=TRUTH, lw=1.2, ls="--", where="post", label="wanted")
        ax.set(xlabel="time [s]", ylabel=axis.label)

    caption = f"{axis.name} of some runs with γ, and what they are drawn to. That is no part of what is promised."
    return draw("wanted", f"{axis.name} and what is wanted of it", caption, on, link=LOOP)


def learned_pictures(loop: LoopFigure) -> list[Picture]:
    """One per parameter; none where nothing is learned."""
    return [_learned(loop.period, k, one) for k, one in enumerate(loop.learned)]


def _learned(period: float, k: int, one: Learned) -> Picture:
    known = one.run[np.isfinite(one.run).all(axis=1)]
    wide = np.ptp(one.hull, axis=1)
    # What follows could not be told from a line.
    shown = min(len(wide), 2 + int(np.flatnonzero(wide > THIN * wide[0]).max(initial=4) * 1.25))
    t, hull, run = np.arange(shown) * period, one.hull[:shown], one.run[:shown]

    def on(ax: Axes) -> None:
        ax.fill_between(t, hull[:, 0], hull[:, 1], step="post", color=WITH, alpha=0.2, lw=0, label="all runs")
        ax.fill_between(t, run[:, 0], run[:, 1], step="post", color=WITH, alpha=0.6, lw=0.8, label="one run")
        ax.axhline(one.stated, color=TRUTH, lw=1.2, ls="--", label="the model of γ")
        ax.set(xlabel="time [s]", ylabel=labelled(one.name, one.unit), xlim=(0, t[-1]))

    of = "" if one.unit in ("", "1") else f" {one.unit}"
    caption = (
        f"What {one.name} may still be: {between(*known[0])}{of} when one run began, {between(*known[-1])}{of} when it ended. "
        f"Dashed: its value in the model that γ is about."
    )
    return draw(f"learned{k}", f"What is learned of {one.name}", caption, on, link=LOOP)


def loop_pictures(figures: Figures) -> tuple[list[Picture], list[Picture]]:
    """All pictures of a controller: those that carry the answer, and the others."""
    winning = figures.winning
    domain = [] if winning is None else [winning_picture(winning)]
    values = [value_picture(winning)] if winning is not None and winning.values.size else []
    if figures.loop is None or not figures.loop.runs:
        return [*domain, *values], []
    trace, survival = trace_picture(figures.loop), survival_picture(figures.loop)
    if not any((runs.broke >= 0).any() for runs in figures.loop.runs):  # two flat lines say less than the runs themselves
        trace, survival = survival, trace
    told = [
        *foresight_pictures(figures.loop, winning),
        *wanted_pictures(figures.loop),
        *learned_pictures(figures.loop),
    ]
    runs = [] if winning is None else [runs_picture(figures.loop, winning)]
    escape = [] if figures.loop.escape is None else [escape_picture(figures.loop.escape)]
    if figures.loop.ahead is not None:  # whether each step kept to its plan's tube is what such a controller answers for
        # On the way to somewhere, the way is what there is to be seen.
        way = runs if winning is not None and winning.goal.startswith("reach") else [survival]
        return [*way, told.pop(0)], [*(p for p in (survival, *runs) if p not in way), trace, *told, *escape, *domain, *values]
    if escape:
        return [survival, *escape], [trace, *told, *runs, *domain, *values]
    if runs and values:  # on the way to somewhere, the way is what there is to be seen
        return [*runs, survival], [trace, *told, *domain, *values]
    return [survival, trace], [*told, *runs, *domain, *values]
