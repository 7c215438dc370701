"""How wrong is a model beside a recording? A band about its residuals, calibrated on windows that its fit has not seen."""

from __future__ import annotations

import hashlib
import itertools
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert.plugin import (
    Array,
    Band,
    Claim,
    Domain,
    Entry,
    GapFamily,
    GapProblem,
    Ints,
    LipschitzEstimator,
    LipschitzProblem,
    Model,
    Predictor,
    Recording,
    Samples,
    SavedStatement,
    StateEvidence,
    UsageError,
    __version__,
    beta_of,
    figures,
    gap_digest,
    in_words,
    order_statistics,
    predictor_of,
    registry,
)
from gapcert_monitor import Certified
from gapcert_recordings import Copies, Transitions

from .route import CalibratedGap, NoConstants, constant, ends, scale_of

CALLER = "calibration"
FIT = 1 / 3  # the share of windows that a fit is given
_SKETCH = 64  # hashes of transitions that stand for a recording: enough to see what two have in common; chosen, not measured
_FITTED = 300  # transitions that a fit is given: neighbours in time say nearly the same, and scores are made again with each


@final
@dataclass(frozen=True)
class Windows:
    """A recording cut into windows, the units of a calibration.

    Transitions in Z: when they begin (n,) in s, z (n, nz), r (n, nx), and the number of the window that each lies in (n,).
    Of `rows` rows, `skipped` begin no transition, and `outside` begin one that is outside Z or in no whole window.
    """

    t: Array
    z: Array
    r: Array
    window: Ints
    rows: int
    skipped: int
    outside: int
    copies: Copies

    def __len__(self) -> int:
        """How many windows there are."""
        return len(np.unique(self.window))

    @property
    def unused(self) -> dict[str, int]:
        """Rows in all, and those that the certificate says nothing of, by reason."""
        return {"all": self.rows, "no_transition": self.skipped, "outside": self.outside}

    def of(self, windows: Ints) -> Windows:
        rows = np.isin(self.window, windows)
        own = self.t[rows], self.z[rows], self.r[rows], self.window[rows]
        return Windows(*own, self.rows, self.skipped, self.outside, self.copies)

    @classmethod
    def cut(cls, model: Model, recording: Recording, domain: Domain, length: float | None) -> Windows:
        """Transitions that begin in Z and lie in one whole window; windows are numbered among those that have any.

        length: in s; None: a whole trajectory. UsageError where no transition is left.
        """
        steps = Transitions.of(model, recording, CALLER)
        if length is not None and not length >= model.period:
            raise UsageError(f"{CALLER}: window = {length} s; expected at least the period of {model.period:g} s")
        first, last = np.array([(np.nanmin(tr.t), np.nanmax(tr.t)) for tr in recording.trajectories]).T

        def numbered(t: Array, of: Ints) -> Ints:
            # One number per trajectory and window.
            inside = 0 * t if length is None else np.floor((t - first[of]) / length + 1e-9)
            return of * (1 << 40) + inside.astype(np.int64)

        number, keep = numbered(steps.t, steps.trajectory), np.ones(len(steps), dtype=bool)
        if length is not None:
            slack = 1e-9 * length
            begin = first[steps.trajectory] + (number % (1 << 40)) * length
            keep = steps.t + model.period <= begin + length + slack
            keep &= begin + length <= last[steps.trajectory] + slack
        copies = Copies.of(recording, [s.name for s in model.inputs], within=length is not None)
        twice = [
            numbered(tr.t[k], np.full(k.sum(), i))
            for i, (tr, k) in enumerate(zip(recording.trajectories, copies.rows, strict=True))
        ]
        keep &= ~np.isin(number, np.concatenate(twice))
        known = Certified(model, domain.zone, lambda z: (z, z))
        z = known.points(steps.x, steps.u)
        whole = int(keep.sum())
        keep &= domain.contains(z)
        if not keep.any():
            short = f"no trajectory is as long as a window of {length} s; take shorter ones"
            away = "no transition of a whole window begins in the domain; take a larger one"
            raise UsageError(f"{CALLER}: {away if whole else short}")
        _, which = np.unique(number[keep], return_inverse=True)
        r = known.residual(steps.x[keep], steps.u[keep], steps.x_next[keep])
        left = int((~keep).sum())
        index = np.asarray(which, dtype=np.intp).reshape(-1)
        return cls(steps.t[keep], z[keep], r, index, len(steps) + steps.skipped, steps.skipped, left, copies)


@final
@dataclass(frozen=True, repr=False)
class CalibratedRecording(SavedStatement):
    """A band that holds for all transitions of a further window, with probability 1 − ε on average over calibrations.

    `units` windows met Z; those of `fit` gave the band, those of `held` its widening: score · scale, (nx,), with the score of
    `rank` among their `scores`. `states` are figures over the transitions of the held windows. window: the length of one in s,
    None for whole trajectories. entry: which calibration on these measurements it is, where a book counts them.
    """

    gap: CalibratedGap
    problem: GapProblem
    model: Model
    claim: Claim
    assumptions: tuple[str, ...]
    units: int
    fit: Windows
    held: Windows
    scale: Array
    rank: int
    score: float
    scores: Array
    states: Mapping[str, StateEvidence]
    entry: Entry | None = None
    versions: Mapping[str, str] = field(default_factory=dict)
    window: float | None = None

    @property
    def certified(self) -> Certified:
        """For `check`, which holds other recordings against the band."""
        return Certified.of(self)

    @property
    def domain(self) -> Domain:
        return self.problem.domain

    def _about(self) -> tuple[Domain, Band]:
        return self.domain, self.gap.interval

    @property
    def vacuous(self) -> bool:
        return any(s.vacuous for s in self.states.values())

    @property
    def reason(self) -> str:
        """Why it holds."""
        c = self.claim
        level = f"ε = {c.epsilon:g}" + ("" if c.beta is None else f", β = {c.beta:g}")
        seen = f"{len(self.held)} windows that the fit has not seen set it"
        return f"the gap function holds at level statistical ({level}, {c.distribution}): {seen}"

    @property
    def warnings(self) -> list[str]:
        """What a reader of the claim should know first."""
        rows, said = self.held.unused, [self.held.copies.told] if self.held.copies.found else []
        if 2 * rows["no_transition"] > rows["all"]:
            said.append(
                f"{rows['no_transition']:,} of {rows['all']:,} rows begin no transition of one period of "
                f"{self.model.period:g} s (the next row is late, early or missing, a value is missing, or the input moved); "
                f"the claim is about the others"
            )
        if self.entry is not None and self.entry.k > 1:
            said.append(
                f"this is calibration {self.entry.k} on the same measurements; fresh ones cannot be drawn from a recording, so "
                f"that one which was chosen by its figures claims too much"
            )
        return [*said, *([] if self.entry is None else self.entry.warnings)]

    def digest(self) -> str:
        """Identity of the band and of its claim."""
        return f"recording:{gap_digest(self.gap, self.problem)}:{self.claim.epsilon!r}:{self.claim.beta!r}"

    def summary(self) -> dict[str, Any]:
        measured = {
            "units": self.units,
            "window": self.window,
            "windows": {"fit": len(self.fit), "calibration": len(self.held)},
            "transitions": {"fit": len(self.fit.z), "calibration": len(self.held.z)},
            "rows": self.held.unused,
            "trajectories": len(self.held.copies.rows),
            "copies": self.held.copies.summary(),
            "rank": self.rank,
            "score": self.score,
            "widening": self.gap.widening.tolist(),
        }
        return {
            "claim": self.claim.summary(),
            "family": self.gap.family,
            "route": "calibrate",
            "states": {name: s.summary() for name, s in self.states.items()},
            "assumptions": list(self.assumptions),
            "samples": {"bound": len(self.problem.samples), "calibration": len(self.held.z)},
            "vacuous": self.vacuous,
            "lipschitz": self.problem.lipschitz.summary(self.domain.axes),
            "recording": measured | ({} if self.entry is None else self.entry.summary()),
            **({"warnings": said} if (said := self.warnings) else {}),
        }

    def save(self, folder: Path | str) -> None:
        """`certificate.json` and `certificate.npz`, with all transitions: `gapcert verify` makes rank and scores again."""
        p = self.problem
        arrays: dict[str, npt.NDArray[Any]] = {f"predictor.{k}": v for k, v in p.predictor.arrays().items()}
        arrays |= {"lipschitz": p.lipschitz.value, "resolution": p.resolution, "remainder.resolution": p.remainder_resolution}
        arrays |= {"fit.z": p.samples.z, "fit.r": p.samples.r, "fit.windows": np.unique(self.fit.window)}
        arrays |= {"held.z": self.held.z, "held.r": self.held.r, "held.window": self.held.window}
        arrays |= {"calibration.scale": self.scale}
        if p.predictor.kind == "model":
            arrays |= {"predictor.samples": p.predictor(p.samples.z), "predictor.calibration": p.predictor(self.held.z)}
        self._write(Path(folder), p.predictor.kind, arrays, cover=None, seed=p.seed, digests={})


def calibrate_recording(
    model: Model,
    recording: Recording,
    domain: Domain,
    *,
    violation: float = 0.05,
    confidence: float | None = None,
    window: float | None = None,
    fit: float = FIT,
    family: GapFamily | None = None,
    lipschitz: LipschitzEstimator | None = None,
    predictor: Predictor | Model | None = None,
    seed: int = 0,
) -> CalibratedRecording:
    """A band [l, u] about r = x⁺ − f(x, u) in which all transitions of a further window lie, with probability 1 − violation.

    window: its length in s; None: a whole trajectory. Windows are taken as exchangeable, and are split at random: about a share
    `fit` of them gives the band (family `envelope` with an affine predictor, without constants), the others widen it to the
    ⌈(n + 1)(1 − ε)⌉-th smallest of their scores, each the largest of a window's transitions in Z. The claim is marginal: on
    average over the calibrations that might have been. With a confidence, 1 − β, windows are taken as independent draws, the
    rank is N − m with the largest m for which P(Bin(N, ε) ≤ m) ≤ β, and the claim is about this calibration. UsageError where
    there are too few windows.
    """
    if not 0 < fit < 1:
        raise UsageError(f"{CALLER}: fit = {fit}; expected a share between 0 and 1")
    if confidence is not None and not 0 < confidence < 1:
        raise UsageError(f"{CALLER}: confidence = {confidence}; expected a number between 0 and 1")
    beta = None if confidence is None else beta_of(confidence)
    found = Windows.cut(model, recording, domain, window)
    units = len(found)
    fitted = _dealt(found, fit, violation, beta, window)
    order = order_statistics.split(units, seed)
    own, held = found.of(order[:fitted]), found.of(order[fitted:])
    problem = _problem(model, domain, own, family, lipschitz, predictor, seed)
    made = family or registry().build("gap_family", "envelope")
    gap, scale = made.fit(problem), scale_of(problem)

    def scored(low: Array, high: Array, scale: Array) -> Array:
        return order_statistics.worst(order_statistics.scores(held.r, low, high, scale), held.window)

    each = scored(*ends(gap, held.z), scale)
    rank = order_statistics.unit_rank(len(each), violation, beta)
    score = order_statistics.ranked(each, rank)
    band = CalibratedGap(gap, order_statistics.widening(score, scale), problem.arithmetic)
    claim = Claim("statistical", violation, beta, order_statistics.WINDOWS if beta is None else order_statistics.DRAWN_WINDOWS)
    said = _sentences(model, domain, window, found, len(each), rank, violation, beta)
    states = figures(band, problem, model, held.z, held.r, constant(band, problem, held.z, rank, scored))
    versions = {"gapcert": __version__, "numpy": np.__version__, "python": platform.python_version()}
    return CalibratedRecording(
        band, problem, model, claim, said, units, own, held, scale, rank, score, each, states, versions=versions, window=window
    )


def content(made: CalibratedRecording) -> tuple[int, ...]:
    """What stands for the measurements behind a calibration: the smallest hashes of its transitions, whatever their order,
    names and units. Two recordings have as large a part of these in common as of all (Broder 1997).
    """
    low, width = made.domain.low, made.domain.width
    z, r = (np.concatenate([getattr(part, k) for part in (made.fit, made.held)]) for k in ("z", "r"))
    # Shares of the ranges, so that units do not count; sorted, so that the order of the axes does not; and rounded as no logger
    # rounds, so that few lie between two.
    shares = np.hstack([np.sort((z - low) / width, axis=1), np.sort(r / width[: r.shape[1]], axis=1)])
    rows = np.round(shares * 790_569.4).astype(np.int64)
    return tuple(sorted({int(hashlib.sha256(row.tobytes()).hexdigest()[:16], 16) for row in rows})[:_SKETCH])


def _dealt(found: Windows, fit: float, violation: float, beta: float | None, window: float | None) -> int:
    """How many windows go to the fit; UsageError where too few are left for the claim."""
    units = len(found)
    fitted, need = max(1, int(units * fit)), order_statistics.units_needed(violation, beta)
    if units - fitted >= need:
        return fitted
    total = next(n for n in itertools.count(need + 1) if n - max(1, int(n * fit)) >= need)
    what, left = "trajectories" if window is None else f"windows of {window:g} s", max(1, units - fitted)
    asked = f"ε = {violation:g}" + ("" if beta is None else f", β = {beta:g}")
    raise UsageError(
        f"{CALLER}: {units} {what} have transitions in the domain, {fitted} of them for the fit; {asked} needs {need} others, "
        f"{total} in all, and {left} allow {order_statistics.smallest(left, beta):g} at best; record more, take shorter "
        f"windows if these are {'exchangeable' if beta is None else 'independent'} too, or ask for a larger violation"
        + (f" ({found.copies.told})" if found.copies.found else "")
    )


def _problem(
    model: Model,
    domain: Domain,
    own: Windows,
    family: GapFamily | None,
    lipschitz: LipschitzEstimator | None,
    predictor: Predictor | Model | None,
    seed: int,
) -> GapProblem:
    if family is not None and (family.lattice or "dominate" not in family.routes):
        raise UsageError(
            f"{CALLER}: family '{family.name}' needs samples at points of its own choice, and a recording has "
            f"others; use envelope or constant"
        )
    pick = np.linspace(0, len(own.z) - 1, min(_FITTED, len(own.z))).astype(int)
    samples = Samples(own.z[pick], own.r[pick])
    size = np.abs(own.z[:, : model.nx]).max(axis=0) + np.abs(own.r).max(axis=0)
    e = np.asarray(model.resolution(size) + 4 * np.spacing(size))
    p = predictor if predictor is not None else getattr(family, "predictor", "affine")
    chosen = predictor_of(p, samples, model, domain, CALLER)
    asked = LipschitzProblem(domain, chosen, e, _unanswered, model, model, seed)
    constants = (lipschitz or NoConstants()).bound(asked)
    return GapProblem(samples, domain, constants, chosen, e, "dominate", seed)


def _unanswered(name: str, z: Array) -> Array:
    raise UsageError(
        f"{CALLER}: constants cannot be estimated, since a recording answers no questions; declare them, or take none"
    )


def _sentences(
    model: Model,
    domain: Domain,
    window: float | None,
    found: Windows,
    held: int,
    rank: int,
    violation: float,
    beta: float | None,
) -> tuple[str, ...]:
    unit = "a whole trajectory" if window is None else f"a window of {window:g} s"
    like = "exchangeable: their order says nothing" if beta is None else "independent draws of one distribution"
    level = (
        "on average over such calibrations; this one may be worse, and no confidence is stated for it."
        if beta is None
        else f"unless this calibration is one of a share β = {beta:g} that are worse."
    )
    rows = found.unused
    once = f"{found.copies.told}; windows with such rows are left out."
    return (
        f"The unit is {unit}: {len(found)} have transitions in the domain, and these units, with the one that the claim is "
        f"about, are {like}. That is assumed, not tested; a machine that wears, warms up or decays breaks it.",
        f"{held} units that the fit has not seen, chosen at random, set the band by the score of rank {rank}. A further unit "
        f"has a transition outside with probability {violation:g} at most, {level}",
        "Model, domain, windows and family were chosen before anyone looked at how the held units come out.",
        f"The residual is what was measured, noise included, over one period of {model.period:g} s with the input held, where "
        f"a transition begins in Z: {in_words(model, domain)}. Of {rows['all']:,} rows {rows['no_transition']:,} begin no such "
        f"transition and {rows['outside']:,} one outside Z or in no whole window; nothing is said of them.",
        "It does not carry over to other inputs, machines or days, nor to a closed loop that chooses its own points.",
        *((once,) if found.copies.found else ()),
    )
