"""How the views of a run are arranged: the answer on the left, and rows of evidence beside it, all of it in one window."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import rerun.blueprint as rrb

from .canvas import Canvas, Seen

Views = Mapping[str, Mapping[str, Any]]
_STACKED = 3
"""Plots over time that stand above one another; more are in tabs."""
_WIDE, _HIGH, _TITLE = 1195.0, 935.0, 27.0
"""Points of the evidence in a window of 1600 × 1000, and of a view's title: what cameras are placed for."""
_ROWS = (
    ("gap", "band", "scores", "stretch", "pair", "channel", "error"),
    ("winning", "loop", "drift", "robot", "law", "explained"),
    ("tube", "learned", "alive", "left", "course", "experiment"),
)
_OVER_TIME = ("loop", "stretch", "channel", "error", "tube", "learned", "alive", "drift", "experiment", "robot")
_WORDS = {
    "gap": "**Maps**: true gap beside γ on the same colours (black: outside the domain); dots: sampled points.",
    "band": "**Bands**: white is f̂ − f, blue its certified [l, u], dark blue ±γ, grey lines the best constant bound. "
    "Red ends without a filling are those of a band that was refuted, or has no value in it.",
    "scores": "**Scores**: one dot per held window, in scales of the fit; the green one set the band.",
    "stretch": "**Gap as measured**: the window whose score set the band, and the band.",
    "winning": "**May start**: dark blue both controllers, orange only the one without γ, green only the one with γ; "
    "runs upon it, and the first of them at the time cursor; red: limits and violations.",
    "loop": "**Runs**: blue with γ, orange without; grey: what f alone would have done; red: limits; green tubes: what was "
    "foreseen at some moments; white: what was wanted, where that moves.",
    "tube": "**Step against its tube**: where each step led, relative to the forecast (white), in the box foreseen (green).",
    "course": "**Error of each window**: before (orange) and after (blue) the causes; 1 is the noise.",
    "error": "**Error**: simulation minus measurement, before and after.",
    "learned": "**Learned**: between the blue lines as one run knows the parameter, between the grey ones as all runs do.",
    "alive": "**Runs unbroken**: how many of all starts are still within the specification.",
    "robot": "**Robot**: links where the engine has them. Press play, or drag the time cursor.",
    "pair": "**Pairs**: by how much one step of two simulators differs.",
    "drift": "**Coming apart**: common runs of two simulators, orange where the pair differs, green where it agrees; "
    "−16 is the last digit.",
    "channel": "**Held out**: measured white; simulation before (orange) and after (blue) the named causes.",
    "law": "**Laws**: white points are what the data ask for in each interval, no law assumed; blue is the law that was named.",
    "left": "**Correlations**: of the error of fitted windows with itself and with an input; grey is chance.",
}


def reading(views: Views) -> str:
    """How to read the pictures that there are."""
    said = [f"- {text}\n" for group, text in _WORDS.items() if group in views]
    return "\n## How to read the pictures\n" + "".join(said) if said else ""


def blueprint(canvas: Canvas, *, over: bool) -> rrb.Blueprint:
    """The answer beside rows of evidence; the stages of a run while it goes on, or where nothing happens in time."""
    views: dict[str, Any] = dict(canvas.views)
    timed = any(group in views for group in _OVER_TIME)
    if set(views) & set(_ROWS[2]) == {"alive"}:
        views["loop"] = views["loop"] | views.pop("alive")
    rows = [row for names in _ROWS if (row := [name for name in names if name in views])]
    if len(rows) == 1:
        # A row as high as the window would leave squares no room at their sides.
        rows = [[name] for name in rows[0]]
    left = [*views.get("answer", {}).values()]
    # Stages have no time in seconds: where that is the timeline, their lanes would be empty.
    if not timed:
        left += views.get("stages", {}).values()
    parts: list[Any] = [rrb.Vertical(*left, row_shares=[4, 1][: len(left)])] if left else []
    if rows:
        heights = [0.8 if set(row) <= set(_ROWS[2]) else 1.0 for row in rows]
        packed = [_row(row, views, h / sum(heights)) for row, h in zip(rows, heights, strict=True)]
        parts.append(rrb.Vertical(*packed, row_shares=heights))
    body = rrb.Horizontal(*parts, column_shares=[1, 3][-len(parts) :])
    playing: Any = "playing" if canvas.plays and over else "paused"
    loop: Any = "all" if canvas.plays else None
    panel = rrb.TimePanel(
        state="collapsed", timeline="time" if timed else "event", play_state=playing, loop_mode=loop, fps=30.0
    )
    return rrb.Blueprint(body, panel, rrb.SelectionPanel(state="hidden"), rrb.BlueprintPanel(state="hidden"))


def _row(names: Sequence[str], views: Views, height: float) -> Any:
    """Cells side by side; height: the row's share of the window."""
    widths = [{"gap": 1.9, "explained": 0.8}.get(name, 1.0) for name in names]
    tall = height * _HIGH - _TITLE
    cells = [_cell(name, views[name], _WIDE * w / sum(widths) / tall) for name, w in zip(names, widths, strict=True)]
    return rrb.Horizontal(*cells, column_shares=widths)


def _cell(name: str, views: Mapping[str, Any], aspect: float) -> Any:
    """The views of a group: stacked while they are few and wide, else in tabs."""
    every = [one.view(aspect) if isinstance(one, Seen) else one for one in views.values()]
    if len(every) == 1:
        return every[0]
    if name == "loop" and len(every) > _STACKED and "alive" in views:
        return rrb.Vertical(rrb.Tabs(*every[:-1]), every[-1], row_shares=[3, 2])
    if name == "stretch" and len(every) <= _STACKED:
        return rrb.Horizontal(*every)
    stacks = name in _OVER_TIME and len(every) <= (2 if name == "robot" else _STACKED)
    return rrb.Vertical(*every) if stacks else rrb.Tabs(*every)
