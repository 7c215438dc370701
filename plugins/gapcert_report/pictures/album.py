"""Which pictures a report has, and which of them carry the answer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

from gapcert_figures import Figures

from .diagnosis import DiagnosisAlbum, diagnosis_album
from .gap import band_pictures, recorded_pictures, slice_pictures
from .loop import (
    escape_picture,
    foresight_pictures,
    learned_pictures,
    survival_picture,
    trace_picture,
    wanted_pictures,
)
from .plane import runs_picture, value_picture, winning_picture
from .svg import Picture


@final
@dataclass(frozen=True)
class Album:
    """All pictures of a run, each once: those that carry the answer in `hero`, the others with their section."""

    diagnosis: DiagnosisAlbum
    hero: tuple[Picture, ...] = ()
    pairs: tuple[Picture, ...] = ()
    bands: tuple[Picture, ...] = ()
    other_axes: tuple[Picture, ...] = ()
    loop: tuple[Picture, ...] = ()


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


def album_of(figures: Figures, summary: Mapping[str, Any]) -> Album:
    """Every picture of a run, by the section of the page where it stands."""
    first, others = band_pictures(figures.gap) if figures.gap else ([], [])
    gap = slice_pictures(figures.gap) if figures.gap else []
    loop, rest = _loop_pictures(figures)
    d = diagnosis_album(figures.diagnosis, summary)
    if figures.recorded is not None:
        recorded = recorded_pictures(figures.recorded)
        return Album(d, tuple(recorded[:3]), bands=tuple(recorded[3:]))
    if first:
        shown = 1 if loop else 3  # a row has room for three
        return Album(d, (*first[:shown], *loop), tuple(gap), tuple(first[shown:]), tuple(others), tuple(rest))
    if not d.hero:  # γ was declared, and there is only what it buys
        return Album(d, tuple(loop), loop=tuple(rest))
    return Album(d, d.hero, loop=(*loop, *rest))
