"""What the report and the live viewer draw: computed once from result objects, kept in the run folder, never recomputed."""

from __future__ import annotations

import json
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from gapcert.plugin import DAMAGE, TURN, Array, Bools, Ints, UsageError, clipped, npz_bytes, pretty, turned, write_atomic
from gapcert_closed_loop import Ahead, Foreseen, Learned, followed, foreseen
from gapcert_closed_loop import figures as learned_figures

from .dataclass_io import flatten, restore
from .diagnosis import DiagnosisFigure as DiagnosisFigure
from .playback import Channel as Channel
from .playback import Playback
from .region_outlines import Outline, outlines_of

if TYPE_CHECKING:
    from gapcert.plugin import Box, Certificate, Controller, Domain, System
    from gapcert_calibrate import CalibratedRecording
    from gapcert_closed_loop import ClosedLoop, Trace

SLICE = 96  # cells per axis of a gap slice
LINE = 401  # points of a band
STEPS = 300_000  # engine steps that a slice may cost
TRACES = 6  # runs drawn per controller
SHOWN = 400  # transitions of a stretch


def labelled(name: str, unit: str) -> str:
    """`theta [rad]`; the name alone where there is no unit."""
    return name if unit in ("", "1") else f"{name} [{unit}]"


def held(fixed: str) -> str:
    """Where a picture is taken, ` at torque = 0 N·m`; nothing where no axis is held."""
    return f" at {fixed}" if fixed else ""


@final
@dataclass(frozen=True)
class Axis:
    """One axis of a picture, with its unit and range; `angle`: it counts modulo a turn."""

    name: str
    unit: str
    low: float
    high: float
    angle: bool = False

    @classmethod
    def all_of(cls, box: Box) -> tuple[Axis, ...]:
        ends = zip(box.axes, box.low, box.high, strict=True)
        return tuple(cls(a.name, pretty(a.unit), low, high, a.kind == "angle") for a, low, high in ends)

    @property
    def label(self) -> str:
        return labelled(self.name, self.unit)

    def centres(self, n: int) -> Array:
        return np.asarray(self.low + (self.high - self.low) * (2 * np.arange(n) + 1) / (2 * n))


@final
@dataclass(frozen=True)
class Slice:
    """γ and |r| of one state over the first two axes, the others at their middle; row = second axis, column = first. NaN
    outside the domain's relations.
    """

    state: str
    unit: str
    gamma: Array
    gap: Array


@final
@dataclass(frozen=True)
class Band:
    """One state's residual r in [low, high] and ±γ along one axis, the others at their middle."""

    state: str
    unit: str
    axis: Axis
    at: Array
    residual: Array
    low: Array
    high: Array
    gamma: Array
    constant: float

    @property
    def inside(self) -> bool:
        return bool(np.all((self.low <= self.residual) & (self.residual <= self.high)))

    @property
    def empty(self) -> Bools:
        """Where no value lies in it (n,): its lower end is above its upper one."""
        return np.asarray(self.low > self.high)


@final
@dataclass(frozen=True)
class GapFigure:
    """How wrong: slices, bands and the sampled points z (n, nz), columns as `axes`; `fixed` names the axes held in place.

    Axes along which hardly anything changes stand behind the others, those of a declared symmetry last.
    """

    axes: tuple[Axis, ...]
    fixed: str
    slices: tuple[Slice, ...]
    bands: tuple[Band, ...]
    samples: Array

    @property
    def leads(self) -> dict[str, int]:
        """The band that each state is shown by: along the axis where it leaves it, or else varies most."""
        leads: dict[str, int] = {}
        for i in sorted(range(len(self.bands)), key=lambda i: (self.bands[i].inside, -np.ptp(self.bands[i].residual))):
            leads.setdefault(self.bands[i].state, i)
        return {b.state: leads[b.state] for b in self.bands}


@final
@dataclass(frozen=True)
class Stretch:
    """One state's residual r in [low, high] at times t (n,), in s from the beginning of the stretch."""

    state: str
    unit: str
    t: Array
    residual: Array
    low: Array
    high: Array


@final
@dataclass(frozen=True)
class RecordedFigure:
    """Scores of the held windows in order, (n,), of which the one of `rank` (from 1) set the band; and its transitions."""

    scores: Array
    rank: int
    at: float
    stretches: tuple[Stretch, ...]


@final
@dataclass(frozen=True)
class WinningFigure:
    """Where a controller may start: grids of 0 and 1 over the first two states (row = second), the others `fixed`; the goal.

    values: what is promised with γ, steps to the goal, NaN outside the domain; empty where the goal has no end. labels: what
    the two controllers are.
    """

    axes: tuple[Axis, ...]
    fixed: str
    goal: str
    with_gamma: Array
    without_gamma: Array
    values: Array
    outlines: tuple[Outline, ...]
    labels: tuple[str, ...] = ("with γ", "without γ")

    @property
    def areas(self) -> tuple[tuple[str, str, Bools], ...]:
        """(role, name, where) of what both win, and of what one wins alone."""
        a, b = self.with_gamma > 0, self.without_gamma > 0
        first, second = self.labels
        only = ("only_with_gamma", f"only {first}", a & ~b), ("only_without_gamma", f"only {second}", b & ~a)
        return ("both", "both win", a & b), *only


@final
@dataclass(frozen=True)
class Runs:
    """Closed-loop runs of one controller on f̂. broke (starts,): step of the violation, −1 for none.

    traces (k, steps + 1, nx): some of them, NaN after their end; ended (k,): step of their violation, or −1. predicted: what f
    alone would have done from the same starts under the same inputs.
    """

    gamma: bool
    policy: str
    starts: int
    steps: int
    broke: Array
    traces: Array
    ended: Array
    predicted: Array

    @property
    def name(self) -> str:
        return "with γ" if self.gamma else "without γ"

    @property
    def alive(self) -> Ints:
        """(steps + 1,): how many are unbroken at each step."""
        broke = np.where(self.broke < 0, self.steps + 1, self.broke)
        return np.asarray((broke[None] > np.arange(self.steps + 1)[:, None]).sum(axis=1))


@final
@dataclass(frozen=True)
class Escape:
    """The step at which one run without γ breaks: from `before` f expects `expected`, the simulator goes to `actual` (nx,).

    domain: grid of 0 and 1 over the axes (row = second), where the controller without γ can go on.
    """

    axes: tuple[Axis, ...]
    domain: Array
    step: int
    before: Array
    expected: Array
    actual: Array


@final
@dataclass(frozen=True)
class LoopFigure:
    """Closed loop without and with γ; `stay` (nx, 2) is the set that must not be left. foreseen: what the controller with γ
    predicted at some moments of the first run that is drawn, and `ahead` at each of its steps of the next one; learned: what
    that and all runs with γ knew of parameters; wanted (steps + 1, nx): what these are drawn to, where that moves, else empty.
    playback: the first run that is drawn, as an engine's robot makes it.
    """

    axes: tuple[Axis, ...]
    period: float
    stay: Array
    runs: tuple[Runs, ...]
    escape: Escape | None = None
    foreseen: tuple[Foreseen, ...] = ()
    learned: tuple[Learned, ...] = ()
    ahead: Ahead | None = None
    wanted: Array = field(default_factory=lambda: np.zeros((0, 0)))
    playback: Playback | None = None

    def pieces(self, trace: Array) -> list[Array]:
        """A run (steps + 1, nx) as far as it went, cut wherever an angle comes round."""
        trace = trace[np.isfinite(trace).all(axis=1)]
        angles = [j for j, axis in enumerate(self.axes) if axis.angle]
        jumps = (np.abs(np.diff(trace[:, angles], axis=0)) > TURN / 2).any(axis=1)
        return np.split(trace, np.flatnonzero(jumps) + 1)


@final
@dataclass(frozen=True)
class PairFigure:
    """Two backends: |f̂_a − f̂_b| of the state that differs most over the axes (row = second), the others `fixed` at the worst
    point. drift (steps + 1,): the largest difference of common runs, as a share of what one step moves. Either may be empty.
    """

    a: str
    b: str
    state: str
    unit: str
    axes: tuple[Axis, ...]
    fixed: str
    values: Array
    drift: Array


@final
@dataclass(frozen=True)
class CompareFigure:
    """Backend against backend, the pairs in the order of the summary."""

    period: float
    pairs: tuple[PairFigure, ...]


@final
@dataclass(frozen=True)
class Lane:
    """The states of one stage, each from the event with that number on."""

    stage: str
    at: tuple[int, ...]
    states: tuple[str, ...]

    def then(self, number: int, state: str) -> Lane:
        """This lane with a new state; the same state again changes nothing."""
        if self.states and self.states[-1] == state:
            return self
        return Lane(self.stage, (*self.at, number), (*self.states, state))


@final
@dataclass(frozen=True)
class Figures:
    """Everything that a run drew."""

    gap: GapFigure | None = None
    recorded: RecordedFigure | None = None
    winning: WinningFigure | None = None
    loop: LoopFigure | None = None
    diagnosis: DiagnosisFigure | None = None
    compare: CompareFigure | None = None
    lanes: tuple[Lane, ...] = ()

    def save(self, folder: Path) -> None:
        arrays: dict[str, Array] = {}
        text = json.dumps(flatten(self, "", arrays), indent=1, sort_keys=True, allow_nan=False)
        write_atomic(folder / "figures.npz", npz_bytes(arrays, compress=True))
        write_atomic(folder / "figures.json", (text + "\n").encode())

    @classmethod
    def load(cls, folder: Path) -> Figures:
        """The pictures of a run folder; empty ones if it has none."""
        if not (folder / "figures.json").exists():
            return cls()
        try:
            data = json.loads((folder / "figures.json").read_text(encoding="utf-8"))
            with open(folder / "figures.npz", "rb") as file, np.load(file, allow_pickle=False) as arrays:
                return typing.cast(Figures, restore(cls, data, arrays))
        except DAMAGE as error:
            what = f"{folder}: figures.json and figures.npz do not fit ({clipped(str(error))[0]})"
            raise UsageError(f"{what}; run the spec again") from error


def _plane(axes: Sequence[Axis], n: int, at: Array) -> Array:
    """Cell centres of n × n cells over the first two axes, the others as `at` a point: (n², axes)."""
    points = np.tile(at, (n * n, 1))
    second, first = np.meshgrid(axes[1].centres(n), axes[0].centres(n), indexing="ij")
    points[:, 0], points[:, 1] = first.ravel(), second.ravel()
    return points


def _held(axes: Sequence[Axis], at: Array) -> str:
    return ", ".join(f"{a.name} = {m:.4g} {a.unit}".removesuffix(" 1") for a, m in zip(axes, at, strict=True))


def gap_figure(certificate: Certificate, residual: Callable[[Array], Array], domain: Domain) -> GapFigure:
    """Slices over the first two axes and bands along every axis, with the residual evaluated afresh, inside Z alone."""
    axes = Axis.all_of(domain.states) + Axis.all_of(domain.inputs)
    states, centre = axes[: domain.nx], domain.centre
    constants = certificate.summary()["states"]
    # Fewer cells per axis of a slice, and points of a band, where a transition takes many engine steps.
    substeps = getattr(getattr(residual, "backend", None), "substeps", 1)
    side, points = (
        int(np.clip(np.sqrt(STEPS / substeps), SLICE // 3, SLICE)),
        int(np.clip(STEPS / 10 / substeps, LINE // 4, LINE)),
    )
    inert = certificate.problem.symmetry.axes if certificate.problem.symmetry is not None else ()
    bands: list[Band] = []
    for j, axis in enumerate(axes):
        z = np.tile(centre, (points, 1))
        (low_end,), (high_end,) = domain.chord(z[:1], j)
        z[:, j] = np.linspace(low_end, high_end, points)
        r, (low, high), gamma = residual(z), certificate.gap.interval(z), certificate.gap.gamma(z)
        for i, s in enumerate(states):
            constant = float(constants.get(s.name, {}).get("constant_bound", np.max(gamma[:, i])))
            bands.append(Band(s.name, s.unit, axis, z[:, j], r[:, i], low[:, i], high[:, i], gamma[:, i], constant))
    # Quiet: along it no state's residual changes by a tenth of what it changes along another axis.
    swing = np.array([np.ptp(b.residual) for b in bands]).reshape(-1, len(states))
    quiet = (swing < 0.1 * swing.max(axis=0)).all(axis=1)
    order = sorted(range(len(axes)), key=lambda j: (j in inert, bool(quiet[j])))
    shown = tuple(axes[j] for j in order)
    slices: list[Slice] = []
    if len(axes) > 1:
        z = np.empty((side * side, len(axes)))
        z[:, order] = _plane(shown, side, centre[order])
        inside = domain.contains(z)
        gamma, gap = np.full((2, len(z), len(states)), np.nan)
        gamma[inside], gap[inside] = certificate.gap.gamma(z[inside]), np.abs(residual(z[inside]))
        maps = zip(states, *(values.T.reshape(-1, side, side) for values in (gamma, gap)), strict=True)
        slices = [Slice(s.name, s.unit, upper, truth) for s, upper, truth in maps]
    return GapFigure(shown, _held(shown[2:], centre[order][2:]), tuple(slices), tuple(bands), certificate.samples.z[:, order])


def recorded_figure(made: CalibratedRecording) -> RecordedFigure:
    """Of the window that set the band, the stretch around the transition that did."""
    held, order = made.held, np.argsort(made.scores, kind="stable")
    rows = np.flatnonzero(held.window == np.unique(held.window)[order[made.rank - 1]])
    rows = rows[np.argsort(held.t[rows], kind="stable")]
    low, high = made.gap.interval(held.z[rows])
    r = held.r[rows]
    # The score's transition touches the band: nowhere is less left, in scales.
    peak = int(np.argmin((np.minimum(r - low, high - r) / made.scale).min(axis=1)))
    first = max(0, min(peak - SHOWN // 2, len(rows) - SHOWN))
    part = slice(first, first + SHOWN)
    t = held.t[rows][part]
    stretches = (
        Stretch(s.name, pretty(s.unit), t - t[0], r[part, i], low[part, i], high[part, i])
        for i, s in enumerate(made.model.states)
    )
    return RecordedFigure(made.scores[order], made.rank, float(t[0]), tuple(stretches))


def winning_figure(
    with_gamma: Controller,
    without_gamma: Controller,
    labels: tuple[str, ...] = ("with γ", "without γ"),
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> WinningFigure | None:
    """Both winning domains on one grid over the set to stay in; None where there is no second state to draw against, or where
    neither wins anything to be seen.

    The other states are at their middle; where nothing wins there, as in the nearest of some states that win.
    """
    axes, held = Axis.all_of(with_gamma.goal.stay), getattr(with_gamma, "held", None)
    own = {} if held is None else dict(zip(held.names, np.add(held.low, held.high) / 2, strict=True))
    if len(axes) < 2 or axes[0].name in own or axes[1].name in own:
        return None
    at = np.array([own.get(a.name, (a.low + a.high) / 2) for a in axes])
    n = min(with_gamma.resolution, without_gamma.resolution)
    with_grid, without_grid = _grids((with_gamma, without_gamma), axes, n, at, tell)
    if not (with_grid.any() or without_grid.any()):
        starts = turned(with_gamma.goal.stay, with_gamma.draw(5 * n, np.random.default_rng(0)))
        if len(axes) == 2 or not len(starts):
            return None
        span = np.array([a.high - a.low for a in axes])
        at = np.where([a.name in own for a in axes], at, starts[(np.abs(starts - at) / span)[:, 2:].sum(axis=1).argmin()])
        with_grid, without_grid = _grids((with_gamma, without_gamma), axes, n, at, tell)
    goal, value = with_gamma.goal, getattr(with_gamma, "value", None)
    steps = np.empty((0, 0)) if value is None else value(_plane(axes, n, at)).reshape(n, n).astype(np.float64)
    values = np.where(steps < 0, np.nan, steps) if (steps > 0).any() else np.empty((0, 0))
    fixed, outlines = _held(axes[2:], at[2:]), outlines_of(goal, at)
    return WinningFigure(axes, fixed, goal.kind, with_grid, without_grid, values, outlines, labels)


def _grids(both: Sequence[Controller], axes: Sequence[Axis], n: int, at: Array, tell: Callable[[int, int], None]) -> Array:
    """Of both, row by row: who solves a program for each state takes long, and one sees how far it is."""
    plane, grids = _plane(axes, n, at).reshape(n, n, -1), np.empty((2, n, n))
    for k, row in np.ndindex(2, n):
        grids[k, row] = both[k].contains(plane[row])
        tell((k * n + row + 1) * n, 2 * n * n)
    return grids


def loop_figure(loop: ClosedLoop, model: System, with_gamma: Controller, without_gamma: Controller) -> LoopFigure:
    """The headline runs of both controllers; drawn are the same few starts, those that break without γ first."""
    first = drawn(loop)
    both, stay = (loop.without_gamma, loop.with_gamma), without_gamma.goal.stay
    runs = tuple(_runs(gamma, loop.policy, trace, model, first, stay) for gamma, trace in zip((False, True), both, strict=True))
    escape = _escape(loop.without_gamma, int(first[0]), model, without_gamma)
    told, ahead = foreseen(with_gamma, loop.with_gamma.x[int(first[0])], loop.policy)
    ends, known = np.column_stack([stay.low, stay.high]), learned_figures(loop.with_gamma.learned, model, int(first[0]))
    made = LoopFigure(Axis.all_of(stay), model.period, ends, runs, escape, told, known, ahead)
    wanted = with_gamma.wanted(loop.with_gamma.x.shape[1])
    return made if wanted is None else replace(made, wanted=wanted)


def drawn(loop: ClosedLoop) -> Ints:
    """The runs that are drawn: of the starts that the controller with γ takes, those first that break without γ."""
    return np.argsort(~loop.without_gamma.violation[: len(loop.with_gamma.x)], kind="stable")[:TRACES]


def _escape(trace: Trace, row: int, model: System, controller: Controller) -> Escape | None:
    x, u = trace.x[row], trace.u[row]
    end = int(np.isfinite(x).all(axis=1).sum()) - 1
    if not trace.violation[row] or end == 0 or x.shape[1] != 2:
        return None
    expected = model.step(x[end - 1 : end], u[end - 1 : end]).x[0]
    if not controller.contains(expected[None])[0]:
        return None
    middle, reach = (expected + x[end]) / 2, 2.5 * np.abs(expected - x[end])
    reach = np.maximum(reach, 1e-3 * reach.max())
    ends = zip(controller.goal.stay.axes, middle - reach, middle + reach, strict=True)
    axes = tuple(Axis(a.name, pretty(a.unit), low, high) for a, low, high in ends)
    n = min(SLICE, controller.resolution)
    inside = controller.contains(_plane(axes, n, middle)).reshape(n, n).astype(np.float64)
    return Escape(axes, inside, end, x[end - 1], expected, x[end])


def _runs(gamma: bool, policy: str, trace: Trace, model: System, rows: Ints, stay: Box) -> Runs:
    last = np.isfinite(trace.x).all(axis=2).sum(axis=1) - 1
    broke = np.where(trace.violation, last, -1)
    x, u = trace.x[rows], trace.u[rows]
    predicted = followed(model, x, u)
    x, predicted = (turned(stay, v.reshape(-1, v.shape[2])).reshape(v.shape) for v in (x, predicted))
    return Runs(gamma, policy, len(trace.x), trace.u.shape[1], broke, x, broke[rows], predicted)
