"""Before a search: what a log could show of every effect, what it does not excite, and what would look alike in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import Model, Recording, UsageError, load_spec

from .data.dataset import Dataset
from .data.feedback import Loop, loops
from .diagnose import Data, posed, rolled_out
from .results import Seen
from .search.fitted_sets import FittedSets
from .search.visible import Visible
from .section import DiagnoseConfig
from .thresholds import THRESHOLDS

Key = tuple[str, str]
_ROLLED_OUT = (
    "this model is an engine in contact, which is rolled out itself and not linearised: how small a number of it would be "
    "seen, and which of them would look alike, is not known before `gapcert diagnose` tries them"
)


@final
@dataclass(frozen=True)
class Preview:
    """What a log could show to the search with equations, were noise alone left of it.

    seen: the smallest size of every effect at every site that would be named; unseen: (effect, site) of which none would be;
    alike: classes of (effect, site) that look alike at their smallest sizes; unexcited: what the motion lacks, in sentences;
    floors: channel → noise floor, deviation of the data, root mean square that the model leaves before any search (in noise
    floors), unit; instead: why nothing of this can be said, where a model is rolled out by its engine.
    """

    seen: tuple[Seen, ...] = ()
    unseen: tuple[Key, ...] = ()
    alike: tuple[tuple[Key, ...], ...] = ()
    unexcited: tuple[str, ...] = ()
    loops: tuple[Loop, ...] = ()
    floors: Mapping[str, tuple[float, float, float, str]] | None = None
    instead: str = ""

    def summary(self) -> dict[str, Any]:
        """As plain data."""
        if self.instead:
            return {"instead": self.instead}
        names = ("noise_floor", "deviation", "left", "unit")
        return {
            "seen": [vars(s).copy() for s in self.seen],
            "unseen": [{"effect": e, "site": s} for e, s in self.unseen],
            "alike": [[{"effect": e, "site": s} for e, s in group] for group in self.alike],
            "unexcited": list(self.unexcited),
            "feedback": [vars(one) | {"sentence": one.told} for one in self.loops],
            "channels": {n: dict(zip(names, row, strict=True)) for n, row in (self.floors or {}).items()},
        }


def previewed(path: Path, allow_code: bool = False) -> Preview | None:
    """Of a spec with a model and a recording, None of any other; its `diagnose:` says which effects, on which data."""
    spec = load_spec(path)
    c = spec.config
    if c.model is None or c.recording is None:
        return None
    try:
        period = spec.build("recording").read().period if getattr(c.model, "period", 1) is None else None
        model: Model = spec.build("model", allow_code=allow_code, period=period)
        return preview(model, spec.build("recording", model=model).read(), c.sections.get("diagnose"), c.seed)
    except UsageError as error:
        raise spec.placed(error) from None


def preview(model: Model, recording: Recording, asked: DiagnoseConfig | None = None, seed: int = 0) -> Preview:
    """What `diagnose` could find in a recording, from the fit of nothing and its linearised motion."""
    if rolled_out(model) is not None:
        return Preview(instead=_ROLLED_OUT)
    asked = asked or DiagnoseConfig()
    held, train = (
        None if part is None else part.model_dump(exclude_none=True, by_alias=True) for part in (asked.hold_out, asked.train)
    )
    problem, _ = posed(model, recording, asked.effects, held, train, asked.horizons, asked.window, seed=seed, exact=asked.exact)
    data = Data.of(problem)
    search = FittedSets(data.library, data.windows.guard()[0])
    sight, m = Visible(search), data.library.measured
    known = {(s.effect, s.site) for s in sight.seen}
    left = np.sqrt(search.nothing.chi)
    sizes = zip(m.channels, m.sigma, m.spread, left, strict=True)
    floors = {c.name: (float(a), float(b), float(e), c.unit) for c, a, b, e in sizes}
    every = (*data.library.candidates, *data.library.aside)
    return Preview(
        sight.seen,
        tuple(c.key for c in every if c.key not in known and not c.effect.variant_of),
        tuple(g for group in sight.alike if len(g := tuple(k for k in group if k in known)) > 1),
        tuple(unexcited(model, m)),
        loops(model, m, seed),
        floors,
    )


def unexcited(model: Model, m: Dataset) -> Iterator[str]:
    """What the inputs and the motion lack, and what that hides, in sentences."""
    x, u = np.concatenate(m.states), np.concatenate(m.inputs)
    for i, s in enumerate(model.inputs):
        low, high = float(u[:, i].min()), float(u[:, i].max())
        if high - low <= THRESHOLDS.still * max(abs(low), abs(high)):
            yield f"{s.name} never changes: what acts on it looks like an offset, or cannot be seen at all"
        elif low >= 0 or high <= 0:
            yield f"{s.name} never changes its sign: what differs between its signs cannot be seen"
    states = {s.name: x[:, i] for i, s in enumerate(model.states) if s.size == 1}
    moved = {c.name: spread / sigma for c, spread, sigma in zip(m.channels, m.spread, m.sigma, strict=True)}
    for q in model.sites("coordinate"):
        if moved.get(q, np.inf) < THRESHOLDS.still_floors:
            yield f"{q} moves by little more than its noise: what acts there can hardly be sized"
        elif (speed := states.get(f"{q}_dot")) is not None:
            slow, fast = np.quantile(speed, THRESHOLDS.most_speeds)
            if slow > 0 or fast < 0:
                yield (
                    f"{q} moves in one direction only: dry friction looks like a constant force, and what differs between "
                    "directions, or needs a reversal, cannot be seen"
                )
            if np.std(np.abs(speed)) < THRESHOLDS.steady_speed * np.mean(np.abs(speed)):
                yield f"the speed of {q} hardly varies: laws of friction look alike"
