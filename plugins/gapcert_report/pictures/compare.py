"""Pictures of a comparison: all pairs at a glance, where two differ, how runs drift apart, and what closes the difference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert_figures import CompareFigure, PairFigure, held
from gapcert_report.words.compare import apart, made, setting_name, share
from gapcert_report.words.words import Summary

from .svg import FAINT, GOOD, WITH, WITHOUT, Picture, draw, heat, scaled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NAME = 52  # characters of a change beside its bar
_CELL, _SAME = "#17181a", "#cfe9d8"  # inside bitmaps, so readable on light and dark alike


def pair_matrix(summary: Summary) -> Picture | None:
    """Every pair: the mean below the diagonal, the largest above it, as shares of what one step moves."""
    names = list(summary["backends"])
    measured = {frozenset((p["a"], p["b"])): p for p in summary["pairs"] if "refused" not in p}
    if len(names) < 2 or not measured:
        return None
    n = len(names)

    def on(ax: Axes) -> None:
        import matplotlib as mpl
        from matplotlib.patches import Rectangle

        values = np.full((n, n), np.nan)
        texts: list[tuple[int, int, str]] = []
        for i, j in ((i, j) for i in range(n) for j in range(n) if i != j):
            p = measured.get(frozenset((names[i], names[j])))
            if p is None:
                texts.append((i, j, "–"))
            elif not p["resolved"]:
                ax.add_patch(Rectangle((j - 0.5, i - 0.5), 1, 1, color=_SAME, lw=0))
                texts.append((i, j, "agree"))
            else:
                values[i, j] = np.log10(p["relative_max"] if j > i else p["relative"])
                texts.append((i, j, share(p["relative_max"] if j > i else p["relative"])))
        low, high = (np.nanmin(values) - 1.5, np.nanmax(values) + 1.5) if np.isfinite(values).any() else (0.0, 1.0)
        ax.imshow(values, cmap=mpl.colormaps["YlOrRd"].with_extremes(bad="none"), vmin=low, vmax=high, aspect="auto")
        for i, j, text in texts:
            ax.text(j, i, text, ha="center", va="center", color=_CELL if text != "–" else FAINT, fontsize=8.5 if n < 6 else 7)
        flat = sum(map(len, names)) < 36
        ax.set_xticks(range(n), names, rotation=0 if flat else 30, ha="center" if flat else "right")
        ax.set_yticks(range(n), names)
        ax.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5))
        ax.tick_params(length=0)

    caption = "Difference after one step, as a share of what a step moves: the mean below the diagonal, the largest above it."
    return draw("pairs", "Simulator against simulator", caption, on, 1.5 + 0.42 * n)


def drift_picture(summary: Summary, figure: CompareFigure) -> Picture | None:
    """How runs under equal inputs come apart, per pair."""
    shown = [p for p in figure.pairs if p.drift.size]
    if not shown:
        return None
    differing = {(p["a"], p["b"]) for p in apart(summary)}

    def on(ax: Axes) -> None:
        for p in sorted(shown, key=lambda p: (p.a, p.b) in differing):
            differs = (p.a, p.b) in differing
            label = "pairs that differ" if differs else "pairs that agree"
            drift = np.where(p.drift > 0, p.drift, np.nan)
            t = np.arange(len(drift)) * figure.period
            ax.plot(t, drift, color=WITHOUT if differs else GOOD, lw=1.6 if differs else 1.1, alpha=0.85, label=label)
        ax.set_yscale("log")
        ax.set(xlabel="time [s]", ylabel="difference [steps' motion]", xlim=(0, None))

    caption = "Common starts, common random inputs: the largest difference of two runs, in units of what one step moves."
    return draw("drift", "How runs come apart", caption, on, link="drift")


def where_picture(key: str, p: PairFigure) -> Picture | None:
    """Where over the domain two simulators differ."""
    if not p.values.size:
        return None
    unit, label = scaled(p.unit, p.values)
    top = float(np.nanmax(p.values)) / unit

    def on(ax: Axes) -> None:
        heat(ax, p.axes, p.values / unit, top, f"difference of {p.state} [{label}]")

    caption = (
        f"Where {p.a} and {p.b} differ in {p.state} after one step{held(p.fixed)}, through the point where they differ most."
    )
    return draw(f"where-{key}", f"{p.a} against {p.b}: where", caption, on, link=f"where {p.axes[0].name}, {p.axes[1].name}")


def settings_picture(key: str, pair: Summary) -> Picture | None:
    """What is left of a difference after each change that was made."""
    entries = pair["explained_by"]
    if not entries:
        return None
    names = ["as they are", *(setting_name(e) + ("" if made(e) else ", in its equations") for e in entries)]
    left = [100.0, *(100 * max(0.0, 1 - e["reduction"]) for e in entries)]

    def on(ax: Axes) -> None:
        y = np.arange(len(names))[::-1]
        ax.barh(y, left, 0.62, color=[WITHOUT] + [WITH] * len(entries))
        for at, value, name in zip(y, left, names, strict=True):
            gone = "" if at == len(entries) else f": {value:.3g} % left" if value >= 0.005 else ": nothing left"
            # A long name is whole in the table, and takes no room from the bars.
            shown = name if len(name) <= _NAME else f"{name[: _NAME - 1]}…"
            text = ax.annotate(shown + gone, (0, at + 0.33), xytext=(2, 0), textcoords="offset points", ha="left", va="bottom")
            text.set_fontsize(8.5)
            text.set_in_layout(False)
        ax.set_yticks([])
        ax.set(xlabel="mean difference left [%]", xlim=(0, 100), ylim=(-0.5, len(names) - 0.1))

    where = "" if all(map(made, entries)) else " (where the simulator cannot be told, in the equations of its bodies)"
    caption = f"Each change was made{where}, and {pair['a']} and {pair['b']} were measured again on the same points."
    return draw(
        f"settings-{key}", f"{pair['a']} against {pair['b']}: what closes it", caption, on, max(2.4, 0.9 + 0.48 * len(names))
    )
