"""A page with what is in a log: its tables, and a picture of every column."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gapcert.plugin import Array, __version__, write_atomic
from gapcert_recordings import Column, Table, flawed, not_numbers, sentence
from gapcert_report.pictures.svg import BAD, FAINT, WITH, Picture, draw
from gapcert_report.words.words import Summary, number

from .html import Html, document, framed, gallery, h, table
from .preview import could_show

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BINS = 600  # pieces of time of which the extremes are drawn
MOST_TABLES, MOST_COLUMNS = 8, 24  # that get pictures


def write_log_page(path: Path, name: str, tables: Sequence[Table], found: Summary | None = None) -> Path:
    """One self-contained file; found: what a diagnosis could find in it."""
    sections = [*could_show(found)] if found is not None else []
    sections += [part for i, one in enumerate(tables) for part in _section(i, one)]
    page = document(name, *framed([h("h1", name)], sections, __version__))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, page.encode())
    return path


def _section(i: int, one: Table) -> Iterator[Html | None]:
    head = ("column", "unit", "least", "greatest", "deviation", "noise floor", "step", "missing", "outliers")
    facts = {
        c.name: [None if v is None or v != v else v for v in (c.low, c.high, c.spread, c.noise, c.step)] for c in one.columns
    }
    rows = [(c.name, c.unit, *map(number, facts[c.name]), c.missing, c.outliers) for c in one.columns]
    yield h("h2", one.name)
    yield h("p", sentence(one) + ".")
    yield table("Columns", head, rows, 2)
    yield from (h("p", f"{told}.") for told in flawed(one))
    if one.text:
        yield h("p", f"N{not_numbers(one)[1:]}.")
    if i < MOST_TABLES:
        drawn = [(j, c) for j, c in enumerate(one.columns[:MOST_COLUMNS]) if np.isfinite(c.values).any()]
        yield gallery([*_steps(i, one), *(_column(i, j, one, c) for j, c in drawn)])


def _steps(i: int, one: Table) -> Iterator[Picture]:
    if one.period is None:
        return
    steps = np.diff(one.t)
    if np.abs(steps / one.period - 1).max() < 1e-3:
        return

    def on(ax: Axes) -> None:
        ax.plot(one.t[1:], steps, ".", ms=2, color=WITH)
        ax.set(xlabel="time [s]", ylabel="step [s]")

    yield draw(f"steps{i}", "Time steps", "From each row to the next.", on, link=f"table{i}")


def _column(i: int, j: int, one: Table, c: Column) -> Picture:
    told = "The range of the values in every piece of time" if len(one.t) > 2 * BINS else "All values"
    caption = f"{told}; noise floor {number(c.noise)}." if c.noise is not None else f"{told}."
    return draw(f"column{i}-{j}", c.name, caption, _painter(one, c), link=f"table{i}")


def _painter(one: Table, c: Column) -> Callable[[Axes], None]:
    def on(ax: Axes) -> None:
        t, values = one.t, c.values
        if len(t) > 2 * BINS:
            t, low, high = _extremes(t, values)
            ax.fill_between(t, low, high, color=WITH, linewidth=0.6, edgecolor=WITH)
        else:
            ax.plot(t, values, color=WITH, linewidth=1)
        for gap in one.log.gaps:
            ax.axvspan(gap["at"], gap["at"] + gap["seconds"], color=BAD, alpha=0.2, linewidth=0)
        for back in one.log.resets:
            ax.axvline(back["at"], color=FAINT, linewidth=0.8)
        # Two dollar signs would make a formula of what stands between them.
        named = c.title.replace("$", r"\$")
        ax.set(xlabel="time [s]" if one.time else "row", ylabel=named)

    return on


def _extremes(t: Array, values: Array) -> tuple[Array, Array, Array]:
    """Middle times, least and greatest values of equal numbers of rows; empty ones are left out."""
    parts = [(a, b) for a, b in zip(np.array_split(t, BINS), np.array_split(values, BINS), strict=True) if np.isfinite(b).any()]
    found = np.array([(np.nanmean(a), np.nanmin(b), np.nanmax(b)) for a, b in parts])
    return found[:, 0], found[:, 1], found[:, 2]
