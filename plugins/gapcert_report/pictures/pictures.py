"""What each picture of a report shows, and which of them carry the answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import Array
from gapcert_figures import Band, Escape, Figures, GapFigure, LoopFigure, Runs, Slice
from gapcert_report.words.words import number

from .diagnosis import DiagnosisAlbum, diagnosis_album
from .experiment import wanted_pictures
from .parameter_sets import learned_pictures
from .plane import ONLY_WITHOUT, runs_picture, value_picture, winning_picture
from .prediction import LOOP, foresight_pictures
from .recording import recorded_pictures
from .svg import BAD, FAINT, INK, TRUTH, WITH, WITHOUT, Picture, axis_label, classes, draw, figure_of, heat, scaled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_BANDS = 12
GAP = "gap"  # pictures with one cursor


def slice_pictures(gap: GapFigure) -> list[Picture]:
    """Per state the true gap and γ over the first two axes, on one colour scale."""
    pictures = []
    held = f" at {gap.fixed}" if gap.fixed else ""

    def paint(s: Slice, values: Array, symbol: str, dots: bool) -> Callable[[Axes], None]:
        unit, label = scaled(s.unit, s.gamma, s.gap)
        top = float(np.nanmax([s.gamma, s.gap])) / unit

        def on(ax: Axes) -> None:
            heat(ax, gap.axes, values / unit, top, f"{symbol} [{label}]")
            if dots:
                ax.scatter(gap.samples[:, 0], gap.samples[:, 1], s=7, c="white", edgecolors="black", linewidths=0.5, zorder=3)

        return on

    for i, s in enumerate(gap.slices):
        truth = f"True gap of {s.state}"
        bound = f"Certified bound γ of {s.state}"
        dots = len(gap.samples) <= 2000
        sampled = f"; dots: the {len(gap.samples):,} sampled points, projected" if dots else ""
        pictures += [
            draw(f"gap{i}", truth, f"|f̂ − f| of {s.state}{held}, evaluated afresh.", paint(s, s.gap, "|r|", False), link=GAP),
            draw(
                f"gamma{i}",
                bound,
                f"γ of {s.state}{held}, on the same colours{sampled}.",
                paint(s, s.gamma, "γ", dots),
                link=GAP,
            ),
        ]
    return pictures


def band_pictures(gap: GapFigure) -> tuple[list[Picture], list[Picture]]:
    """The residual in its certified band: per state along the axis where it leaves it, or else varies most, and the others."""
    told = [(not _inside(b), float(np.ptp(b.residual))) for b in gap.bands]
    best: dict[str, int] = {}
    for i, b in enumerate(gap.bands):
        if b.state not in best or told[i] > told[best[b.state]]:
            best[b.state] = i
    others = [i for i in range(len(gap.bands)) if i not in best.values()][:MOST_BANDS]
    return [_band(f"band{i}", gap.bands[i]) for i in best.values()], [_band(f"band{i}", gap.bands[i]) for i in others]


def _inside(b: Band) -> bool:
    return bool(np.all((b.low <= b.residual) & (b.residual <= b.high)))


def _band(key: str, b: Band) -> Picture:
    unit, label = scaled(b.unit, b.gamma, np.asarray(b.constant))

    def on(ax: Axes) -> None:
        ax.fill_between(b.at, -b.gamma / unit, b.gamma / unit, color=WITH, alpha=0.16, lw=0, label="±γ")
        ax.fill_between(b.at, b.low / unit, b.high / unit, color=WITH, alpha=0.55, lw=0, label="[l, u]")
        ax.plot(b.at, b.residual / unit, color=TRUTH, lw=1.1, label="f̂ − f")
        for sign in (-1, 1):
            ax.axhline(sign * b.constant / unit, color=FAINT, ls="--", lw=1, label="constant bound" if sign > 0 else None)
        ax.set(xlabel=axis_label(b.axis), ylabel=f"gap of {b.state} [{label}]", xlim=(b.axis.low, b.axis.high))
        ax.set_ylim(-1.15 * b.constant / unit, 1.15 * b.constant / unit)
        figure_of(ax).legend(loc="outside upper center", ncols=4, handlelength=1.2, columnspacing=0.9)

    where = "stays inside" if _inside(b) else "leaves"
    caption = f"Along {b.axis.name} through the middle of the domain: f̂ − f of {b.state} {where} its certified band."
    return draw(key, f"Gap of {b.state} along {b.axis.name}", caption, on, link=f"along {b.axis.name}")


def escape_picture(e: Escape) -> Picture:
    """Where f expected one run without γ to be, and where it was; axes count from the former."""
    origin = [float(v) for v in e.expected]
    (ux, lx), (uy, ly) = (scaled(a.unit, np.asarray(a.high - a.low)) for a in e.axes)

    def on(ax: Axes) -> None:
        sides = zip(e.axes, origin, (ux, uy), strict=True)
        moved = [replace(a, low=(a.low - o) / u, high=(a.high - o) / u) for a, o, u in sides]
        can = classes(ax, moved, [(e.domain > 0, ONLY_WITHOUT, "can go on", 0.45)])
        points = [((p[0] - origin[0]) / ux, (p[1] - origin[1]) / uy) for p in (e.expected, e.actual)]
        ax.annotate("", points[1], points[0], arrowprops={"arrowstyle": "->", "color": INK, "lw": 1.4})
        ax.plot(*points[0], "o", color=WITHOUT, ms=9, label="expected by f")
        ax.plot(*points[1], "x", color=BAD, ms=11, mew=3, label="simulator")
        names = [f"{a.name} − expected" for a in e.axes]
        ax.set(xlabel=f"{names[0]} [{lx}]", ylabel=f"{names[1]} [{ly}]")
        figure_of(ax).legend(handles=[*can, *ax.get_legend_handles_labels()[0]], loc="outside upper center", ncols=3)

    where = " and ".join(f"{a.name} = {number(o)} {a.unit}".removesuffix(" 1") for a, o in zip(e.axes, origin, strict=True))
    caption = f"Step {e.step} of one run: f expects {where}, from where its controller can go on; the simulator ends outside."
    return draw("escape", "How a run without γ breaks", caption, on)


def _which(runs: Runs) -> str:
    return "with γ" if runs.gamma else "without γ"


def survival_picture(loop: LoopFigure) -> Picture:
    """How many runs are still inside, over time."""

    def on(ax: Axes) -> None:
        last: list[int] = []
        for runs in loop.runs:
            t = np.arange(runs.steps + 1) * loop.period
            broke = np.where(runs.broke < 0, runs.steps + 1, runs.broke)
            alive = [int((broke > k).sum()) for k in range(runs.steps + 1)]
            colour = WITH if runs.gamma else WITHOUT
            ax.step(t, alive, where="post", color=colour, lw=2.2, label=_which(runs))
            text = f"{_which(runs)}: {alive[-1]} of {runs.starts}"
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

    words = [f"{_which(r)} {int((r.broke >= 0).sum())} of {r.starts} break it" for r in loop.runs]
    caption = f"Runs that have kept the specification so far: {', '.join(words)} (policy {loop.runs[0].policy})."
    return draw("survival", "Runs that keep the specification", caption, on, link=LOOP)


def trace_picture(loop: LoopFigure) -> Picture:
    """The state that is broken most, over time, with its limits."""
    i = _worst_state(loop)
    axis, (low, high) = loop.axes[i], loop.stay[i]

    def on(ax: Axes) -> None:
        for runs in loop.runs:
            _traces(ax, runs, i, loop.period, WITH if runs.gamma else WITHOUT, axis.angle)
        whole = axis.angle and high - low >= 2 * np.pi - 1e-9
        for k, limit in enumerate(() if whole else (low, high)):
            ax.axhline(limit, color=BAD, ls="--", lw=1.2, label="limit" if k == 0 else None)
        ax.set(xlabel="time [s]", ylabel=axis_label(axis))
        pad = 0.12 * (high - low)
        ax.set_ylim(low - pad, high + 2.2 * pad)
        ax.legend(ncols=4, loc="upper center", handlelength=1.2, columnspacing=0.9, borderaxespad=0.1)

    caption = f"{axis.name} of some runs on the simulator; crosses: ends by violation."
    return draw("traces", f"{axis.name} in closed loop", caption, on, link=LOOP)


def _worst_state(loop: LoopFigure) -> int:
    out = np.zeros(len(loop.axes))
    for runs in loop.runs:
        for trace, end in zip(runs.traces, runs.ended, strict=True):
            if end >= 0:
                x = trace[int(end)]
                out += np.maximum(0, np.maximum(loop.stay[:, 0] - x, x - loop.stay[:, 1])) / np.ptp(loop.stay, axis=1)
    return int(np.argmax(out))


def _traces(ax: Axes, runs: Runs, i: int, period: float, colour: str, angle: bool) -> None:
    step = max(1, runs.traces.shape[1] // 300)
    for k, (trace, end) in enumerate(zip(runs.traces, runs.ended, strict=True)):
        last = int(end) if end >= 0 else len(trace) - 1
        at = np.unique(np.append(np.arange(0, last + 1, step), last))
        # Where an angle comes round, the line ends and begins again.
        round_ = np.flatnonzero(angle & (np.abs(np.diff(trace[at, i])) > np.pi)) + 1
        t, y = np.insert(at * period, round_, np.nan), np.insert(trace[at, i], round_, np.nan)
        ax.plot(t, y, color=colour, lw=1.1, alpha=0.85, label=_which(runs) if k == 0 else None)
        if end >= 0:
            ax.plot(last * period, trace[last, i], "x", color=BAD, ms=6, mew=1.8)


@final
@dataclass(frozen=True)
class Album:
    """All pictures of a run, each once: those that carry the answer in `hero`, the others with their section."""

    hero: tuple[Picture, ...]
    pairs: tuple[Picture, ...]
    bands: tuple[Picture, ...]
    other_axes: tuple[Picture, ...]
    loop: tuple[Picture, ...]
    diagnosis: DiagnosisAlbum


def _loop_pictures(figures: Figures) -> tuple[list[Picture], list[Picture]]:
    """Those that carry the answer, and the others."""
    winning = figures.winning
    domain = [] if winning is None else [winning_picture(winning)]
    values = [value_picture(winning)] if winning is not None and winning.values.size else []
    if figures.loop is None or not figures.loop.runs:
        return [*domain, *values], []
    trace, survival = trace_picture(figures.loop), survival_picture(figures.loop)
    if not any((runs.broke >= 0).any() for runs in figures.loop.runs):  # two flat lines say less than the runs themselves
        trace, survival = survival, trace
    told = [*foresight_pictures(figures.loop, winning), *wanted_pictures(figures.loop), *learned_pictures(figures.loop)]
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


def album(figures: Figures, summary: Mapping[str, Any]) -> Album:
    """Every picture of a run, by the section of the page where it stands."""
    first, others = band_pictures(figures.gap) if figures.gap else ([], [])
    gap = slice_pictures(figures.gap) if figures.gap else []
    loop, rest = _loop_pictures(figures)
    d = diagnosis_album(figures.diagnosis, summary)
    if figures.recorded is not None:
        recorded = recorded_pictures(figures.recorded)
        return Album(tuple(recorded[:3]), (), tuple(recorded[3:]), (), (), d)
    if first:
        shown = 1 if loop else 3  # a row has room for three
        return Album((*first[:shown], *loop), tuple(gap), tuple(first[shown:]), tuple(others), tuple(rest), d)
    if not d.hero:  # γ was declared, and there is only what it buys
        return Album(tuple(loop), (), (), (), tuple(rest), d)
    return Album(d.hero, (), (), (), (*loop, *rest), d)
