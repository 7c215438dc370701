"""How wrong is a model beside a recording? A band about its residuals, calibrated on windows that its fit has not seen."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import calibration
from gapcert.calibrated import CalibratedGap, NoConstants, ends, scale_of
from gapcert.check import Certified
from gapcert.check.transitions import Transitions
from gapcert.claim import Claim
from gapcert.components import registry
from gapcert.coordinates import in_words
from gapcert.domain import Domain
from gapcert.errors import UsageError
from gapcert.gap import AffinePredictor, GapFamily, GapProblem, ModelPredictor, Predictor, Samples
from gapcert.lipschitz import LipschitzEstimator, LipschitzProblem
from gapcert.recording import Recording
from gapcert.sampling import npz_bytes, write_atomic
from gapcert.system import Array, Model

Index = npt.NDArray[np.intp]
_FITTED = 300  # transitions that a fit is given: neighbours in time say nearly the same, and scores are made again with each


@final
@dataclass(frozen=True)
class Windows:
    """Transitions in Z, z (n, nz) and r (n, nx), and the number of the window that each lies in (n,)."""

    z: Array
    r: Array
    window: Index

    def of(self, windows: Index) -> Windows:
        rows = np.isin(self.window, windows)
        return Windows(self.z[rows], self.r[rows], self.window[rows])


@final
@dataclass(frozen=True)
class CalibratedRecording:
    """A band that holds for all transitions of a further window, with probability 1 − ε on average over calibrations.

    `units` windows met Z; those of `fit` gave the band, those of `held` its widening: score · scale, (nx,).
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

    @property
    def certified(self) -> Certified:
        """For `check`, which holds other recordings against the band."""
        return Certified(self.model, self.problem.domain.zone, self.gap.interval)

    def gamma(self, x: Array, u: Array) -> Array:
        """γ(x, u): x (n, nx), u (n, nu) → (n, nx)."""
        return self.gap.gamma(np.hstack([x, u]))

    def summary(self) -> dict[str, Any]:
        windows = {"fit": len(np.unique(self.fit.window)), "calibration": len(np.unique(self.held.window))}
        return {
            "claim": self.claim.summary(),
            "family": self.gap.family,
            "route": "calibrate",
            "assumptions": list(self.assumptions),
            "recording": {
                "units": self.units,
                "windows": windows,
                "transitions": {"fit": len(self.fit.z), "calibration": len(self.held.z)},
                "rank": self.rank,
                "score": self.score,
                "widening": self.gap.widening.tolist(),
            },
        }

    def save(self, folder: Path | str) -> None:
        """`certificate.json` and `certificate.npz`, with all transitions: `gapcert verify` makes rank and scores again."""
        p, where = self.problem, Path(folder)
        arrays: dict[str, npt.NDArray[Any]] = {f"gap.{k}": v for k, v in self.gap.arrays().items()}
        arrays |= {f"predictor.{k}": v for k, v in p.predictor.arrays().items()}
        arrays |= {"lipschitz": p.lipschitz.value, "resolution": p.resolution, "remainder.resolution": p.remainder_resolution}
        arrays |= {"fit.z": p.samples.z, "fit.r": p.samples.r, "fit.windows": np.unique(self.fit.window)}
        arrays |= {"held.z": self.held.z, "held.r": self.held.r, "held.window": self.held.window}
        arrays |= {"calibration.scale": self.scale}
        if p.predictor.kind == "model":
            arrays |= {"predictor.samples": p.predictor(p.samples.z), "predictor.calibration": p.predictor(self.held.z)}
        content, domain = npz_bytes(arrays), p.domain
        data = {
            **self.summary(),
            "form": dict(self.gap.form),
            "predictor": p.predictor.kind,
            "lipschitz": p.lipschitz.summary(domain.axes),
            "domain": {
                "axes": [a.name for a in domain.axes],
                "states": domain.nx,
                "low": domain.low.tolist(),
                "high": domain.high.tolist(),
                "relations": [{"text": r.text, "a": list(r.coefficients), "b": r.bound} for r in domain.relations],
            },
            "cover": None,
            "seed": p.seed,
            "digests": {},
            "arrays": hashlib.sha256(content).hexdigest(),
        }
        where.mkdir(parents=True, exist_ok=True)
        write_atomic(where / "certificate.npz", content)
        write_atomic(where / "certificate.json", json.dumps(data, indent=1, sort_keys=True).encode())


def calibrate_recording(
    model: Model,
    recording: Recording,
    domain: Domain,
    *,
    violation: float = 0.05,
    window: float | None = None,
    fit: float = 1 / 3,
    family: GapFamily | None = None,
    lipschitz: LipschitzEstimator | None = None,
    predictor: Predictor | Model | None = None,
    seed: int = 0,
) -> CalibratedRecording:
    """A band [l, u] about r = x⁺ − f(x, u) in which all transitions of a further window lie, with probability 1 − violation.

    window: its length in s; None: a whole trajectory. Windows are taken as exchangeable, and are split at random: about a share
    `fit` of them gives the band (family `envelope` with an affine predictor, without constants), the others widen it to the
    ⌈(n + 1)(1 − ε)⌉-th smallest of their scores, each the largest of a window's transitions in Z. The claim is marginal: on
    average over the calibrations that might have been. UsageError where there are too few windows.
    """
    found = _windows(model, recording, domain, window)
    units = np.unique(found.window)
    fitted = max(1, int(len(units) * fit))
    if not 0 < fit < 1:
        raise UsageError(f"calibrate_recording: fit = {fit}; expected a share between 0 and 1")
    if len(units) - fitted < (need := calibration.conformal_points(violation)):
        what = "trajectories" if window is None else f"windows of {window:g} s"
        left = max(1, len(units) - fitted)
        raise UsageError(
            f"calibrate_recording: {len(units)} {what} have transitions in the domain, {fitted} of them for the fit; ε = "
            f"{violation:g} needs {need} others, and {left} allow {calibration.smallest(left):g} at best; record more, take "
            f"shorter windows if these are exchangeable too, or ask for a larger violation"
        )
    order = calibration.split(len(units), seed)
    own, held = found.of(order[:fitted]), found.of(order[fitted:])
    problem = _problem(model, domain, own, family, lipschitz, predictor, seed)
    made = family or registry().build("gap_family", "envelope")
    gap, scale = made.fit(problem), scale_of(problem)
    low, high = ends(gap, held.z)
    each = calibration.worst(calibration.scores(held.r, low, high, scale), held.window)
    rank = calibration.conformal_rank(len(each), violation)
    score = calibration.ranked(each, rank)
    band = CalibratedGap(gap, calibration.widening(score, scale), problem.arithmetic)
    claim = Claim("statistical", violation, None, calibration.WINDOWS)
    said = _sentences(model, domain, window, len(units), len(each), rank, violation)
    return CalibratedRecording(band, problem, model, claim, said, len(units), own, held, scale, rank, score)


def _windows(model: Model, recording: Recording, domain: Domain, window: float | None) -> Windows:
    """Transitions that begin in Z and lie in one whole window; windows are numbered among those that have any."""
    steps = Transitions.of(model, recording)
    if window is not None and not window >= model.period:
        raise UsageError(f"calibrate_recording: window = {window} s; expected at least the period of {model.period:g} s")
    number = np.zeros(len(steps), dtype=np.int64)
    keep = np.ones(len(steps), dtype=bool)
    if window is not None:
        ends = [(float(np.nanmin(tr.t)), float(np.nanmax(tr.t))) for tr in recording.trajectories]
        first, last = (np.array(side)[steps.trajectory] for side in zip(*ends, strict=True))
        slack = 1e-9 * window
        number = np.floor((steps.t - first + slack) / window).astype(np.int64)
        begin = first + number * window
        keep = (steps.t + model.period <= begin + window + slack) & (begin + window <= last + slack)
    known = Certified(model, domain.zone, _none)
    z = known.points(steps.x, steps.u)
    keep &= domain.contains(z)
    if not keep.any():
        raise UsageError("calibrate_recording: no transition of a whole window begins in the domain; take a larger one")
    both = np.stack([steps.trajectory, number], axis=1)[keep]
    _, which = np.unique(both, axis=0, return_inverse=True)
    r = known.residual(steps.x[keep], steps.u[keep], steps.x_next[keep])
    return Windows(z[keep], r, np.asarray(which, dtype=np.intp).reshape(-1))


def _none(z: Array) -> tuple[Array, Array]:
    return z, z


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
            f"calibrate_recording: family '{family.name}' needs samples at points of its own choice, and a recording has "
            f"others; use envelope or constant"
        )
    pick = np.linspace(0, len(own.z) - 1, min(_FITTED, len(own.z))).astype(int)
    samples = Samples(own.z[pick], own.r[pick])
    size = np.abs(own.z[:, : model.nx]).max(axis=0) + np.abs(own.r).max(axis=0)
    e = np.asarray(model.resolution(size) + 4 * np.spacing(size))
    p = predictor if predictor is not None else getattr(family, "predictor", "affine")
    chosen = ModelPredictor(p, model) if isinstance(p, Model) else p
    if not isinstance(chosen, Predictor):
        chosen = AffinePredictor.fit(samples) if chosen == "affine" else AffinePredictor.none(model.nx, len(domain.low))
    asked = LipschitzProblem(domain, chosen, e, _unanswered, model, model, seed)
    constants = (lipschitz or NoConstants()).bound(asked)
    return GapProblem(samples, domain, constants, chosen, e, "dominate", seed)


def _unanswered(name: str, z: Array) -> Array:
    raise UsageError(
        "calibrate_recording: constants cannot be estimated, since a recording answers no questions; declare them, or take none"
    )


def _sentences(
    model: Model, domain: Domain, window: float | None, units: int, held: int, rank: int, violation: float
) -> tuple[str, ...]:
    unit = "a whole trajectory" if window is None else f"a window of {window:g} s"
    return (
        f"The unit is {unit}: {units} have transitions in the domain, and these units, with the one that the claim is about, "
        f"are exchangeable: their order says nothing. That is assumed, not tested; a machine that wears, warms up or decays "
        f"breaks it.",
        f"{held} units that the fit has not seen, chosen at random, set the band by the score of rank {rank}. A further unit "
        f"has a transition outside with probability {violation:g} at most, on average over such calibrations; this one may be "
        f"worse, and no confidence is stated for it.",
        f"The residual is what was measured, noise included, over one period of {model.period:g} s with the input held, where "
        f"a transition begins in Z: {in_words(model, domain)}.",
        "It does not carry over to other inputs, machines or days, nor to a closed loop that chooses its own points.",
    )
