"""What a controller is asked for: to stay, to reach, or a sequence of regions that an automaton accepts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, final, get_args

import numpy as np

from gapcert.contracts.systems.domain import Box, Domain, turned
from gapcert.contracts.systems.region import Region
from gapcert.contracts.systems.system import Model, StateSpec
from gapcert.numerics.arrays import Array, Bools, Ints
from gapcert.numerics.errors import UsageError

Kind = Literal["invariance", "reach_avoid", "reach_and_stay", "recurrence", "automaton"]
TARGETED = ("reach_avoid", "reach_and_stay", "recurrence")
MOST = 8  # propositions: an automaton has two to their number letters


@final
@dataclass(frozen=True)
class Automaton:
    """A deterministic Büchi automaton: a word of letters is accepted if its run visits accepting states again and again.

    A letter is the set of propositions that hold, as a number: bit p is proposition p. after[q][letter] is the next state, −1
    where none is left. `text`: what it was made of.
    """

    propositions: tuple[str, ...]
    after: tuple[tuple[int, ...], ...]
    accepting: tuple[bool, ...]
    start: int = 0
    text: str = ""

    def __post_init__(self) -> None:
        letters, states = 1 << len(self.propositions), len(self.after)
        if len(self.propositions) > MOST:
            raise UsageError(f"automaton: {len(self.propositions)} propositions; at most {MOST} are supported")
        fits = all(len(row) == letters and all(-1 <= q < states for q in row) for row in self.after)
        if not fits or not 0 <= self.start < states or len(self.accepting) != states:
            raise UsageError(f"automaton: its table does not fit {states} states and {letters} letters")

    @property
    def table(self) -> Ints:
        """`after` as numbers (states, letters)."""
        return np.array(self.after, dtype=np.int64)

    @property
    def done(self) -> Bools:
        """(states,): accepting, and every letter leads back: what comes later does not matter."""
        own = np.arange(len(self.after))[:, None]
        return np.asarray(np.array(self.accepting) & (self.table == own).all(axis=1))

    @property
    def ends(self) -> bool:
        """Does every accepted word have a beginning that suffices?"""
        return bool((self.done == np.array(self.accepting)).all())

    def advance(self, state: Ints, letter: Ints) -> Ints:
        """States after one more letter; −1 stays."""
        return np.where(state < 0, -1, self.table[state, letter])

    def to_data(self) -> dict[str, Any]:
        """JSON-able; `from_data` is its inverse."""
        return {
            "propositions": list(self.propositions),
            "after": [list(row) for row in self.after],
            "accepting": list(self.accepting),
            "start": self.start,
            "text": self.text,
        }

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Automaton:
        after = tuple(tuple(row) for row in data["after"])
        return cls(tuple(data["propositions"]), after, tuple(data["accepting"]), data["start"], data["text"])


@final
@dataclass(frozen=True)
class Goal:
    """`invariance`: stay in `stay` for ever. `reach_avoid`: reach `target`, never touch `avoid`, and stay in `stay` until then.

    `reach_and_stay`: from some moment on never leave `target`, for ever in `stay` and never in `avoid`. `recurrence`: visit
    `target` again and again, with the same for ever. `automaton`: the sequence of the regions that the state is in, one per
    proposition and moment, is accepted, in `stay` and never in `avoid` as long as that is open. UsageError where the parts do
    not fit together.
    """

    kind: Kind
    stay: Box
    target: Region | None = None
    avoid: Region | None = None
    automaton: Automaton | None = None
    regions: tuple[Region, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise UsageError(f"goal: kind '{self.kind}' is unknown; use one of {', '.join(get_args(Kind))}")
        if (self.kind in TARGETED) != (self.target is not None and bool(self.target.hulls)):
            wanted = "needs a target" if self.kind in TARGETED else "has no target; use reach_avoid, or leave it out"
            raise UsageError(f"goal: {self.kind} {wanted}")
        propositions = self.automaton.propositions if self.automaton else ()
        if (self.kind == "automaton") != (self.automaton is not None) or len(propositions) != len(self.regions):
            raise UsageError(f"goal: {self.kind} with {len(self.regions)} regions; an automaton needs one per proposition")
        named = zip(propositions, self.regions, strict=True)
        for part, region in (("target", self.target), ("avoid", self.avoid), *((f"region {n}", r) for n, r in named)):
            for box in region.hulls if region else ():
                if box.axes != self.stay.axes:
                    raise UsageError(f"goal: {part} is over {', '.join(box.names)}; expected {', '.join(self.stay.names)}")
        for box in self.target.boxes if self.target else ():
            _inside("target", box, "stay", self.stay)

    def check(self, domain: Domain, model: Model) -> None:
        """UsageError unless the goal lies inside the domain, and f repeats along its angles that close on themselves."""
        if self.stay.axes != domain.states.axes:
            names = ", ".join(domain.states.names)
            raise UsageError(f"goal: stay is over {', '.join(self.stay.names)}; expected the model's states {names}")
        _inside("stay", self.stay, "the domain", domain.states)
        for axis, wraps in zip(self.stay.axes, self.stay.wraps, strict=True):
            if wraps and (why := model.repeats(axis.name)):
                what = f"goal: stay closes on itself along {axis.name}, and the model does not repeat there: {why}"
                raise UsageError(f"{what}; expected a model that does, or a goal over part of the turn")

    def holds(self, x: Array) -> Bools:
        """(n,) booleans: in `stay` and not in `avoid`, for states (n, nx), on the turn of `stay` as cells are."""
        x = turned(self.stay, x)
        inside = self.stay.contains(x)
        return inside if self.avoid is None else inside & ~self.avoid.contains(x)

    def reached(self, x: Array) -> Bools:
        """(n,) booleans: the goal is over, successfully. Only reach-avoid ends."""
        return self.visited(x) if self.kind == "reach_avoid" else np.zeros(len(x), dtype=bool)

    def visited(self, x: Array) -> Bools:
        """(n,) booleans: in the target, and the goal holds."""
        x = turned(self.stay, x)
        return np.zeros(len(x), dtype=bool) if self.target is None else self.target.contains(x) & self.holds(x)

    def letter(self, x: Array) -> Ints:
        """(n,): the regions that the states are in, bit p for region p."""
        x, out = turned(self.stay, x), np.zeros(len(x), dtype=np.int64)
        for p, region in enumerate(self.regions):
            out |= region.contains(x).astype(np.int64) << p
        return out

    def to_data(self) -> dict[str, Any]:
        """JSON-able; `from_data` is its inverse, bit for bit."""
        data: dict[str, Any] = {
            "kind": self.kind,
            "axes": [[a.name, a.unit, a.kind] for a in self.stay.axes],
            "stay": self.stay.bounds,
        }
        regions = {"target": self.target, "avoid": self.avoid}
        data |= {name: region.to_data() for name, region in regions.items() if region is not None}
        if self.automaton is not None:
            data |= {"automaton": self.automaton.to_data(), "regions": [r.to_data() for r in self.regions]}
        return data

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> Goal:
        axes = tuple(StateSpec(*a) for a in data["axes"])

        def region(name: str) -> Region | None:
            return Region.from_data(axes, data[name]) if name in data else None

        automaton = Automaton.from_data(data["automaton"]) if "automaton" in data else None
        regions = tuple(Region.from_data(axes, r) for r in data.get("regions", ()))
        return cls(data["kind"], Box.of(axes, data["stay"]), region("target"), region("avoid"), automaton, regions)


def _inside(name: str, inner: Box, frame: str, outer: Box) -> None:
    for j, (axis, a, b, low, high) in enumerate(zip(inner.axes, inner.low, inner.high, outer.low, outer.high, strict=True)):
        # Along an axis that closes on itself a target may be anywhere.
        if (a < low or b > high) and not (name == "target" and outer.wraps[j]):
            raise UsageError(
                f"goal: {name} asks for {axis.name} in [{a:g}, {b:g}] {axis.unit}, but {frame} is [{low:g}, {high:g}]; "
                f"narrow the goal or widen {frame}"
            )
