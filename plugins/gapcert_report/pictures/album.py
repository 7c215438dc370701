"""Which pictures a report has, and which of them carry the answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from gapcert_figures import Figures
from gapcert_report.words.words import Summary, refutation

from .control import loop_pictures
from .diagnosis import DiagnosisAlbum, diagnosis_album
from .gap import band_pictures, recorded_pictures, slice_pictures
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


def album_of(figures: Figures, summary: Summary) -> Album:
    """Every picture of a run, by the section of the page where it stands."""
    refuted = refutation(summary.get("certificate", {"claim": {}})) is not None
    first, others = band_pictures(figures.gap, refuted) if figures.gap else ([], [])
    gap = slice_pictures(figures.gap, refuted) if figures.gap else []
    loop, rest = loop_pictures(figures)
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
