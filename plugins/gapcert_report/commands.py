"""`gapcert inspect` and `gapcert report`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gapcert.plugin import Answer, Arguments, UsageError


def inspect(options: Arguments) -> Answer:
    from gapcert_recordings import in_words
    from gapcert_recordings import inspect as look

    from .pages.log import write_log_page
    from .words import preview

    tables, path = look(options.log), Path(options.log)
    data = {"log": options.log, "tables": [t.facts() for t in tables]}
    found, refused = _could_show(path, options.allow_code) if path.suffix in (".yaml", ".yml") else (None, None)
    more = {k: v for k, v in (("could_show", found), ("refused", refused)) if v is not None}
    page = str(
        write_log_page(options.out / f"inspect-{path.resolve().name}" / "report.html", path.resolve().name, tables, found)
    )
    told = preview.in_words(found) if found is not None else []
    told += [f"what this log could show cannot be said: {refused}"] if refused else []
    return Answer({**data, **more, "report": page}, [*in_words(tables), *told, f"plots in {page}"], 2 if refused else 0)


def _could_show(path: Path, allow_code: bool) -> tuple[Mapping[str, Any] | None, str | None]:
    """What a diagnosis could find in the recording of a spec, or why it would refuse it."""
    from gapcert_diagnosis import previewed

    try:
        found = previewed(path, allow_code)
    except UsageError as error:
        return None, str(error)
    return None if found is None else found.summary(), None


def report(options: Arguments) -> Answer:
    from .pages.page import write_report

    path = str(write_report(Path(options.run)))
    return Answer({"report": path}, [path])
