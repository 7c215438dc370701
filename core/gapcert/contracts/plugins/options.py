"""What the core asks of a component's options: methods of their model, since what an option is called tells nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple


class Keyed(NamedTuple):
    """An option that goes by names of the model's states or inputs: a list of some, or a mapping from all that are `among`.

    Not `every`: from some. What the names stand for may be `ranges` or `quantities`, in the units of the model.
    """

    option: str
    axes: Literal["states", "inputs"]
    among: Sequence[str] | None = None
    every: bool = True
    values: Literal["", "ranges", "quantities"] = ""


class ConfigContract:
    """Methods that the model of a component's options may have; these are those of one that has none.

    They are looked up on its class, so that an option of the same name is just an option.
    """

    def check(self) -> Iterable[tuple[Any, str, int | None]]:
        """(path, message, offset in its text) of whatever types cannot say."""
        return ()

    def keyed(self) -> Iterable[Keyed]:
        """Options that go by names of the model."""
        return ()

    def paths(self) -> Iterable[tuple[tuple[str | int, ...], Path]]:
        """(path, file) of what names a file and is no `Path`."""
        return ()

    def settings(self) -> Mapping[str, Sequence[Any]]:
        """Of a backend, what may be tried: option, as a dotted path → values.

        A value that is a mapping of dotted paths changes these options together, under the setting's name.
        """
        return {}

    def axes(self) -> tuple[Mapping[str, str], Mapping[str, str]] | None:
        """Of a model or a backend, name → unit of its states and inputs, empty where only a run can tell; None: its options
        `states`, or `coordinates`, and `inputs` say so.
        """
        return None

    def untimed(self) -> bool:
        """Of a model: is its period left to a recording?"""
        return False

    def channels(self) -> tuple[str, Mapping[str, str]] | None:
        """Of a reader: the option that says so, and channel of the model → column; None: nothing is known."""
        return None

    def resampled(self) -> str:
        """Of a reader: the option by which rows are not as they were measured; empty: they are."""
        return ""

    def headline(self) -> str | None:
        """Of a synthesizer: the policy by which its controllers are judged first; None: any."""
        return None


def of_config(config: Any, name: str) -> Any:
    """What a config (or none) answers to a method of `ConfigContract`."""
    own = getattr(type(config), name, None)
    return (own if callable(own) else getattr(ConfigContract, name))(config)
