"""Saved controllers, whatever made them: which class loads one is for its synthesizer to say, never for the file."""

from __future__ import annotations

from pathlib import Path

from gapcert.plugin import Controller, MissingDependency, UsageError, load, registry

from .automaton_controller import AutomatonController
from .files import loading, saved_data
from .grid_controller import GridController


def load_controller(folder: Path | str) -> Controller:
    """The controller that `save` wrote into a folder.

    Its `kind` is a synthesizer, and the class that this declares as `Component.controller` loads it; one on cells loads without
    the synthesizer. UsageError for files that are absent or damaged, MissingDependency where the synthesizer cannot be loaded.
    """
    folder = Path(folder)
    data = saved_data(folder)
    kind = data.get("kind")
    if not isinstance(kind, str):
        raise UsageError(f"{folder}: the saved controller is damaged (kind is {kind!r}); synthesize it again")
    maker = registry().components.get(("synthesizer", kind))
    if maker is not None and maker.controller:
        if (reason := maker.missing()) is not None:
            raise MissingDependency(f"{folder}: {reason}")
        made = load(maker.controller).load(folder)
        if not isinstance(made, Controller):
            raise UsageError(
                f"{folder}: {maker.controller} of {maker.distribution} has loaded a {type(made).__name__}; expected "
                "a gapcert.Controller; ask its author"
            )
        return made
    if (folder / "controller.npz").exists():
        with loading(folder) as (data, arrays):
            on_cells, remembers = "bits" in arrays.files, "automaton" in data["goal"]
        if on_cells:
            return (AutomatonController if remembers else GridController).load(folder)
    if maker is None:
        known = ", ".join(registry().names("synthesizer"))
        raise MissingDependency(
            f"{folder}: the controller was made by synthesizer '{kind}', which no installed plugin provides (there are "
            f"{known}); install the package that does"
        )
    raise UsageError(
        f"{folder}: synthesizer '{kind}' of {maker.distribution} does not say how its controllers are loaded; expected "
        f"`controller` in its Component"
    )
