"""What γ is compared with, found again: the smallest constant of each state, the envelope's mean, and the transitions spent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapcert.plugin import Array, order_statistics

from .calibration import names as calibrations
from .evidence import Evidence, envelope, predictor
from .margin import reach
from .proofs import exceeds
from .sentences import states

_TIGHT, _LOOSE = 0.99, 0.5
"""Of a stated constant bound: a smaller one is proved where it was inflated. A search that ended early is not so tight."""
_BOXES = 20_000  # that the proof may take
_EARLY = 2_000  # samples from which on the first search may have ended early
_LOOKS = 300_000_000  # of audited points at samples, for an envelope's mean


def yardsticks(e: Evidence) -> str | None:
    """ "" where constant bounds, envelope's means and safety factors are those that samples and constants give."""
    if "samples" not in e.data:
        return None
    safety = e.data["lipschitz"]["safety"]
    made, mean = _constants(e), _envelope(e)
    for i, name in enumerate(states(e)):
        s = e.data["states"][name]
        if s["safety_factor"] != safety:
            return f"{name}.safety_factor is stated as {s['safety_factor']}, and that of the constants is {safety}"
        if made is not None and not _near(s["constant_bound"], made[i], 1e-6 * made[i]):
            return f"{name}.constant_bound is stated as {s['constant_bound']:.6g}, and follows as {made[i]:.6g}"
        if made is None and (text := _bracketed(e, i, s["constant_bound"])):
            return f"{name}.constant_bound: {text}"
        if ("tightness_vs_envelope" in s) != ("envelope_mean" in s and s["resolved"]):
            return f"{name}.tightness_vs_envelope is stated otherwise than the envelope is known"
        known = s.get("envelope_mean")
        if known is None and mean is not None:
            return f"{name}.envelope_mean is left out"
        if known is not None and mean is not None and not _near(known, mean[i], 1e-9 * mean[i] + 4 * e.rounding[i]):
            return f"{name}.envelope_mean is stated as {known:.9g}, and follows as {mean[i]:.9g}"
        ratio = s.get("tightness_vs_envelope")
        if ratio is not None and not abs(ratio - s["gamma_mean"] / known) <= 1e-9 * ratio:
            return f"{name}.tightness_vs_envelope is no ratio of the means"
    return ""


def _near(a: float, b: float, within: float) -> bool:
    """Also where both are infinite, as an envelope over unbounded constants is."""
    return a == b or abs(a - b) <= within < np.inf


def _constants(e: Evidence) -> Array | None:
    """(nx,) where they follow without a search."""
    route, r = e.data["route"], e.samples[1]
    if route == "theorem1":
        return np.asarray(np.abs(r).max(axis=0) + reach(e))
    if route == "declared":
        return e.arrays["gap.gamma"]
    return _calibrated(e) if route == "calibrate" else None


def _calibrated(e: Evidence) -> Array:
    """What the points of a calibration make of a constant."""
    if e.data["form"]["form"] == "constant":
        moved = e.arrays["gap.gamma"] + e.arrays["gap.calibrated.widening"]
        return np.asarray(np.maximum(moved, 0.0) + e.arrays["gap.calibrated.resolution"])
    size = np.maximum(np.abs(e.samples[1]).max(axis=0), e.rounding)
    if "recording" in e.data:
        each, rank = _scores([e.arrays["held.r"]], size), e.data["recording"]["rank"]
        each = order_statistics.worst(each, e.arrays["held.window"])
    else:
        each = _scores([e.round(name)[1] for name in calibrations(e)], size)
        rank = len(each) - e.data["calibration"]["exceedances"]
    return np.asarray(order_statistics.ranked(each, rank) * size + e.rounding)


def _scores(rounds: Sequence[Array], size: Array) -> Array:
    return np.asarray(np.max([(np.abs(r) / size).max(axis=1) for r in rounds], axis=0))


def _bracketed(e: Evidence, i: int, stated: float) -> str:
    """ "" where the envelope is not proved to stay well below the stated constant, and reaches no more at the samples."""
    if e.data["predictor"] == "model":
        return ""  # between the samples its model would have to be bounded
    z = e.samples[0][:: max(1, len(e.samples[0]) // 500)]
    low, high = (end[:, i] for end in envelope(e, z, predictor(e, z, "")))
    if float(np.maximum(-low.hi, high.lo).max()) > stated * (1 + 1e-9):
        return f"it is stated as {stated:.6g}, and the envelope reaches more"
    share = _TIGHT if len(e.samples[0]) <= _EARLY else _LOOSE
    told = [part for part in e.parts if len(part.z)]
    if not exceeds(e, i, share * stated, _BOXES) and told:
        return f"it is stated as {stated:.6g}, and {share * stated:.6g} bounds the envelope"
    return ""


def _envelope(e: Evidence) -> Array | None:
    """(nx,) the mean of the envelope's γ over the audit's points; None where there is none, or it is dear."""
    z, many = e.audit[0] if "audit" in e.data else np.zeros((0, 0)), len(e.samples[0])
    if e.data["route"] not in ("theorem1", "dominate") or len(z) * many > _LOOKS:
        return None
    if e.data["route"] == "theorem1" and many > 20_000 and e.data["family"] != "envelope":
        return None
    low, high = e.audited if e.data["form"]["form"] == "envelope" else envelope(e, z, predictor(e, z, "predictor.audit"))
    return np.asarray(np.maximum(np.abs(low.lo), np.abs(high.hi)).mean(axis=0))


def _transitions(e: Evidence, name: str) -> int:
    """Those of a round: a row of pairs, under a common hidden state, is two."""
    points, n = e.folder / "samples" / name / "points.npy", len(e.stored(name)[1])
    return n * (np.load(points, mmap_mode="r").shape[1] // len(e.zone.low)) if points.exists() else n


def spent(e: Evidence) -> str | None:
    """ "" where as many transitions were spent on constants as rounds of them are stored."""
    if not e.data.get("digests"):
        return None
    others = ("bound-", "audit-", "calibration-", "symmetry")
    found = sum(_transitions(e, name) for name in e.data["digests"] if not name.startswith(others))
    stated = e.data["samples"]["lipschitz"]
    if found != stated:
        return f"{stated} transitions are said to be behind the constants, and {found} are stored"
    pairs = e.data["symmetry"]["pairs"] if e.data.get("symmetry") else None
    told = e.data["samples"].get("symmetry")
    return "" if told == (None if pairs is None else 2 * pairs) else "the pairs of the symmetry are counted otherwise"
