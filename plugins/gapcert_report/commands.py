"""`gapcert inspect` and `gapcert report`."""

from __future__ import annotations

from pathlib import Path

from gapcert.plugin import Answer, Arguments


def inspect(options: Arguments) -> Answer:
    from gapcert_recordings import in_words
    from gapcert_recordings import inspect as look

    from .pages.log import write_log_page

    tables = look(options.log)
    stem = Path(options.log).resolve().name
    page = str(write_log_page(options.out / f"inspect-{stem}" / "report.html", stem, tables))
    data = {"log": options.log, "tables": [t.facts() for t in tables], "report": page}
    return Answer(data, [*in_words(tables), f"plots in {page}"])


def report(options: Arguments) -> Answer:
    from .pages.page import write_report

    path = str(write_report(Path(options.run)))
    return Answer({"report": path}, [path])
