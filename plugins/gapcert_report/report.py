"""A run folder as one self-contained page: the answer first, then what it rests on."""

from __future__ import annotations

import json
from pathlib import Path

from gapcert.plugin import DAMAGE, UsageError, __version__, clipped, write_atomic
from gapcert_figures import Figures


def write_report(folder: Path) -> Path:
    """Write `report.html` from `summary.json` and the figures of a run folder; no other file, no network."""
    from .pages.page import page

    source = folder / "summary.json"
    if not source.is_file():
        raise UsageError(f"{folder}: there is no summary.json; expected the folder of a finished run; run the spec again")
    try:
        summary = json.loads(source.read_text(encoding="utf-8"))
        if not isinstance(summary, dict):
            raise TypeError("it holds no object")
        text = page(summary, Figures.load(folder), folder.resolve(), __version__)
    except DAMAGE as error:
        what = f"{source}: cannot be read ({type(error).__name__} {clipped(str(error))[0]})"
        raise UsageError(f"{what}; expected what `gapcert run` writes; run the spec again") from error
    path = folder / "report.html"
    write_atomic(path, text.encode())
    return path
