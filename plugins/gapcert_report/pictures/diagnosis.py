"""What each picture of a diagnosis shows."""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import wrap
from typing import TYPE_CHECKING, Any, final

import numpy as np

from gapcert.plugin import pretty
from gapcert_figures import Channel, Correlation, Course, DiagnosisFigure, Law, Signal, Waterfall
from gapcert_report.words.diagnosis import headline
from gapcert_report.words.words import Summary

from .svg import BAD, FAINT, INK, TRUTH, WITH, WITHOUT, Picture, draw, scaled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POINTS = 700  # of a line
FEW = 60  # lags that are seen one by one
HELD = "held-out"  # pictures with one cursor


def channel_picture(i: int, c: Channel) -> Picture:
    """Measured against simulated, before and after, on held-out data."""
    bottom, top, left = _frame(c)
    unit, label = scaled(c.unit, np.array([bottom, top]))
    step = max(1, len(c.t) // POINTS)

    def on(ax: Axes) -> None:
        ax.plot(c.t[::step], c.measured[::step] / unit, color=TRUTH, lw=3.2, alpha=0.4, label="measured")
        for values, colour, name in _simulated(c):
            ax.plot(c.t[::step], values[::step] / unit, color=colour, lw=1.3, label=name)
        ax.set(xlabel="time [s]", ylabel=f"{c.name} [{pretty(label)}]", ylim=(bottom / unit, top / unit))

    when = " before and after the causes were added" if len(_simulated(c)) > 1 else ""
    caption = f"{c.name}: measured, and simulated from the same start{when}."
    caption += " What was simulated before goes on outside of the picture." if left else ""
    return draw(f"channel{i}", f"{c.name} on held-out data", caption, on, link=HELD)


def _frame(c: Channel) -> tuple[float, float, bool]:
    """From where to where a channel is drawn, and whether the simulation before leaves that."""
    seen, all_of_it = np.concatenate([c.measured, c.after]), np.concatenate([c.measured, c.after, c.before])
    low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
    reach = high - low or 1.0
    # A simulation that runs away would flatten the two that matter.
    bottom, top = max(float(np.nanmin(all_of_it)), low - reach), min(float(np.nanmax(all_of_it)), high + reach)
    left = bool(np.nanmin(all_of_it) < bottom or np.nanmax(all_of_it) > top)
    margin = 0.06 * (top - bottom or 1.0)
    return bottom - margin, top + margin, left


def _simulated(c: Any) -> list[tuple[Any, str, str]]:
    """(values, colour, name) before and after; one of them where nothing was added."""
    if np.array_equal(c.before, c.after):
        return [(c.before, WITHOUT, "simulated" if isinstance(c, Channel) else "residual")]
    return [(c.before, WITHOUT, "before"), (c.after, WITH, "after")]


def error_picture(i: int, c: Channel) -> Picture:
    """Simulated minus measured on held-out data, before and after."""
    unit, label = scaled(c.unit, c.before - c.measured, c.after - c.measured)
    step = max(1, len(c.t) // POINTS)

    def on(ax: Axes) -> None:
        for values, colour, name in _simulated(c):
            ax.plot(c.t[::step], (values - c.measured)[::step] / unit, color=colour, lw=1.2, label=name)
        ax.axhline(0, color=FAINT, lw=0.8)
        ax.set(xlabel="time [s]", ylabel=f"error of {c.name} [{pretty(label)}]")

    when = ", before and after the causes were added" if len(_simulated(c)) > 1 else ""
    caption = f"{c.name}, simulated minus measured{when}."
    return draw(f"error{i}", f"Error of {c.name} on held-out data", caption, on, link=HELD)


def law_picture(i: int, law: Law) -> Picture:
    """What is missing, estimated interval by interval, with the law that was named."""
    what, _, own = law.y_label.partition(" [")
    unit, label = scaled(own.removesuffix("]"), law.y, law.law, law.half[np.isfinite(law.half)])

    def on(ax: Axes) -> None:
        ax.axhline(0, color=FAINT, lw=0.8)
        if law.law.size:
            styles: dict[str, dict[str, Any]] = {"line": {"lw": 2.2}, "loop": {"lw": 1.2, "alpha": 0.8}}
            style = styles.get(law.shape, {"ls": "", "marker": ".", "ms": 2, "alpha": 0.5})
            named = f"{law.named} along the path" if law.shape == "cloud" else law.named
            ax.plot(law.at, law.law / unit, color=WITH, label=named, **style)
        for marker, rows, name in _branches(law):
            half = law.half[rows] / unit if law.half.size else None
            style = {"fmt": marker, "ms": 3.5, "color": TRUTH, "elinewidth": 1, "capsize": 2, "zorder": 3, "label": name}
            ax.errorbar(law.x[rows], law.y[rows] / unit, yerr=half, **style)
        ax.set(xlabel=pretty(law.x_label), ylabel=f"{what} [{pretty(label)}]")

    against = law.x_label.split(" [")[0]
    points = f"points: what the data ask for in each interval of {against}, no law assumed, with 95 % intervals"
    caption = f"{points}; line: the {law.named}." if law.law.size else f"{points}."
    if law.shape == "loop":
        caption = f"{caption[:-1]}, which has memory, where it is largest."
    title = f"{law.title}, against {against}"
    return draw(f"law{i}", title[0].upper() + title[1:], caption[0].upper() + caption[1:], on, link=f"against {against}")


def _branches(law: Law) -> list[tuple[str, Any, str]]:
    """(marker, rows, name) of the points; a loop has those of a rising x and those of a falling one."""
    if not law.rising.size:
        return [("o", slice(None), "from the data")]
    return [("^", law.rising > 0, "data, rising"), ("v", law.rising == 0, "data, falling")]


def waterfall_picture(w: Waterfall) -> Picture:
    """What is left of the held-out error after each cause, in the order listed."""
    share = 100 * w.error / w.error[0]

    def on(ax: Axes) -> None:
        y = np.arange(len(share) + 1)[::-1]
        ax.barh(y[0], share[0], 0.62, color=WITHOUT)
        for k in range(1, len(share)):
            low, high = sorted((share[k - 1], share[k]))
            worse = share[k] > share[k - 1]
            ax.barh(y[k], high - low, 0.62, left=low, color=BAD if worse else WITH)
            ax.plot([share[k - 1]] * 2, [y[k - 1] + 0.31, y[k] - 0.31], color=FAINT, lw=0.8)
            ax.annotate(
                f"{share[k] - share[k - 1]:+.1f} %".replace("-", "− ").replace("+", "+ "), (high, y[k]), (4, 0),
                textcoords="offset points", va="center", fontsize=8.5,
            )  # fmt: skip
        ax.barh(y[-1], share[-1], 0.62, color=FAINT)
        ax.annotate(f"{share[-1]:.1f} %", (share[-1], y[-1]), (4, 0), textcoords="offset points", va="center", fontsize=8.5)
        ax.set_yticks(y, ["before", *("\n".join(wrap(n, 22)) for n in w.labels[1:]), "left"])
        ax.set(xlabel="held-out error [% of the error before]", xlim=(0, 1.18 * share.max()))

    caption = (
        "From the error before to what is left, cause by cause in the order listed. Shares depend on the order and do not "
        "add up to those of the table."
    )
    return draw("waterfall", "What each cause explained", caption, on, 1.2 + 0.42 * (len(share) + 1))


def correlation_picture(i: int, c: Correlation) -> Picture:
    """Is what is left noise, or does it follow itself or an input?"""
    step = max(1, len(c.lag) // 300)
    marker = "o-" if len(c.lag) <= FEW else "-"

    def on(ax: Axes) -> None:
        ax.axhspan(-c.band, c.band, color=FAINT, alpha=0.25, lw=0, label="chance (95 %)")
        ax.axhline(0, color=FAINT, lw=0.8)
        for values, colour, name in _simulated(c):
            ax.plot(c.lag[::step], values[::step], marker, ms=3, color=colour, lw=1.4, label=name)
        ax.set(xlabel="lag [s]", ylabel="correlation", ylim=(-1.05, 1.05))

    caption = f"At positive lags the residual follows {c.against}: an effect of the input that the model misses shows there."
    if c.against == "itself":
        caption = "White noise has none at any lag; the fit of free starts leaves a little."
    return draw(f"correlation{i}", f"Residual of {c.channel} with {c.against}", caption, on, link="lag")


def course_picture(i: int, c: Course, many: bool) -> Picture:
    """Where in time the residual is; over decades, where it goes over any."""
    seen = np.concatenate([[1.0], c.before, c.after])
    wide = bool(np.nanmax(seen) > 5 * np.nanmin(seen[seen > 0]))

    def on(ax: Axes) -> None:
        ax.axhline(1, color=FAINT, lw=1, ls="--", label="noise floor")
        for values, colour, name in _simulated(c):
            ax.plot(c.t, values, "o-", ms=3, color=colour, lw=1.2, label=name)
        if wide:
            ax.set_yscale("log")
        ax.set(xlabel="time [s]", ylabel="RMS residual [noise floors]")

    title = "Residual over the recording" + (f", trajectory {i + 1}" if many else "")
    return draw(f"course{i}", title, "Each point is one fitted window: at 1, its residual is noise.", on, link="recording")


def signal_picture(i: int, s: Signal) -> Picture:
    """An input of the proposed experiment, or what is expected of an output."""
    unit, label = scaled(s.unit, s.values, s.recorded)
    rows = np.atleast_2d(s.values)

    def on(ax: Axes) -> None:
        step = max(1, len(s.t) // (3 * POINTS))
        for row, colour in zip(rows, (INK, *[WITH, WITHOUT, TRUTH] * len(rows)), strict=False):
            ax.plot(s.t[::step], row[::step] / unit, color=colour, lw=1)
        for level in s.recorded:
            ax.axhline(level / unit, color=BAD, lw=0.8, ls=":")
        ax.set(xlabel="time [s]", ylabel=f"{s.name} [{pretty(label)}]")

    caption = f"{s.name}, to be played to the real system and recorded."
    if len(s.recorded):
        caption = f"{s.name}, as each of the causes that tie foretells it; dotted: how far it went in the recording."
    return draw(f"signal{i}", f"The experiment: {s.name}", caption, on, 2.2, link="experiment")


def gain_picture(summary: Summary) -> Picture | None:
    """Held-out error before and after, per horizon and channel, with bootstrap intervals."""
    horizons = sorted((summary.get("gain") or {}).items(), key=lambda x: float(x[0]))
    rows = [(horizon, channel, g) for horizon, channels in horizons for channel, g in channels.items()]
    if not rows or not summary.get("causes"):
        return None
    units = summary.get("units", {})

    def on(ax: Axes) -> None:
        y = np.arange(len(rows))[::-1]
        before, after = [g["before"] for *_, g in rows], [g["after"] for *_, g in rows]
        reach = [[max(0.0, g["after"] - g["low"]) for *_, g in rows], [max(0.0, g["high"] - g["after"]) for *_, g in rows]]
        ax.barh(y + 0.2, before, 0.36, color=WITHOUT, label="before")
        ax.barh(y - 0.2, after, 0.36, color=WITH, label="after")
        ax.errorbar(after, y - 0.2, xerr=reach, fmt="none", ecolor=INK, elinewidth=1.2, capsize=2.5)
        ax.set_xscale("log")
        ax.set_yticks(y, [f"{c}, {h} s" for h, c, _ in rows])
        shared = {units.get(c, "") for _, c, _ in rows}
        unit = pretty(shared.pop()) if len(shared) == 1 else "each in its unit"
        ax.set(xlabel="held-out error, RMSE" + (f" [{unit}]" if unit not in ("", "1") else ""), ylim=(-0.6, len(rows) - 0.1))

    caption = "Error of the simulation on data that took no part, before and after; bars: 95 % bootstrap interval."
    return draw("gain", "What naming the causes bought", caption, on, 1.4 + 0.45 * len(rows))


@final
@dataclass(frozen=True)
class DiagnosisAlbum:
    """The pictures of a diagnosis, by what they answer."""

    hero: tuple[Picture, ...] = ()
    motions: tuple[Picture, ...] = ()
    laws: tuple[Picture, ...] = ()
    other_laws: tuple[Picture, ...] = ()
    left: tuple[Picture, ...] = ()
    experiment: tuple[Picture, ...] = ()


def diagnosis_album(d: DiagnosisFigure | None, summary: Summary) -> DiagnosisAlbum:
    """The hero is what a colleague is shown first: measured against simulated, the first law, and the waterfall."""
    if d is None:
        return DiagnosisAlbum()
    channels = [channel_picture(i, c) for i, c in enumerate(d.channels)]
    errors = [error_picture(i, c) for i, c in enumerate(d.channels)]
    drawn = [(law.lead, law_picture(i, law)) for i, law in enumerate(d.laws)]
    lead, rest = ([p for shown, p in drawn if shown is first] for first in (True, False))
    fall = [waterfall_picture(d.waterfall)] if d.waterfall else []
    gain = [p for p in (gain_picture(summary),) if p is not None]
    left = [correlation_picture(i, c) for i, c in enumerate(d.correlations)]
    courses = [course_picture(i, c, len(d.courses) > 1) for i, c in enumerate(d.courses)]
    worst = _quoted(d, summary)
    # Where both lie on the measurement, only their errors can be told apart.
    clear = np.nanmax(np.abs(d.channels[worst].before - d.channels[worst].measured)) > 0.15 * np.ptp(d.channels[worst].measured)
    hero = [channels[worst] if clear else errors[worst], *lead[:1], *(fall or gain or courses[:1])]
    seen = {p.title for p in hero}
    motions = [p for pair in zip(channels, errors, strict=True) for p in pair] + gain
    return DiagnosisAlbum(
        tuple(hero),
        tuple(p for p in motions if p.title not in seen),
        tuple(lead[1:]),
        tuple(rest),
        tuple(p for p in (*courses, *left) if p.title not in seen),
        tuple(signal_picture(i, s) for i, s in enumerate(d.experiment)),
    )


def _quoted(d: DiagnosisFigure, summary: Summary) -> int:
    """The channel that the answer quotes; where it quotes several as one, such as a position, of those in its unit, and where
    it quotes none, of all, the one whose simulation improved most, relative to its motion."""
    name = found[1] if (found := headline(summary)) is not None else ""
    unit = summary.get("units", {}).get(name)
    named = [i for i, c in enumerate(d.channels) if c.name == name]
    alike = named or [i for i, c in enumerate(d.channels) if c.unit == unit] or range(len(d.channels))
    fell = [
        float(np.nanmean((c.before - c.measured) ** 2) - np.nanmean((c.after - c.measured) ** 2))
        / (float(np.nanvar(c.measured)) or 1.0)
        for c in (d.channels[i] for i in alike)
    ]
    return alike[int(np.argmax(fell))]
