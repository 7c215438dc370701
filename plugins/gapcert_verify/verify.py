"""Re-checks a saved certificate from its data: no code of fitting, sampling or plugins takes part.

Every bound is recomputed with outward-rounded intervals from the stored samples and constants, and a check fails where it fails
for certain. What was proved by branch and bound, or by a network's multipliers, is proved once more on the stored data, by the
same prover. What no data can show is listed under `trusted`: that the residuals are those of f̂ and f, and whence the constants.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gapcert.plugin import DAMAGE, Array, Emit, GapcertError, Interval, UsageError, on_curvature, silent

from . import sentences
from . import statements as stated
from .calibration import calibrated, draws, further, miscounted, names, noise, windows
from .controllers.saved import controlled
from .evidence import Evidence, Part, another, bounds, distance, load, predictor
from .margin import margin
from .proofs import bent, dominates, exceeds, follows
from .run_folder.fields import fields
from .run_folder.origin import CHECKS as ORIGIN
from .run_folder.origin import Check, Origin, arithmetic, gates, origin, shifted
from .run_folder.origin import again as again_of
from .run_folder.pictures import figures, page
from .run_folder.summary import root, summary, whole_run
from .yardsticks import spent, yardsticks

ROUTES = {
    "envelope": ("dominate",),
    "constant": ("dominate", "theorem1", "declared"),
    "basis": ("theorem1",),
    "dominating": ("dominate",),
    "multilinear": ("dominate",),
    "network": ("theorem1",),
}
"""Route calibrate certifies any of them."""
FOLDER: tuple[tuple[str, Check], ...] = (
    ("the summary says what follows", summary),
    ("pictures show what is stored", figures),
    ("the page is that of summary and figures", page),
)
LATER = (arithmetic, gates, shifted, figures, page)
"""What a certificate of before format 2 has no data for, or said in other words: it is told as trusted there."""
CLAIMS = ("deterministic", "statistical", "empirical", "assumed")
PROVENANCES = ("analytic", "interval", "declared", "estimated")
UNIFORM = "uniform on X × U"


def verify_run(folder: Path | str, emit: Emit = silent, *, allow_code: bool = False, again: int = 0) -> dict[str, Any]:
    """{"verdict": "holds" | "fails", "claim", "checks": [{"check", "passed", "detail"}], "trusted": [sentence]}.

    emit: takes the progress of long proofs. allow_code: models that are code are run. again: so many stored transitions are
    stepped once more, by whatever backend the spec names. UsageError where there is no certificate.
    """
    evidence = load(Path(folder))
    checks: list[tuple[str, Callable[[Evidence], str | None]]] = [
        ("stored data match their digests", _digests),
        ("samples do not contradict the constants", _consistent),
        ("γ ≥ |r| on every sample of the bound", _samples),
        ("the stored function is the one that samples and constants give", _function),
        ("the margin covers the cover's radius", margin),
        ("a cover is stated where the samples are one", _covered),
        ("the audit's points are those that its seed draws", _drawn),
        ("sampled and audited points lie in Z", _within),
        ("the declared symmetry holds on the pairs that were looked at", stated.symmetry),
        ("what is said of hidden state fits the resolution", stated.hidden),
        ("the cells are as many as stated, and jump as stated", stated.cells),
        ("the calibration gives the widening of the band", calibrated),
        ("the audit has enough points for its ε and β", _enough),
        ("l ≤ r ≤ u at every audited point, as stated", _audit),
        ("figures of the states follow from the audit", stated.figures),
        ("constant bounds and envelopes follow from samples and constants", yardsticks),
        ("as many transitions were spent as are stored", spent),
        ("the claim is one that its evidence allows", _claim),
    ]
    if _bare(evidence):
        checks = [("stored data match their digests", _packed), ("γ is assumed, and is the constant that is stated", _stated)]
    if "recording" in evidence.data:
        checks = [
            ("stored data match their digests", _packed),
            ("the held windows give the widening of the band", windows),
            ("figures of the states follow from the held windows", stated.held_figures),
            ("constant bounds and envelopes follow from samples and constants", yardsticks),
            ("the claim is one that its evidence allows", further),
        ]
    checks += [
        ("constants come from what they are said to come from", _method),
        ("assumptions are those that the data give", _since(sentences.assumptions)),
        ("warnings are those that gates and estimators give", _since(sentences.warnings)),
    ]
    source = _whence(evidence, allow_code, bool(again))
    checks += [
        ("the folder of a run is whole", whole_run),
        ("files match the root digest", root),
        ("the folder's files have no fields of others", fields),
        ("the spec is the one that was run", partial(_specified, source)),
        *((name, partial(_asked, check, source)) for name, check in (*ORIGIN, *FOLDER)),
    ]
    if again and isinstance(source, Origin) and source.whole and "audit" in evidence.data:
        checks.append(_stepped_again(evidence, source, again))
    controller = controlled(evidence, emit)
    checks += [] if controller is None else controller.checks
    results = []
    for name, check in checks:
        outcome = _attempt(check, evidence)
        if outcome is not None:
            results.append({"check": name, "passed": outcome == "", "detail": outcome})
    verdict = "holds" if all(r["passed"] for r in results) else "fails"
    try:
        claim = dict(evidence.data["claim"])
        trusted = [*_trusted(evidence, source), *(() if controller is None else controller.trusted)]
    except DAMAGE as error:
        raise UsageError(
            f"{folder}: certificate.json is damaged ({type(error).__name__}: {error}); run the spec again"
        ) from None
    return {"verdict": verdict, "claim": claim, "checks": results, "trusted": trusted}


def _method(e: Evidence) -> str | None:
    return None if _bare(e) else sentences.method(e)


def _bare(e: Evidence) -> bool:
    """Was γ declared, and nobody asked?"""
    return e.data.get("route") == "declared" and "audit" not in e.data


def _stated(e: Evidence) -> str:
    gamma, names = e.arrays["gap.gamma"], sentences.states(e)
    made = {"claim": {"kind": "assumed"}, "form": {"form": "constant"}, "predictor": "none", "vacuous": False}
    made["states"] = {n: {"gamma_max": g} for n, g in zip(names, gamma.tolist(), strict=True)}
    if other := next((k for k, v in made.items() if e.data.get(k) != v), ""):
        return f"{other} is stated as {e.data.get(other)}, and of a declared γ it is {made[other]}"
    return "" if (np.isfinite(gamma) & (gamma >= 0)).all() else f"γ is {gamma.tolist()}, which bounds nothing"


def _trusted(e: Evidence, source: Origin | str | UsageError) -> list[str]:
    """What the verdict rests on beside the checks."""
    told: list[tuple[str, Any]] = [
        (f"Model, domain, names and what was asked are as stated: {source}.", not isinstance(source, Origin)),
        ("Versions, times, and seed and budgets of the spec that only a new run could tell are as stated.", True),
        ("It is of before format 2: its sentences, e, hidden state, answer, pictures and page are as stated.", e.older),
    ]
    whole = isinstance(source, Origin) and source.text
    if _bare(e):
        return [text for text, so in ((_NOBODY, True), *told) if so]
    if "recording" in e.data:
        alike = "independent draws of one distribution" if "beta" in e.data["claim"] else "exchangeable"
        told += [
            (f"The stored transitions are {_RECORDED}.", True),
            ("The numbers of trajectories and of fitted transitions are as stated.", True),
            ("Which rows of the recording are copies of others is as stated.", sentences.copies(e)),
            (f"The number of the calibration is {_BOOKED}", "book" in e.data["recording"]),
            (f"The windows, and the one that the claim is about, are {alike}, chosen before anyone looked at these.", True),
        ]
        return [text for text, so in told if so]
    origin, why = e.data["lipschitz"], source.why if isinstance(source, Origin) else str(source)
    found = "The constants and the curvature are" if on_curvature(e.data["form"]) else "The constants are"
    constants = f"{found} {origin['provenance']} ({origin['method']}): with what is warned of slopes, as stated."
    if e.data["route"] == "calibrate":
        constants = "A calibrated band rests on no constants, but on points that no fit has seen: the run's order is trusted."
    proved = origin["provenance"] == "interval" and whole and e.data["predictor"] != "multilinear"
    told += [
        (f"{_ONLY}, how it rounds, hidden state, purity and attacks, is as stated: {why}.", not whole),
        ("How f̂ answered when it was asked again is as stated.", whole and not e.data.get("calibration", {}).get("noise")),
        (f"The number of the audit is {_BOOKED}", True),
        (
            "The audit's points were drawn by the rule before the book's format 2, of seed and number: a fit could know them.",
            "book" not in e.data["audit"],
        ),
        (constants, not proved and e.data["route"] != "declared"),
        ("γ is what a person declares. Samples and audit had the chance to refute it.", e.data["route"] == "declared"),
        (
            "The constant lies above the envelope between the samples as stated: its model was not bounded again.",
            e.data["predictor"] == "model" and e.data["form"]["form"] == "constant" and e.data["route"] == "dominate",
        ),
        (
            "The predictor's values at samples and audited points are those of its model, which was not run again.",
            e.data["predictor"] == "model" and not isinstance(source, Origin),
        ),
        (
            f"Of {e.data['samples']['bound']} samples those that are not stored lie within the extremes of their coarse cells.",
            e.reduced,
        ),
        ("The declared symmetry holds beyond the pairs that were looked at.", e.data.get("symmetry")),
        ("The attack with other hidden states is as stated.", whole and "attack" in e.data.get("hidden", {})),
        ("The backend's draws for different seeds are independent.", noise(e)),
        ("The closed loop was not run again: its counts and traces are as stated.", (e.folder / "closed_loop.npz").exists()),
    ]
    return [text for text, so in told if so]


_ONLY = "What only f̂ can tell, that residuals are those of it and of f"
_RECORDED = "all of the recording's that begin in Z, measured when they are drawn to be, and their residuals are those of f"
_BOOKED = "what the book beside the run folders counted; the book was not looked at."
_NOBODY = "γ is what a person declares. No simulator was asked."


def _whence(e: Evidence, allow_code: bool, engine: bool) -> Origin | str | UsageError:
    try:
        return origin(e.folder, allow_code, engine)
    except UsageError as error:
        return error
    except (*DAMAGE, GapcertError) as error:
        return UsageError(f"spec.json cannot be built: {type(error).__name__}: {error}")


def _stepped_again(e: Evidence, source: Origin, n: int) -> tuple[str, Callable[[Evidence], str | None]]:
    try:
        name, outcome = again_of(e, source, n)
    except (*DAMAGE, UsageError) as error:
        name, outcome = f"{n} stored transitions are stepped again", f"{type(error).__name__}: {error}"
    return name, lambda _: outcome


def _specified(source: Origin | str | UsageError, e: Evidence) -> str | None:
    return str(source) if isinstance(source, UsageError) else "" if isinstance(source, Origin) else None


def _asked(check: Check, source: Any, e: Evidence) -> str | None:
    """A check against the spec, where there is one."""
    return check(e, source) if isinstance(source, Origin) and not (e.older and check in LATER) else None


def _since(check: Callable[[Evidence], str | None]) -> Callable[[Evidence], str | None]:
    """A check of what format 2 has the data for."""
    return lambda e: None if e.older else check(e)


def _attempt(check: Callable[[Evidence], str | None], evidence: Evidence) -> str | None:
    """ "" where a check passes, what is wrong where it fails, None where it does not apply."""
    try:
        return check(evidence)
    except DAMAGE as error:
        return f"the stored data are incomplete: {type(error).__name__}: {error}"
    except GapcertError as error:
        return str(error)


def _packed(e: Evidence) -> str:
    same = hashlib.sha256((e.folder / "certificate.npz").read_bytes()).hexdigest() == e.data["arrays"]
    return "" if same else "certificate.npz was changed"


def _digests(e: Evidence) -> str:
    """The arrays, and each shard against its manifest, have the SHA-256 that is stated."""
    if text := _packed(e):
        return text
    if missing := {"bound-0", f"audit-{e.data['audit']['number']}", *names(e)} - set(e.data["digests"]):
        return f"round {min(missing)} is stored without a digest"
    for name, expected in e.data["digests"].items():
        folder = e.folder / "samples" / name
        header, *lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text(encoding="utf-8").splitlines()]
        shards = {line["chunk"]: line for line in lines}
        for i, line in shards.items():
            if hashlib.sha256((folder / f"chunk-{i:06d}.npy").read_bytes()).hexdigest() != line["sha256"]:
                return f"shard {i} of round {name} was changed"
        digests = [[line[k] for k in ("sha256", "residuals") if k in line] for _, line in sorted(shards.items())]
        entries = digests if "extremes" in header else [digest for (digest,) in digests]
        total = hashlib.sha256(json.dumps([header, entries]).encode()).hexdigest()
        if total != expected:
            return f"round {name} was changed"
        points = folder / "points.npy"
        if points.exists():
            z = np.load(points)
            if hashlib.sha256(np.ascontiguousarray(z).tobytes() + str(z.shape).encode()).hexdigest() != header["points"]:
                return f"the points of round {name} were changed"
    return ""


def _consistent(e: Evidence) -> str | None:
    """|g_k − g_m| ≤ Σ L |z_k − z_m| + J + 4 e for pairs of (up to 2,000) samples of a cell: each stored value may err by e."""
    if e.data["route"] in ("calibrate", "declared"):
        return None  # nothing rests on the constants
    if "gap.e" in e.arrays and (e.arrays["gap.e"] < e.arrays["resolution"]).any():
        return "the envelope uses a smaller resolution than the certificate states"
    if not (e.arrays["remainder.resolution"] >= e.arrays["resolution"]).all():
        return "remainders are said to be known to a smaller resolution than the certificate states"
    cells = [name for name in ("cells.L", "cells.J") if name in e.arrays]
    for name in ("lipschitz", "resolution", "remainder.resolution", *cells):
        if not (np.isfinite(e.arrays[name]).all() and (e.arrays[name] >= 0).all()):
            return f"{name} is negative or not finite"
    if on_curvature(e.data["form"]) and (text := bent(e)):
        return text
    return next((text for part in e.parts if (text := _refuted(e, part))), "")


def _refuted(e: Evidence, part: Part) -> str:
    pick = np.linspace(0, len(part.z) - 1, min(2_000, len(part.z))).astype(int)
    z, g = part.z[pick], part.g[pick]
    for i in range(g.shape[1]):
        for a in range(0, len(pick), 500):
            rows = slice(a, a + 500)
            d = distance(part.constants[i], z[rows], z) + float(part.jumps[i])
            difference = g[rows, None, i] - g[None, :, i]
            # Refuted for certain: the smallest |Δg| lies above the largest bound.
            sure = np.maximum(difference.lo, -difference.hi) > d.hi + 4 * e.arrays["resolution"][i] * (1 + 1e-12)
            if sure.any():
                k, m = np.argwhere(sure)[0]
                return f"state {i}: samples at {z[a + k].tolist()} and {z[m].tolist()} refute the constants"
    return ""


def _samples(e: Evidence) -> str | None:
    if e.data["route"] == "calibrate":
        return None
    z, r = e.samples
    rows = 100_000
    for a in range(0, len(z), rows):
        part = _part(e, z[a : a + rows], slice(a, a + rows))
        short = np.abs(r[a : a + rows]) > np.maximum(np.abs(part[0].lo), np.abs(part[1].hi))
        if short.any():
            k, i = np.argwhere(short)[0]
            return f"state {i} at {z[a + k].tolist()}: |r| = {abs(r[a + k, i]):.6g} lies above γ"
    return ""


def _part(e: Evidence, z: Array, rows: slice) -> tuple[Interval, Interval]:
    if e.data["predictor"] == "model":
        arrays = {**e.arrays, "predictor.rows": e.arrays["predictor.samples"][rows]}
        return bounds(Evidence(e.folder, e.data, arrays), z, "predictor.rows")
    return bounds(e, z, "")


def _function(e: Evidence) -> str:
    """The route is one that certifies the form, and the function's own data follow from samples, constants and predictor."""
    form, route = e.data["form"]["form"], e.data["route"]
    if route not in (*ROUTES.get(form, ()), *(("calibrate",) if form in ROUTES else ())):
        return f"route {route} does not certify functions of form {form}"
    z, r = e.samples
    if (kind := e.data["predictor"]) not in ("none", "affine", "multilinear", "model") or e.data["form"].get(
        "predictor", kind
    ) != kind:
        return f"'{kind}' is no predictor that is known, or not that of the function"
    if any(f"gap.{k}" in e.arrays and (e.arrays[f"gap.{k}"] != e.arrays[f"predictor.{k}"]).any() for k in ("offset", "slope")):
        return "the function subtracts another predictor than the certificate"
    if form == "multilinear":
        return follows(e)
    if form == "envelope":
        p = predictor(e, z, "predictor.samples")
        if another(e, Interval.exact(r) - p):
            return "the envelope's remainders are not r − p at the samples"
        same = {"gap.z": z, "gap.L": e.arrays["lipschitz"], "gap.e": e.arrays["remainder.resolution"]}
        same |= {f"gap.{k}": v for k, v in e.arrays.items() if k.startswith("cells.")}
        other = next((k for k, v in same.items() if not np.array_equal(e.arrays[k], v)), None)
        return f"{other} of the envelope is not that of the certificate" if other else ""
    if route in ("calibrate", "declared"):
        return ""  # any function may be calibrated, and any constant declared
    if form == "dominating":
        return dominates(e)
    if route == "dominate" and e.data["predictor"] != "model":
        gamma = [float(g) for g in e.arrays["gap.gamma"]]
        return next((text for i, g in enumerate(gamma) if (text := exceeds(e, i, g))), "")
    return ""


def _covered(e: Evidence) -> str:
    """A cover is stated where the samples are a grid, and there alone."""
    if (e.folder / "samples" / "bound-0" / "points.npy").exists() != (e.data["cover"] is None):
        return "a cover is stated of other points, or the points are a grid and none is stated"
    return "" if e.data["cover"] is None or e.covers() else "the samples are not the grid that the certificate states"


def _drawn(e: Evidence) -> str:
    """The points are those of the audit's entry in the book, which names this very function."""
    if text := miscounted(e):
        return text
    z, _ = e.audit
    try:
        drawn = e.zone.draw(len(z), draws(e, "audit"))
    except UsageError as error:
        return str(error)
    return "" if np.array_equal(z, drawn) else "other points were audited than its number and its seed draw"


def _within(e: Evidence) -> str:
    """Sampled and audited points lie in the box, and satisfy every relation as computed; every axis has a name of its own."""
    for name, (_, r) in (("sampled", e.samples), ("audited", e.audit)):
        if not np.isfinite(r).all():
            return f"a {name} residual is not finite"
    axes = e.data["domain"]["axes"]
    if len(axes) != len(e.zone.low) or len({str(a) for a in axes}) != len(axes):
        return f"{axes} are no names of {len(e.zone.low)} axes"
    for name, (z, _) in (("sampled", e.samples), ("audited", e.audit)):
        if not (inside := e.zone.contains(z)).all():
            point = z[np.flatnonzero(~inside)[0]]
            return f"the {name} point {point.tolist()} is outside Z ({e.zone.broken(point) or 'its box'})"
    return ""


def _enough(e: Evidence) -> str:
    """(1 − ε)^N ≤ β / 2^k, in logarithms with a slack far above their rounding."""
    a = e.data["audit"]
    z, _ = e.audit
    if not (0 < a["epsilon"] < 1 and 0 < a["beta"] < 1 and isinstance(a["number"], int) and a["number"] >= 1):
        return f"ε = {a['epsilon']}, β = {a['beta']}, audit {a['number']} are no probabilities of a numbered audit"
    left, right = len(z) * math.log1p(-a["epsilon"]), math.log(a["beta"]) - a["number"] * math.log(2)
    counts = {"bound": e.taken, "audit": len(z)}
    if len(z) != a["points"] or any(e.data["samples"][k] != n for k, n in counts.items()):
        return f"{counts} points are stored, {a['points']} and {e.data['samples']} are stated"
    return "" if left <= right + 1e-9 * abs(right) else f"{len(z)} points do not give ε = {a['epsilon']:g} at β_k"


def _audit(e: Evidence) -> str:
    """The stated number of violations is neither hidden nor invented: counted with the bounds' outer and inner ends."""
    _, r = e.audit
    low, high = e.audited
    certain = int(((r < low.lo) | (r > high.hi)).any(axis=1).sum())
    # The stored function was rounded outwards by a few ulp; points between the two ends may count either way.
    slack = 64 * np.spacing(np.maximum(np.abs(low.lo), np.abs(high.hi)))
    possible = int(((r < low.hi + slack) | (r > high.lo - slack)).any(axis=1).sum())
    stated, above = e.data["audit"]["violations"], e.data["audit"]["gamma_violations"]
    if text := _witnessed(e, low, high):
        return text
    if not certain <= stated <= possible:
        return f"{certain} points lie outside for certain; {stated} were stated"
    least = int((np.abs(r) > np.maximum(np.abs(low.lo), np.abs(high.hi))).any(axis=1).sum())
    most = min(stated, int((np.abs(r) > abs(low).maximum(abs(high)).lo - slack).any(axis=1).sum()))
    return "" if least <= above <= most else f"|r| > γ at {least} points for certain, at {most} at most; {above} were stated"


def _witnessed(e: Evidence, low: Interval, high: Interval) -> str:
    """The witness is the audited point that leaves [l, u] by most, as far as rounding leaves it open."""
    (z, r), a = e.audit, e.data["audit"]
    if (w := a.get("witness")) is None:
        return "violations are stated without a witness" if a["violations"] else ""
    rows = np.flatnonzero((z == np.asarray(w["z"])).all(axis=1))
    if not len(rows) or w["at"] != dict(zip(e.data["domain"]["axes"], w["z"], strict=True)):
        return "the witness is no audited point"
    k, i = int(rows[0]), w["state"]
    excess = np.maximum(low.mid - r, r - high.mid)
    # The stored function rounds outwards by what its own layers or terms may leave: some times what is known here.
    slack = 64 * np.spacing(np.abs([low.mid, high.mid]).max(axis=0)) + 8 * e.arrays["remainder.resolution"]
    slack += 8 * np.maximum(low.hi - low.lo, high.hi - high.lo)
    same = abs(w["low"] - low.mid[k, i]) <= slack[k, i] and abs(w["high"] - high.mid[k, i]) <= slack[k, i]
    largest = excess[k, i] >= (excess - slack).max()
    return "" if same and largest and w["residual"] == r[k, i] else "the witness is another point, or leaves by less"


def _claim(e: Evidence) -> str:
    kind, provenance = e.data["claim"]["kind"], e.data["lipschitz"]["provenance"]
    if kind not in CLAIMS or provenance not in PROVENANCES:
        return f"'{kind}' from '{provenance}' constants is no claim that is known"
    if (kind == "assumed") != (e.data["route"] == "declared"):
        return f"the claim is {kind} by route {e.data['route']}; what is declared is assumed, and nothing else is"
    hidden = e.data.get("hidden", {}).get("distribution", "")
    drawn = f"{UNIFORM}{' within its relations' if e.zone.relations else ''}{hidden}{noise(e)}"
    if kind == "statistical" and e.data["claim"]["distribution"] != drawn:
        return f"the audit's points are {drawn}, and the claim states '{e.data['claim']['distribution']}'"
    if kind == "deterministic" and e.data["route"] == "calibrate":
        return "a deterministic claim rests on a calibration"
    matters = bool(hidden) and not e.data["hidden"]["harmless"]
    if kind == "deterministic" and (matters or (e.arrays["resolution"] > e.rounding).any()):
        return "a deterministic claim rests on drawn hidden states"
    if kind == "deterministic" and provenance == "estimated":
        return "a deterministic claim rests on estimated constants"
    moved = e.data.get("hidden", {}).get("attack", {}).get("violations", 0)
    looked = [a for a in (e.data["audit"], e.data.get("attack", {})) if a]
    over = [a["violations"] > (a["allowed"] if e.data["route"] == "calibrate" else 0) for a in looked]
    refuted = any(over) or moved or _consistent(e)
    if kind != "empirical" and refuted:
        return f"a {kind} claim is refuted by its own evidence"
    if kind == "statistical" and (e.data["claim"]["epsilon"], e.data["claim"]["beta"]) != (
        e.data["audit"]["epsilon"],
        e.data["audit"]["beta"],
    ):
        return "the claim states another ε or β than its audit"
    return ""
