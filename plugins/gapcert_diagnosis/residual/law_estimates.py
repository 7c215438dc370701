"""The law that data alone suggest, beside the one that was named.

Along the motion of the last fit, what the named effects add is known, and small further forces, constant on intervals of one
quantity, move the measured channels to first order as the linearised motion does. Their least-squares sizes, added to the
named law, are what the data ask for in each interval, whatever the law.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Extension, Model, difference, site_units
from gapcert_diagnosis.data.dataset import Windows, flat
from gapcert_diagnosis.fitting.fit import Fit
from gapcert_diagnosis.fitting.hypothesis import Hypothesis
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.results import Correction
from gapcert_diagnosis.search.candidates import Candidate, Causes, Library, sliding, velocity
from gapcert_diagnosis.thresholds import THRESHOLDS
from gapcert_figures import Law, called

Members = npt.NDArray[np.intp]


@final
@dataclass(frozen=True)
class Axis:
    """A quantity along the path, (W, S) at every model step."""

    name: str
    unit: str
    values: Array

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]"


@final
@dataclass(frozen=True)
class Place:
    """Where forces act: their name, unit, the state column that they move first, and ∂x⁺/∂force (W, S, nx)."""

    site: str
    label: str
    column: int
    response: Array

    def size(self, moved: Array) -> Array:
        """The force (W, S) that moves the next state by `moved` (W, S, nx)."""
        return np.asarray(moved[..., self.column] / self.response[..., self.column])


@final
class Fitted:
    """The last fit along its own motion: what each cause adds there, and what small further forces would do."""

    def __init__(self, library: Library, causes: Causes, fitted: Fit, windows: Windows) -> None:
        self.library, self.causes, self.windows = library, causes, windows
        self.values = dict(zip(fitted.hypothesis.names, map(float, fitted.theta), strict=True))
        self.base, self.full = self.without(causes), library.extended(causes, self.values)
        self.tangent = Tangent.of(self.full, windows, fitted)
        self.x, self.u = self.tangent.x, self.tangent.u
        self.places: dict[tuple[str, str], Place] = {}

    @property
    def flat(self) -> tuple[Array, Array]:
        return flat(self.x), flat(self.u)

    def without(self, group: Causes) -> Model:
        """The model with the other causes, and with the stated values of what the group frees."""
        freed = {self.library.extension(c).frees for c in group}
        kept = tuple(c for c in self.causes if c not in group)
        return self.library.extended(kept, {n: v for n, v in self.values.items() if n not in freed})

    def next(self, model: Model) -> Array:
        """One step of a model from every state of the path, (W, S, nx); what it remembers is rolled along."""
        known = Hypothesis(model).remembering(self.windows, np.empty(0)).memory
        return model.along(self.x, self.u, hidden=known)

    @cached_property
    def after(self) -> Array:
        return self.next(self.full)

    @cached_property
    def _still(self) -> Array:
        """One step of the model without causes, (W·S, nx)."""
        return self.base.step(*self.flat).x

    def added(self, group: Causes) -> Array:
        """What the causes of a group add to the next state, all others kept: (W, S, nx)."""
        return self.tangent.once(group, lambda: difference(self.base.states, self.after, self.next(self.without(group))))

    def place(self, site: str, kind: str) -> Place:
        """Where a coordinate or an input acts."""
        if (site, kind) not in self.places:
            self.places[site, kind] = self._place(site, kind)
        return self.places[site, kind]

    def _place(self, site: str, kind: str) -> Place:
        x, u = self.flat
        if kind == "input":
            i = [s.name for s in self.base.inputs].index(site)
            size, unit = float(np.std(u[:, i])) or 1.0, self.base.inputs[i].unit
            on = u + size * (np.arange(self.base.nu) == i)
            moved = difference(self.base.states, self.base.step(x, on).x, self._still) / size
            label = f"missing input [{unit}]"
        else:
            moved = sliding(self.base, site, x, u, self._still if "forces" in self.base.capabilities else None)
            label = f"missing force [{site_units(self.base, 'coordinate', site)['force']}]"
        column = self.tangent.place(site)[1] if kind == "coordinate" else velocity(self.base, site, moved)
        return Place(site, label, column, moved.reshape(self.x.shape))

    def axes(self, place: Place) -> list[Axis]:
        """What a law at a place may depend on: its own input, velocity and position, the other states and inputs."""
        states = [Axis(s.name, s.unit, self.x[..., i]) for i, s in enumerate(self.base.states) if s.size == 1]
        own = [place.column] + [i for i, s in enumerate(self.base.states) if s.name == place.site and i != place.column]
        rest = [i for i in range(len(states)) if i not in own]
        inputs = [Axis(s.name, s.unit, self.u[..., i]) for i, s in enumerate(self.base.inputs)]
        mine = [a for a in inputs if a.name == place.site]
        return [*mine, *(states[i] for i in (*own, *rest)), *(a for a in inputs if a not in mine)]

    @property
    def time(self) -> Axis:
        steps = self.base.period * np.arange(self.x.shape[1])
        return Axis("time", "s", self.windows.t[:, None] + steps)

    def asked(self, place: Place, member: Members) -> tuple[Array, Array]:
        """Further forces (K,) that the data ask for where `member` (W, S) says which of K applies, and 95 % half widths."""
        count = int(member.max()) + 1
        j = self.tangent.driven(place.response, np.eye(count)[member])
        rows = j.reshape(-1, count)
        gram = rows.T @ rows
        gram += 1e-9 * np.trace(gram) / count * np.eye(count)
        covariance, along = np.linalg.inv(gram), (self.tangent.residual[:, None] @ j)[:, 0]
        further = covariance @ along.sum(axis=0)
        # What these forces leave may be of any colour: windows are independent, samples need not be.
        score = along - ((j @ further)[:, None] @ j)[:, 0]
        robust = covariance @ (score.T @ score) @ covariance
        variance = np.maximum(np.diag(robust), np.diag(covariance)) * len(j) / max(1, len(j) - 1)
        return further, 1.96 * np.sqrt(variance)


def intervals(values: Array, count: int) -> Members:
    """Which of `count` intervals each value is in; their edges lie between equal widths and equal numbers."""
    share = np.linspace(0, 1, count + 1)
    edges = (np.quantile(values, share) + values.min() + share * np.ptp(values)) / 2
    return np.clip(np.digitize(values, edges[1:-1]), 0, count - 1)


def means(values: Array, member: Members, count: int) -> Array:
    """The mean (K,) of values in each interval; NaN where there is none."""
    sizes = np.bincount(member.ravel(), minlength=count)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(member.ravel(), values.ravel(), count) / sizes)


def carried(law: Array, axis: Axis) -> float:
    """The share of a law's variance along the path that is a function of one quantity."""
    member = intervals(axis.values, 2 * THRESHOLDS.quantity_intervals)
    spread = float(np.var(law))
    if spread <= 1e-12 * float(np.mean(law**2)):
        return 1.0
    left = law - np.nan_to_num(means(law, member, 2 * THRESHOLDS.quantity_intervals))[member]
    return 1 - float(np.mean(left**2)) / spread


def laws(path: Fitted, correction: Correction | None = None) -> tuple[Law, ...]:
    """Every named law at its place against the quantity that carries it, then what is left at all coordinates.

    Through what is left goes the correction that data alone suggest, where there is one.
    """
    groups = list(_groups(path))
    drawn = [_law(path, place, group, axis, law) for place, group, axis, law in groups]
    for site in path.base.sites("coordinate"):
        if len(drawn) >= THRESHOLDS.law_pictures:
            break
        place = path.place(site, "coordinate")
        axes, nothing = path.axes(place)[: THRESHOLDS.law_pictures - len(drawn)], np.zeros(path.x.shape[:2])
        left = [_law(path, place, (), axis, nothing) for axis in axes]
        if correction is not None and correction.site == site:
            left = [_corrected(path, place, axis, one, correction) for axis, one in zip(axes, left, strict=True)]
        drawn += [replace(one, lead=not path.causes and i == 0) for i, one in enumerate(left)]
    return tuple(drawn[: THRESHOLDS.law_pictures])


def _corrected(path: Fitted, place: Place, axis: Axis, left: Law, correction: Correction) -> Law:
    if correction.extension is None:
        return left
    with_it = path.full.extend([correction.extension])
    law = place.size(difference(path.base.states, path.next(with_it), path.after))
    shape = "line" if carried(law, axis) >= THRESHOLDS.carrying_share else "cloud"
    at, line = _drawn(shape, axis.values, law)
    return replace(left, at=at, law=line, shape=shape, named="correction from data")


def _groups(path: Fitted) -> Sequence[tuple[Place, Causes, Axis, Array]]:
    """(place, causes, quantity, their law (W, S)): causes at one place that depend on one quantity are one law."""
    groups: dict[tuple[str, str], list[Candidate]] = {}
    where: dict[tuple[str, str], tuple[Place, Axis]] = {}
    for c in path.causes:
        if c.effect.site == "output":
            continue
        place = _place(path, c)
        law = place.size(path.added((c,)))
        axes = path.axes(place)
        shares = [carried(law, a) for a in axes]
        timed = "{t}" in (path.library.extension(c).force or "")
        axis = path.time if timed else axes[next(i for i, s in enumerate(shares) if s >= max(shares) - THRESHOLDS.equal_shares)]
        if max(shares) < THRESHOLDS.carrying_share and _remembers(path.library.extension(c)):
            axis = _turned(path, c, place, axes) or axis
        # A law that no single quantity carries stands alone.
        key = place.site, f"{axis.name} {c.effect.name}" if max(shares) < THRESHOLDS.carrying_share or timed else axis.name
        groups.setdefault(key, []).append(c)
        where[key] = place, axis
    return [(place, g, axis, place.size(path.added(g))) for k, (place, axis) in where.items() for g in (tuple(groups[k]),)]


def _turned(path: Fitted, c: Candidate, place: Place, axes: list[Axis]) -> Axis | None:
    """Against what a law with memory is a loop: the input itself, or what its memory follows, force or position."""
    inputs = [s.name for s in path.base.inputs]
    follows = any("{f}" in m.next for m in path.library.extension(c).memory)
    return next((a for a in axes if (a.name in inputs if follows else a.name == place.site)), None)


def _place(path: Fitted, c: Candidate) -> Place:
    """Of a parameter: the one of all known by now, coordinates among them, whose motion it changes most."""
    if c.effect.site != "parameter":
        return path.place(c.site, c.effect.site)
    moved, spread = path.added((c,)), np.std(path.x, axis=(0, 1)) + 1e-300
    for q in path.base.sites("coordinate"):
        path.place(q, "coordinate")
    return max(path.places.values(), key=lambda p: float(np.sqrt(np.mean(moved[..., p.column] ** 2)) / spread[p.column]))


def _law(path: Fitted, place: Place, group: Causes, axis: Axis, law: Array) -> Law:
    timed = axis.name == "time"
    remembers = any(_remembers(path.library.extension(c)) for c in group)
    shape = "line" if timed or carried(law, axis) >= THRESHOLDS.carrying_share else "loop" if remembers else "cloud"
    # What happens once is looked at where it happens.
    row = int(np.argmax(np.ptp(law, axis=1)))
    member = np.full(axis.values.shape, 2 * THRESHOLDS.quantity_intervals)
    rows = slice(row, row + 1) if timed else slice(None)
    member[rows] = intervals(axis.values[rows], THRESHOLDS.quantity_intervals)
    if shape == "loop":
        # What remembers differs between rising and falling.
        member += THRESHOLDS.quantity_intervals * (np.gradient(axis.values, axis=1) >= 0)
    label, member = np.unique(member, return_inverse=True)
    member = member.reshape(axis.values.shape)
    further, half = path.asked(place, member)
    x, y = means(axis.values, member, len(label)), means(law, member, len(label)) + further
    at, line = (np.empty(0), np.empty(0)) if not group else _drawn(shape, axis.values[rows], law[rows])
    reach = max(3 * float(np.median(half)), THRESHOLDS.wide_interval * float(np.ptp(law)) if group else 0.0)
    keep = (half <= reach) & (label < 2 * THRESHOLDS.quantity_intervals)
    names = " and ".join(called(*c.key).removesuffix(f" at {place.site}") for c in group)
    title = f"{names or 'what is left'} at {place.site}"
    up = (label[keep] >= THRESHOLDS.quantity_intervals).astype(np.float64) if shape == "loop" else np.empty(0)
    return Law(title, axis.label, place.label, x[keep], y[keep], at, line, half[keep], up, shape)


def _remembers(e: Extension) -> bool:
    return bool(e.memory or e.delay)


def _drawn(shape: str, x: Array, law: Array) -> tuple[Array, Array]:
    """The law over the path: in order of x, or of time where it is a loop, over the windows where it is largest."""
    if shape == "loop":
        rows = np.argsort(-np.ptp(law, axis=1), kind="stable")[: THRESHOLDS.loop_windows]
        apart = np.full((len(rows), 1), np.nan)
        return np.hstack([x[rows], apart]).ravel(), np.hstack([law[rows], apart]).ravel()
    order = np.argsort(x, axis=None)
    pick = order[np.unique(np.linspace(0, order.size - 1, THRESHOLDS.line_points).astype(int))]
    return x.ravel()[pick], law.ravel()[pick]


def outputs(path: Fitted) -> tuple[Law, ...]:
    """What named faults of sensors add to a reading, against the reading without them."""
    m, w, drawn = path.windows.measured, path.windows, []
    last = path.tangent.fitted
    h, at = last.hypothesis, (last.theta[None], last.start[None])
    x = h.motion(w, *at, every=m.repeat)
    u = flat(np.ascontiguousarray(w.u[:, m.history :]))
    plain = path.base.output(x.reshape(-1, path.base.nx), u)[:, list(m.columns)].reshape(w.y.shape)
    read = difference(m.channels, h.simulate(w, *at)[0], plain)
    names: Mapping[str, int] = {c.name: i for i, c in enumerate(m.channels)}
    for c in path.causes:
        if c.effect.site != "output" or c.site not in names:
            continue
        i = names[c.site]
        true, law, left = plain[..., i], read[..., i], -last.residual[..., i] * m.sigma[i]
        member = np.unique(intervals(true, THRESHOLDS.quantity_intervals), return_inverse=True)[1].reshape(true.shape)
        sizes = np.bincount(member.ravel())
        half = 1.96 * np.sqrt(means(left**2, member, len(sizes)) / sizes / last.whiteness[i])
        axis = Axis(c.site, m.channels[i].unit, true)
        shape = "line" if carried(law, axis) >= THRESHOLDS.carrying_share else "loop"
        y, mid = means(law + left, member, len(sizes)), means(true, member, len(sizes))
        label = f"added to the reading [{m.channels[i].unit}]"
        drawn.append(Law(called(*c.key), axis.label, label, mid, y, *_drawn(shape, true, law), half, shape=shape))
    return tuple(drawn)
