"""What a diagnosis shows, made from its fits: held-out motions, laws, what each cause explained, and what is left.

Beside each named law stands what data alone suggest. Along the motion of the last fit, what the named effects add is known,
and small further forces, constant on intervals of one quantity, move the measured channels to first order as the linearised
motion does. Their least-squares sizes, added to the named law, are what the data ask for in each interval, whatever the law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import Array, Extension, Model, difference, site_units
from gapcert_figures import Channel, Correlation, Course, DiagnosisFigure, Law, Signal, Waterfall, called, per_second

from .data.dataset import flat, once
from .fitting.fit import Fit
from .fitting.hypothesis import Hypothesis
from .fitting.linearised import Tangent, sliding, velocity
from .fitting.rollout_error import Stretches
from .results import Correction, Experiment
from .search.candidates import Candidate, Causes, Library
from .thresholds import THRESHOLDS

if TYPE_CHECKING:
    from .search.fitted_sets import FittedSets

LAGS, SLOW = 0.5, 24  # s; samples that are looked at where these are far apart
CHANNELS = 4  # whose correlations are drawn
_Members = npt.NDArray[np.intp]


def figure(
    search: FittedSets,
    causes: Causes,
    last: Fit,
    judge: Stretches,
    design: Experiment | None = None,
    correction: Correction | None = None,
    plain: tuple[str, Fit] | None = None,
) -> DiagnosisFigure:
    """`last` is the fit of the causes, in the order listed, over the windows of the search.

    plain: what settings were changed before all of them, and the fit of nothing without that.
    """
    steps = [(causes, last)]
    while rest := steps[0][0]:
        steps.insert(0, (rest[:-1], search.fit(rest[:-1], steps[0])))
    named = [called(*c[-1].told) for c, _ in steps[1:]]
    fits = [f for _, f in steps]
    if plain is not None:
        named, fits = [plain[0], *named], [plain[1], *fits]
    first, path = fits[0], _Fitted(search.library, causes, last)
    return DiagnosisFigure(
        _channels(judge, first, last),
        _laws(path, correction) + _outputs(path),
        Waterfall(("none of the causes", *named), np.array([judge.error(f) for f in fits])) if named else None,
        tuple(_correlations(first, last)),
        tuple(_courses(first, last)),
        () if design is None else _signals(design, search.library.model),
    )


def _channels(judge: Stretches, first: Fit, last: Fit) -> tuple[Channel, ...]:
    """The held-out rollout of the longest horizon whose error before is the median."""
    m, w = judge.windows.measured, judge.windows
    before, after = judge.simulate(first), judge.simulate(last)
    error = np.mean(((before - w.y[:, judge.lead :]) / m.spread) ** 2, axis=(1, 2))
    k = int(np.argsort(error)[len(error) // 2])
    t = w.t[k] + m.period * (judge.lead + np.arange(w.length - judge.lead))
    y = w.y[k, judge.lead :]
    return tuple(Channel(c.name, c.unit, t, y[:, i], before[k, :, i], after[k, :, i]) for i, c in enumerate(m.channels))


def _correlations(first: Fit, last: Fit) -> list[Correlation]:
    """Per channel the residual's autocorrelation, and its correlation with the input that it follows most."""
    windows, m, model = last.windows, last.windows.measured, last.hypothesis.model
    reach = min(max(m.samples(LAGS), SLOW), windows.length // 2)
    band = 1.96 / math.sqrt(last.residual.shape[0] * last.residual.shape[1])
    inputs = windows.u[:, m.history :]
    out = []
    for i, c in enumerate(m.channels[:CHANNELS]):
        old, new = (f.residual[..., i] for f in (first, last))
        lag = m.period * np.arange(1.0, reach + 1)
        own = [correlation(r, r, reach)[reach + 1 :] for r in (old, new)]
        out.append(Correlation(c.name, "itself", lag, own[0], own[1], band))
        both = [(correlation(old, inputs[..., j], reach), correlation(new, inputs[..., j], reach)) for j in range(model.nu)]
        if both:
            j = int(np.argmax([np.abs(before).max() for before, _ in both]))
            lag = m.period * np.arange(-float(reach), reach + 1)
            out.append(Correlation(c.name, model.inputs[j].name, lag, *both[j], band))
    return out


def correlation(a: Array, b: Array, reach: int) -> Array:
    """ρ(k) = Σ a(t + k) b(t)/√(Σ a² Σ b²) of rows (W, L), about their means, for lags −reach … reach."""
    a, b = a - a.mean(), b - b.mean()
    count = 2 * a.shape[1]
    sums = np.fft.irfft(np.sum(np.fft.rfft(a, count, axis=1) * np.fft.rfft(b, count, axis=1).conj(), axis=0), count)
    size = math.sqrt(float(np.sum(a**2) * np.sum(b**2)))
    return np.asarray(np.concatenate([sums[count - reach :], sums[: reach + 1]]) / (size + 1e-300))


def _courses(first: Fit, last: Fit) -> list[Course]:
    windows, seen = last.windows, np.sum(last.windows.weight**2, axis=(1, 2))
    rms = [np.sqrt(np.sum(f.residual**2, axis=(1, 2)) / seen) for f in (first, last)]
    out = []
    for i in np.unique(windows.trajectory):
        rows = np.flatnonzero(windows.trajectory == i)
        rows = rows[np.argsort(windows.t[rows])]
        out.append(Course(windows.t[rows], rms[0][rows], rms[1][rows]))
    return out


def _signals(design: Experiment, model: Model) -> tuple[Signal, ...]:
    units = {s.name: s.unit for s in model.inputs}
    out = [Signal(n, units.get(n, "1"), design.t, v) for n, v in design.inputs.items()]
    for n, moved in design.travel.items():
        y, step = design.predicted[n], design.t[1] - design.t[0]
        rate = np.append(np.diff(y, axis=1), y[:, -1:] - y[:, -2:-1], axis=1) / step
        fast = moved.recorded_speed * np.array([-1.0, 1.0])
        out += [Signal(n, moved.unit, design.t, y, np.array(moved.recorded))]
        out += [Signal(f"speed of {n}", per_second(moved.unit), design.t, rate, fast)]
    return tuple(out)


@final
@dataclass(frozen=True)
class _Axis:
    """A quantity along the path, (W, S) at every model step."""

    name: str
    unit: str
    values: Array

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit}]"


@final
@dataclass(frozen=True)
class _Place:
    """Where forces act: their name, unit, the state column that they move first, and ∂x⁺/∂force (W, S, nx)."""

    site: str
    label: str
    column: int
    response: Array

    def size(self, moved: Array) -> Array:
        """The force (W, S) that moves the next state by `moved` (W, S, nx)."""
        return np.asarray(moved[..., self.column] / self.response[..., self.column])


@final
class _Fitted:
    """The last fit along its own motion: what each cause adds there, and what small further forces would do."""

    def __init__(self, library: Library, causes: Causes, fitted: Fit) -> None:
        self.library, self.causes, self.windows = library, causes, fitted.windows
        self.values = fitted.values
        self.base, self.full = self.without(causes), library.extended(causes, self.values)
        self.tangent = Tangent.of(self.full, fitted)
        self.x, self.u = self.tangent.x, self.tangent.u
        self.places: dict[tuple[str, str], _Place] = {}

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

    def place(self, site: str, kind: str) -> _Place:
        """Where a coordinate or an input acts."""
        return once(self.places, (site, kind), lambda: self._place(site, kind))

    def _place(self, site: str, kind: str) -> _Place:
        x, u = self.flat
        if kind == "input":
            i = [s.name for s in self.base.inputs].index(site)
            # The deviation of a constant is its rounding.
            size, unit = max(float(np.std(u[:, i])), 1e-3 * float(np.abs(u[:, i]).max())) or 1.0, self.base.inputs[i].unit
            on = u + size * (np.arange(self.base.nu) == i)
            moved = difference(self.base.states, self.base.step(x, on).x, self._still) / size
            label = f"missing input [{unit}]"
        else:
            moved = sliding(self.base, site, x, u, self._still if "forces" in self.base.capabilities else None)
            label = f"missing force [{site_units(self.base, 'coordinate', site)['force']}]"
        column = self.tangent.place(site)[1] if kind == "coordinate" else velocity(self.base, site, moved)
        return _Place(site, label, column, moved.reshape(self.x.shape))

    def axes(self, place: _Place) -> list[_Axis]:
        """What a law at a place may depend on: its own input, velocity and position, the other states and inputs."""
        states = [_Axis(s.name, s.unit, self.x[..., i]) for i, s in enumerate(self.base.states) if s.size == 1]
        own = [place.column] + [i for i, s in enumerate(self.base.states) if s.name == place.site and i != place.column]
        rest = [i for i in range(len(states)) if i not in own]
        inputs = [_Axis(s.name, s.unit, self.u[..., i]) for i, s in enumerate(self.base.inputs)]
        mine = [a for a in inputs if a.name == place.site]
        return [*mine, *(states[i] for i in (*own, *rest)), *(a for a in inputs if a not in mine)]

    @property
    def time(self) -> _Axis:
        steps = self.base.period * np.arange(self.x.shape[1])
        return _Axis("time", "s", self.windows.t[:, None] + steps)

    def asked(self, place: _Place, member: _Members) -> tuple[Array, Array]:
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


def _intervals(values: Array, count: int) -> _Members:
    """Which of `count` intervals each value is in; their edges lie between equal widths and equal numbers."""
    share = np.linspace(0, 1, count + 1)
    edges = (np.quantile(values, share) + values.min() + share * np.ptp(values)) / 2
    return np.clip(np.digitize(values, edges[1:-1]), 0, count - 1)


def _means(values: Array, member: _Members, count: int) -> Array:
    """The mean (K,) of values in each interval; NaN where there is none."""
    sizes = np.bincount(member.ravel(), minlength=count)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(member.ravel(), values.ravel(), count) / sizes)


def _carried(law: Array, axis: _Axis) -> float:
    """The share of a law's variance along the path that is a function of one quantity."""
    member = _intervals(axis.values, 2 * THRESHOLDS.quantity_intervals)
    if not (np.abs(law) < THRESHOLDS.wildest_residual).all():
        return 0.0  # nothing carries a law that runs away
    spread = float(np.var(law))
    if spread <= 1e-12 * float(np.mean(law**2)):
        return 1.0
    left = law - np.nan_to_num(_means(law, member, 2 * THRESHOLDS.quantity_intervals))[member]
    return 1 - float(np.mean(left**2)) / spread


def _laws(path: _Fitted, correction: Correction | None = None) -> tuple[Law, ...]:
    """Every named law at its place against the quantity that carries it, then what is left at all coordinates.

    Through what is left goes the correction that data alone suggest, where there is one.
    """
    groups = list(_groups(path))
    drawn = [_law(path, place, group, axis, law) for place, group, axis, law in groups]
    for site in path.base.sites("coordinate"):
        if len(drawn) >= THRESHOLDS.law_pictures:
            break
        place = path.place(site, "coordinate")
        if not path.tangent.felt(place.response):
            continue
        axes, nothing = path.axes(place)[: THRESHOLDS.law_pictures - len(drawn)], np.zeros(path.x.shape[:2])
        left = [_law(path, place, (), axis, nothing) for axis in axes]
        if correction is not None and correction.site == site:
            left = [_corrected(path, place, axis, one, correction) for axis, one in zip(axes, left, strict=True)]
        drawn += [replace(one, lead=not path.causes and i == 0) for i, one in enumerate(left)]
    return tuple(drawn[: THRESHOLDS.law_pictures])


def _corrected(path: _Fitted, place: _Place, axis: _Axis, left: Law, correction: Correction) -> Law:
    if correction.extension is None:
        return left
    with_it = path.full.extend([correction.extension])
    law = place.size(difference(path.base.states, path.next(with_it), path.after))
    shape = "line" if _carried(law, axis) >= THRESHOLDS.carrying_share else "cloud"
    at, line = _drawn(shape, axis.values, law)
    return replace(left, at=at, law=line, shape=shape, named="correction from data")


def _groups(path: _Fitted) -> Sequence[tuple[_Place, Causes, _Axis, Array]]:
    """(place, causes, quantity, their law (W, S)): causes at one place that depend on one quantity are one law."""
    groups: dict[tuple[str, str], list[Candidate]] = {}
    where: dict[tuple[str, str], tuple[_Place, _Axis]] = {}
    for c in path.causes:
        if c.effect.site == "output":
            continue
        if (place := _place(path, c)) is None:
            continue
        law = place.size(path.added((c,)))
        axes = path.axes(place)
        shares = [_carried(law, a) for a in axes]
        timed = "{t}" in (path.library.extension(c).force or "")
        axis = path.time if timed else axes[next(i for i, s in enumerate(shares) if s >= max(shares) - THRESHOLDS.equal_shares)]
        if max(shares) < THRESHOLDS.carrying_share and _remembers(path.library.extension(c)):
            axis = _turned(path, c, place, axes) or axis
        # A law that no single quantity carries stands alone.
        key = place.site, f"{axis.name} {c.effect.name}" if max(shares) < THRESHOLDS.carrying_share or timed else axis.name
        groups.setdefault(key, []).append(c)
        where[key] = place, axis
    return [(place, g, axis, place.size(path.added(g))) for k, (place, axis) in where.items() for g in (tuple(groups[k]),)]


def _turned(path: _Fitted, c: Candidate, place: _Place, axes: list[_Axis]) -> _Axis | None:
    """Against what a law with memory is a loop: the input itself, or what its memory follows, force or position."""
    inputs = [s.name for s in path.base.inputs]
    follows = any("{f}" in m.next for m in path.library.extension(c).memory)
    return next((a for a in axes if (a.name in inputs if follows else a.name == place.site)), None)


def _place(path: _Fitted, c: Candidate) -> _Place | None:
    """Of a parameter: the one of all known by now, coordinates among them, or else inputs, whose motion it changes most."""
    if c.effect.site != "parameter":
        return path.place(c.site, c.effect.site)
    moved, spread = path.added((c,)), np.std(path.x, axis=(0, 1)) + 1e-300
    for q in path.base.sites("coordinate"):
        path.place(q, "coordinate")
    for u in () if path.places else path.base.sites("input"):
        path.place(u, "input")
    changed = np.sqrt(np.mean(moved**2, axis=(0, 1))) / spread
    return max(path.places.values(), key=lambda p: float(changed[p.column]), default=None)


def _law(path: _Fitted, place: _Place, group: Causes, axis: _Axis, law: Array) -> Law:
    timed, law = axis.name == "time", np.where(np.isfinite(law), law, np.nan)  # what runs away is not drawn
    remembers = any(_remembers(path.library.extension(c)) for c in group)
    shape = "line" if timed or _carried(law, axis) >= THRESHOLDS.carrying_share else "loop" if remembers else "cloud"
    # What happens once is looked at where it happens.
    row = int(np.argmax(np.ptp(law, axis=1)))
    member = np.full(axis.values.shape, 2 * THRESHOLDS.quantity_intervals)
    rows = slice(row, row + 1) if timed else slice(None)
    member[rows] = _intervals(axis.values[rows], THRESHOLDS.quantity_intervals)
    if shape == "loop":
        # What remembers differs between rising and falling.
        member += THRESHOLDS.quantity_intervals * (np.gradient(axis.values, axis=1) >= 0)
    label, member = np.unique(member, return_inverse=True)
    member = member.reshape(axis.values.shape)
    further, half = path.asked(place, member)
    x, y = _means(axis.values, member, len(label)), _means(law, member, len(label)) + further
    at, line = (np.empty(0), np.empty(0)) if not group else _drawn(shape, axis.values[rows], law[rows])
    reach = max(3 * float(np.median(half)), THRESHOLDS.wide_interval * float(np.ptp(law)) if group else 0.0)
    keep = (half <= reach) & (label < 2 * THRESHOLDS.quantity_intervals) & np.isfinite(x) & np.isfinite(y)
    names = " and ".join(called(*c.told).removesuffix(f" at {place.site}") for c in group)
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


def _outputs(path: _Fitted) -> tuple[Law, ...]:
    """What named faults of sensors add to a reading, against the reading without them."""
    m, w, drawn = path.windows.measured, path.windows, []
    last = path.tangent.fitted
    h, at = last.hypothesis, (last.theta[None], last.start[None])
    x = h.motion(w, *at, every=m.repeat)
    u = flat(np.ascontiguousarray(w.u[:, m.history :]))
    plain = path.base.output(x.reshape(-1, path.base.nx), u)[:, list(m.columns)].reshape(w.y.shape)
    read = difference(m.channels, h.simulate(w, *at)[0], plain)
    names = {c.name: i for i, c in enumerate(m.channels)}
    for c in path.causes:
        if c.effect.site != "output" or c.site not in names:
            continue
        i = names[c.site]
        true, law, left = plain[..., i], read[..., i], -last.residual[..., i] * m.sigma[i]
        member = np.unique(_intervals(true, THRESHOLDS.quantity_intervals), return_inverse=True)[1].reshape(true.shape)
        sizes = np.bincount(member.ravel())
        half = 1.96 * np.sqrt(_means(left**2, member, len(sizes)) / sizes / last.whiteness[i])
        axis = _Axis(c.site, m.channels[i].unit, true)
        shape = "line" if _carried(law, axis) >= THRESHOLDS.carrying_share else "loop"
        y, mid = _means(law + left, member, len(sizes)), _means(true, member, len(sizes))
        label = f"added to the reading [{m.channels[i].unit}]"
        drawn.append(Law(called(*c.told), axis.label, label, mid, y, *_drawn(shape, true, law), half, shape=shape))
    return tuple(drawn)
