"""A stored calibration, made again: its points, their scores with outward rounding, the rank and what that rank allows."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from decimal import Decimal
from typing import Any

import numpy as np

from gapcert.plugin import Array, Interval, UsageError, order_statistics

from .evidence import Evidence, predictor, uncalibrated

_SLACK = 1e-9  # relative: sums in another order differ by less


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
    return order_statistics.NOISE if repeats == 1 else order_statistics.NOISE_OF.format(repeats)


def draws(e: Evidence, stream: str) -> np.random.Generator:
    """What the points of audit or calibration are drawn from; without an entry in the book, by the rule from before."""
    audit = e.data["audit"]
    book = {k: audit["book"][k] for k in ("question", "audited")} if "book" in audit else {}
    return order_statistics.drawing(e.data["seed"], audit["number"], stream, **book)


def miscounted(e: Evidence) -> str:
    """ "" where the entry in the book, if there is one, is of the stored function, and of the claim that was asked for."""
    audit, made = e.data["audit"], e.data.get("calibration")
    if "book" not in audit:
        return ""
    key = e.stored(f"audit-{audit['number']}")[0]["key"]
    text = f"{_function(e, calibrated=made is None)}:{key}:{audit['epsilon']!r}:{audit['beta']!r}"
    if made is not None:
        text = f"calibrate:{text}:{made['exceedances']}:{made['repeats']}"
    return _entered(audit, "audit" if made is None else "calibration", text)


def _function(e: Evidence, calibrated: bool) -> str:
    """Identity of the stored function, before or after it was calibrated."""
    of = hashlib.sha256(json.dumps([e.data["family"], e.data["form"], e.data["seed"]], sort_keys=True).encode())
    for name, array in sorted(e.arrays.items()):
        if name.startswith("gap.") and (calibrated or not name.startswith("gap.calibrated.")):
            of.update(name[4:].encode() + np.ascontiguousarray(array).tobytes())
    return of.hexdigest()


def _entered(stated: Mapping[str, Any], kind: str, text: str) -> str:
    """ "" where the book's entry is of this text, or there is none."""
    if (book := stated.get("book")) is None:
        return ""
    own = {"number": stated["number"], "kind": kind, "audited": hashlib.sha256(text.encode()).hexdigest()}
    same = all(book[k] == v for k, v in own.items()) and book["question"]
    return "" if same else "the entry in the book is not of what was audited"


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
    if not (0 < epsilon < 1 and 0 < audit["beta"] < 1 and k >= 1):
        return f"ε = {epsilon}, β = {audit['beta']}, calibration {k} are no probabilities of a numbered calibration"
    try:
        drawn = e.zone.draw(len(z), draws(e, "calibration"))
    except UsageError as error:
        return str(error)
    if not all(np.array_equal(drawn, other) for other in all_z):
        return "other points were calibrated with than its number and its seed draw"
    if made["points"] != len(z) or e.data["samples"]["calibration"] != len(z) * len(all_z):
        return f"{len(z)} points are stored, {made['points']} and {e.data['samples']['calibration']} are stated"
    if m < 0 or order_statistics.missed(m, len(z), epsilon) > Decimal(audit["beta"] / 2**k):
        return f"{len(z)} points of which {m} may exceed the score do not give ε = {epsilon:g} at β_k"
    allowed = order_statistics.surprising(audit["points"], epsilon) - 1
    if audit["allowed"] != allowed:
        return f"{audit['allowed']} violations of the audit are said to be allowed; ε = {epsilon:g} allows {allowed}"
    attack = e.data.get("attack", {})
    if attack and attack["allowed"] != order_statistics.surprising(attack["points"], epsilon) - 1:
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
    """The score is the (N − m)-th smallest."""
    made = e.data["calibration"]
    return _ranked(e, made, scores(e, z, residuals), len(z) - made["exceedances"])


def scores(e: Evidence, z: Array, residuals: list[Array]) -> Array:
    """(2, n): no more and no less than the score of each point, the largest of its draws."""
    scale = e.arrays["calibration.scale"]
    low, high = uncalibrated(e, z, "predictor.calibration")
    ends = np.full((2, len(z)), -np.inf)
    # The function as it was computed lies outside of the exact one by some ulp.
    slack = 64 * np.spacing(np.maximum(np.abs(low.lo), np.abs(high.hi))) + e.rounding
    for r in residuals:
        least = np.maximum(low.lo - slack - r, r - high.hi - slack) / scale
        most = np.maximum(low.hi - r, r - high.lo) / scale
        ends = np.maximum(ends, np.stack([least.max(axis=1), most.max(axis=1)]))
    return ends


def _ranked(e: Evidence, made: Mapping[str, Any], ends: Array, rank: int) -> str:
    """ "" where the score has that rank, as far as rounding leaves it open, and the widening is so many scales."""
    scale = e.arrays["calibration.scale"]
    first, last = (order_statistics.ranked(own, rank) for own in ends)
    room = _SLACK * max(abs(first), abs(last))
    if not first - room <= made["score"] <= last + room:
        return f"the score of rank {rank} is stated as {made['score']:.12g}, and lies in [{first:.12g}, {last:.12g}]"
    w = e.arrays["gap.calibrated.widening"]
    if not np.array_equal(w, order_statistics.widening(made["score"], scale)) or w.tolist() != made["widening"]:
        return "the widening is not the score times the scale"
    return ""


def windows(e: Evidence) -> str:
    """ "" where the held windows of a recording are those that the seed deals, and their rank gives the widening."""
    made, arrays, z = e.data["recording"], e.arrays, e.arrays["held.z"]
    held, fitted = np.unique(arrays["held.window"]), arrays["fit.windows"]
    if not (isinstance(made["units"], int) and isinstance(made["rank"], int) and len(held) + len(fitted) == made["units"]):
        return f"{len(held)} held and {len(fitted)} fitted windows are stored, {made['units']} are stated"
    order = order_statistics.split(made["units"], e.data["seed"])
    dealt = np.sort(order[: len(fitted)]), np.sort(order[len(fitted) :])
    if not (np.array_equal(dealt[0], fitted) and np.array_equal(dealt[1], held)):
        return "the windows were dealt otherwise than the seed does"
    counts = made["windows"]["fit"], made["windows"]["calibration"], made["transitions"]["calibration"]
    if counts != (len(fitted), len(held), len(z)):
        return f"{len(fitted)} and {len(held)} windows with {len(z)} transitions are stored, {counts} are stated"
    if not (e.zone.contains(z).all() and e.zone.contains(arrays["fit.z"]).all()):
        return "a transition begins outside Z"
    spent = {"bound": len(arrays["fit.z"]), "calibration": len(z)}
    if e.data["samples"] != spent:
        return f"{spent} transitions are stored, {e.data['samples']} are stated"
    if text := _enough(e.data["claim"], len(held), made["rank"]):
        return text
    if text := _scale(e):
        return text
    ends = np.stack([order_statistics.worst(own, arrays["held.window"]) for own in scores(e, z, [arrays["held.r"]])])
    text = f"recording:{_function(e, calibrated=True)}:{e.data['claim']['epsilon']!r}:{e.data['claim'].get('beta')!r}"
    return _ranked(e, made, ends, made["rank"]) or _entered(made, "calibration", text)


def _enough(claim: Mapping[str, Any], n: int, rank: int) -> str:
    """ "" where that rank of n windows gives ε: on average over calibrations, or at β where the claim has one."""
    epsilon, beta = claim["epsilon"], claim.get("beta")
    possible = 0 < epsilon < 1 and rank <= n and (beta is None or 0 < beta < 1)
    if possible and beta is None:
        enough = n >= order_statistics.conformal_points(epsilon) and order_statistics.conformal_rank(n, epsilon) <= rank
    else:
        enough = possible and beta is not None and order_statistics.missed(n - rank, n, epsilon) <= Decimal(beta)
    return (
        ""
        if enough
        else f"rank {rank} of {n} windows does not give ε = {epsilon:g}" + ("" if beta is None else f", β = {beta:g}")
    )


def further(e: Evidence) -> str:
    """ "" where the claim of a recording is the one about a further window: without a confidence, or of independent draws."""
    claim = e.data["claim"]
    if claim["kind"] != "statistical" or set(claim) - {"beta"} != {"kind", "epsilon", "distribution"}:
        return "a recording gives a statistical claim, and another one is stated"
    if claim["distribution"] != (order_statistics.DRAWN_WINDOWS if "beta" in claim else order_statistics.WINDOWS):
        return "the claim is about a further window, drawn independently where there is a confidence, and another one is stated"
    return "" if e.data["route"] == "calibrate" else "a recording's claim is on route calibrate"
