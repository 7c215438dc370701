"""How results are shown, in a line, in a sentence, on a terminal and in a notebook: by whoever provides it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from gapcert.contracts.plugins.registry import registry


class View:
    """A component of kind `view`, named after the class that it shows. These are the methods of one that overrides none."""

    def line(self, value: Any) -> str:
        """What `repr` says."""
        summary = value.summary() if callable(value.summary) else value.summary
        return f"{type(value).__name__}({summary.get('verdict') or summary.get('claim', {}).get('kind', '')})"

    def sentence(self, value: Any) -> str:
        """What was found, in a sentence or two."""
        return self.line(value)

    def lines(self, summary: Mapping[str, Any]) -> Iterator[str]:
        """What a terminal says of a run's summary."""
        yield f"{summary.get('name', 'run')}: {summary.get('verdict', '')}"

    def html(self, value: Any) -> str | None:
        """What a notebook shows; None: the line."""
        return None


class Shown:
    """A result that is shown by the view of its class. A dataclass leaves `repr` to it (`repr=False`)."""

    def __repr__(self) -> str:
        return view(type(self).__name__).line(self)

    def _repr_html_(self) -> str | None:
        return view(type(self).__name__).html(self)


def view(name: str) -> View:
    """The view of a class of this name; a plain one where no plugin provides any."""
    component = registry().components.get(("view", name))
    made: View = View() if component is None else component.load()()
    return made
