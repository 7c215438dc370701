"""What a run's spec asks of a controller on cells, read from `spec.json` alone: its goal, its cells and its inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import Array, Box, Ellipsoid, Goal, Region
from gapcert_cells import GridController, automaton_of, read_hoa
from gapcert_verify.evaluator import quantity


@final
@dataclass(frozen=True)
class Asked:
    """Sections of a spec; states: the box of the domain's; home: where paths start. Damage raises what damage raises."""

    spec: Mapping[str, Any]
    states: Box
    home: Path

    @property
    def section(self) -> Mapping[str, Any]:
        found: Mapping[str, Any] = self.spec["controller"]
        return found

    @cached_property
    def goal(self) -> Goal:
        """Without the cuts of polytopes, whose texts alone are compared (`cuts`)."""
        given, whole = self.section["goal"], self.states
        kind = next((k for k in _KINDS if given.get(k) is not None), "")
        part = given[kind]
        if kind == "invariance":
            return Goal("invariance", self._box(part))
        if kind == "reach":
            return Goal("reach_avoid", whole, self._region(part))
        if kind in ("ltl", "automaton"):
            read = automaton_of(part) if kind == "ltl" else read_hoa((self.home / part).read_text(), str(part))
            own = tuple(self._region(given["regions"][name]) for name in read.propositions)
            avoid = self._region(given["avoid"]) if given.get("avoid") else None
            return Goal("automaton", self._box(given.get("stay") or {}), None, avoid, read, own)
        avoid = self._region(part["avoid"]) if part.get("avoid") else None
        targeted: Any = kind
        return Goal(targeted, self._box(part.get("stay") or {}), self._region(part["target"]), avoid)

    @property
    def cuts(self) -> list[str]:
        """The texts of all linear inequalities of regions, in the order of the text."""
        return _cuts(self.section["goal"])

    def another(self, goal: Goal, kind: str) -> str:
        """Whether goal and kind are asked for."""
        if plain(goal) != plain(self.goal) or sorted(_told(goal)) != sorted(self.cuts):
            return "its goal is not that of the spec"
        asked = self.section.get("kind", "symbolic")
        return "" if kind == asked else f"it is said to be made by '{kind}', and the spec asks for '{asked}'"

    def differs(self, c: GridController, kind: str) -> str:
        """What of a saved controller is another than asked; "" where nothing is."""
        if (text := self.another(c.goal, kind)) or kind != "symbolic":
            return text
        names, wanted = self.states.names, self.section.get("on") or list(self.states.names)
        if sorted(wanted) != sorted(names[j] for j in c.on):
            return f"it has cells for {', '.join(names[j] for j in c.on)}, and the spec asks for {', '.join(wanted)}"
        return self._at_multiples(c) if self.section.get("align") == "scots" else self._tiled(c)

    def _tiled(self, c: GridController) -> str:
        """Edges and inputs as far apart as can be."""
        given, halvings = self.section, 0 if c.splits is None else c.splits.levels
        if halvings > given.get("refine", 0):
            return f"its cells are halved {halvings} times, and the spec asks for {given.get('refine', 0)}"
        for j, edges in zip(c.on, c.edges, strict=True):
            count = int(given["cells"][self.states.names[j]])
            if not np.array_equal(np.linspace(c.goal.stay.low[j], c.goal.stay.high[j], (count << halvings) + 1), edges):
                return f"the cells of {self.states.names[j]} are not the {count} that tile the goal's box"
        ranges = self._ranges
        values = [np.linspace(*ranges[n], int(given["inputs"][n])) for n in ranges]
        return _offered(c, values, 1e-12 * np.array([b - a for a, b in ranges.values()]))

    def _at_multiples(self, c: GridController) -> str:
        """Centres and inputs are multiples of eta, those that lie in the ranges."""
        eta = {n: _number(v) for n, v in self.section["eta"].items()}
        for j, edges in zip(c.on, c.edges, strict=True):
            name = self.states.names[j]
            at = (edges[:-1] + edges[1:]) / 2 / eta[name]
            if np.abs(at - np.round(at)).max() > 1e-6 or np.abs(np.diff(edges) / eta[name] - 1).max() > 1e-6:
                return f"the cells of {name} do not lie at multiples of {eta[name]:g}"
        values = []
        for name, (low, high) in self._ranges.items():
            first, last = np.ceil(low / eta[name] - 1e-6), np.floor(high / eta[name] + 1e-6)
            values.append(eta[name] * np.arange(first, last + 1))
        return _offered(c, values, 1e-9 * np.array([eta[n] for n in self._ranges]))

    @property
    def _ranges(self) -> dict[str, tuple[float, float]]:
        """Of the inputs in use."""
        inputs, given = self.spec["model"].get("inputs") or {}, self.section.get("input_range") or {}
        ends = {n: given.get(n) or self.spec["domain"][n] for n in inputs}
        return {n: (_number(low), _number(high)) for n, (low, high) in ends.items()}

    def _box(self, ranges: Mapping[str, Any]) -> Box:
        bounds = {n: [low, high] for n, low, high in zip(self.states.names, self.states.low, self.states.high, strict=True)}
        bounds |= {n: [_number(v) for v in ends] for n, ends in ranges.items()}
        return Box.of(self.states.axes, bounds)

    def _region(self, given: Any) -> Region:
        shapes = given if isinstance(given, list) else [given]
        rounds = [s for s in shapes if isinstance(s.get("centre"), Mapping)]
        boxes = [s for s in shapes if s not in rounds and "where" not in s]
        numbers = [tuple({n: _number(v) for n, v in s[k].items()} for k in ("centre", "radii")) for s in rounds]
        return Region(tuple(map(self._box, boxes)), (), tuple(Ellipsoid.of(self.states, *pair) for pair in numbers))


_KINDS = ("invariance", "reach", "reach_avoid", "reach_and_stay", "recurrence", "ltl", "automaton")


def plain(goal: Goal) -> Any:
    """A goal as data, without polytopes."""
    regions = [goal.target, goal.avoid, *goal.regions]
    parts = [r and [[b.bounds for b in r.boxes], [e.to_data() for e in r.ellipsoids]] for r in regions]
    automaton = goal.automaton and {k: v for k, v in goal.automaton.to_data().items() if k != "text"}
    return goal.kind, goal.stay, parts, automaton


def _told(goal: Goal) -> list[str]:
    """The texts of the inequalities of its polytopes, each as often as it makes one."""
    regions = [r for r in (goal.target, goal.avoid, *goal.regions) if r is not None]
    return list(dict.fromkeys(cut.text for r in regions for p in r.polytopes for cut in p.cuts))


def _cuts(given: Any) -> list[str]:
    if isinstance(given, Mapping):
        own = list(given["where"]) if isinstance(given.get("where"), list) else []
        return list(dict.fromkeys(own + [t for k, v in given.items() if k != "where" for t in _cuts(v)]))
    return list(dict.fromkeys(t for v in given for t in _cuts(v))) if isinstance(given, list) else []


def _offered(c: GridController, values: Sequence[Array], spare: Array) -> str:
    wanted, found = np.array(list(product(*values))), np.asarray(c.points)
    same = wanted.shape == found.shape and (np.abs(wanted - found) <= spare).all()
    return "" if same else f"its {len(found)} inputs are not the {len(wanted)} of the spec"


def _number(value: Any) -> float:
    """As specs have them: the middle of what a unit's factor may be rounded to."""
    low, high = quantity(value)
    return low if low == high else (low + high) / 2
