"""A stored calibration, made again: its points, their scores with outward rounding, the rank and what that rank allows."""

from __future__ import annotations

from decimal import Decimal

import numpy as np

from gapcert import calibration
from gapcert.errors import UsageError
from gapcert.intervals import Interval
from gapcert.saved import Array, Evidence, predictor, uncalibrated

_SLACK = 1e-9


def names(e: Evidence) -> list[str]:
    """The rounds that hold the calibration: one per draw of the noise."""
    if e.data["route"] != "calibrate":
        return []
    made = e.data["calibration"]
    return [f"calibration-{made['number']}", *(f"calibration-{made['number']}.{d}" for d in range(1, made["repeats"]))]


def noise(e: Evidence) -> str:
    """What the claim's distribution says of the noise of a stochastic backend."""
    made = e.data.get("calibration", {})
    if not made.get("noise"):
        return ""
    repeats = made["repeats"]
    return calibration.NOISE if repeats == 1 else calibration.NOISE_OF.format(repeats)


def calibrated(e: Evidence) -> str | None:
    """ "" where points, counts, scale, scores and rank are those that give the stored widening, and the claim its ε and β."""
    stored = [name for name in e.data["digests"] if name.startswith("calibration-")]
    if e.data["route"] != "calibrate":
        moved = any(name.startswith("gap.calibrated.") for name in e.arrays)
        return "a calibration is stored, and the route is another one" if stored or moved or "calibration" in e.data else None
    made = e.data["calibration"]
    if not all(isinstance(made[k], int) for k in ("number", "repeats", "exceedances")) or made["repeats"] < 1:
        return "number, repeats and exceedances of the calibration are no whole numbers"
    if made["number"] != e.data["audit"]["number"] or sorted(stored) != sorted(names(e)):
        return (
            f"calibration {made['number']} and audit {e.data['audit']['number']} do not belong together, or draws are missing"
        )
    rounds = [e.round(name) for name in names(e)]
    z = rounds[0][0]
    if text := _points(e, z, [other for other, _ in rounds]):
        return text
    if text := _scale(e):
        return text
    return _rank(e, z, [r for _, r in rounds])


def _points(e: Evidence, z: Array, all_z: list[Array]) -> str:
    made, audit = e.data["calibration"], e.data["audit"]
    epsilon, k, m = audit["epsilon"], made["number"], made["exceedances"]
    try:
        rng = np.random.default_rng([e.data["seed"], k, calibration.STREAM])
        drawn = e.zone.draw(len(z), rng)
    except UsageError as error:
        return str(error)
    if not all(np.array_equal(drawn, other) for other in all_z):
        return "other points were calibrated with than (seed, k) draws"
    if made["points"] != len(z) or e.data["samples"]["calibration"] != len(z) * len(all_z):
        return f"{len(z)} points are stored, {made['points']} and {e.data['samples']['calibration']} are stated"
    if m < 0 or calibration.missed(m, len(z), epsilon) > Decimal(audit["beta"] / 2**k):
        return f"{len(z)} points of which {m} may exceed the score do not give ε = {epsilon:g} at β_k"
    allowed = calibration.surprising(audit["points"], epsilon) - 1
    if audit["allowed"] != allowed:
        return f"{audit['allowed']} violations of the audit are said to be allowed; ε = {epsilon:g} allows {allowed}"
    attack = e.data.get("attack", {})
    if attack and attack["allowed"] != calibration.surprising(attack["points"], epsilon) - 1:
        return f"{attack['allowed']} violations of the attack are said to be allowed, which ε = {epsilon:g} does not"
    return ""


def _scale(e: Evidence) -> str:
    """Mean |r_i − p_i| over the samples, or the resolution: what it was before the calibration's points were drawn."""
    (z, r), scale = e.samples, e.arrays["calibration.scale"]
    g = abs(Interval.exact(r) - predictor(e, z, "predictor.samples"))
    floor = np.maximum(e.rounding, np.finfo(float).tiny)
    low, high = (np.maximum(np.asarray(end).mean(axis=0), floor) for end in (g.lo, g.hi))
    if scale.shape != floor.shape or not ((low * (1 - _SLACK) <= scale) & (scale <= high * (1 + _SLACK))).all():
        return f"the scale of scores is stated as {scale.tolist()}, and the samples give {high.tolist()}"
    return "" if np.array_equal(e.arrays["gap.calibrated.resolution"], e.rounding) else "the resolution is another one"


def _rank(e: Evidence, z: Array, residuals: list[Array]) -> str:
    """The score is the (N − m)-th smallest, as far as rounding leaves it open; the widening is that many scales."""
    made, scale = e.data["calibration"], e.arrays["calibration.scale"]
    low, high = uncalibrated(e, z, "predictor.calibration")
    ends = np.full((2, len(z)), -np.inf)
    # The function as it was computed lies outside of the exact one by some ulp.
    slack = 64 * np.spacing(np.maximum(np.abs(low.lo), np.abs(high.hi))) + e.rounding
    for r in residuals:
        least = np.maximum(low.lo - slack - r, r - high.hi - slack) / scale
        most = np.maximum(low.hi - r, r - high.lo) / scale
        ends = np.maximum(ends, np.stack([least.max(axis=1), most.max(axis=1)]))
    rank = len(z) - made["exceedances"]
    first, last = (calibration.ranked(own, rank) for own in ends)
    room = _SLACK * max(abs(first), abs(last))
    if not first - room <= made["score"] <= last + room:
        return f"the score of rank {rank} is stated as {made['score']:.12g}, and lies in [{first:.12g}, {last:.12g}]"
    w = e.arrays["gap.calibrated.widening"]
    if not np.array_equal(w, calibration.widening(made["score"], scale)) or w.tolist() != made["widening"]:
        return "the widening is not the score times the scale"
    return ""
