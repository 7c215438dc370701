"""Fields that the JSON files of a run folder have: whoever reads one more takes it for something that was checked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gapcert.plugin import registry
from gapcert_verify.evidence import Evidence

from .summary import read

_BESIDE = "form predictor domain arrays versions symmetry cover seed digests arithmetic format"
_SUMMARY = "claim family route states assumptions samples audit vacuous lipschitz calibration recording attack hidden warnings"
_STUDIES = {"closed_loop", "recording"}
_ROW = (
    "policy controller starts steps violations stranded left_goal broken_promises refused fallbacks reached settled visits "
    "steps_held outside_gap refuted"
)
_STATE = (
    "gap_mean gamma_mean gamma_max constant_bound safety_factor resolved vacuous envelope_mean tightness tightness_vs_envelope "
    "overpowered"
)
_RECORDING = "copies rank rows score trajectories transitions units widening window windows"
_TOP = {
    "certificate.json": f"{_SUMMARY} {_BESIDE}",
    "summary.json": "certificate controller closed_loop expectations name reason run_dir timings verdict beside coordinates",
    "figures.json": "gap lanes loop recorded winning compare diagnosis",
    "run.json": "executor files folder name spec",
    "root.json": "root files",
}
_ONE = {
    "arithmetic": "e jitter proved terms",
    "bands": "at axis constant gamma high low residual state unit",
    "attack": "points violations gamma_violations book number share witness",
    "audit": "points violations gamma_violations epsilon beta allowed witness number book",
    "book": "number kind question audited lost edited",
    "calibration": "points exceedances number repeats noise score widening book",
    "certificate": _SUMMARY,
    "claim": "kind epsilon beta distribution book number runs violations warnings",
    "closed_loop": "claim policies with_gamma without_gamma hidden_outside skipped learned",
    "domain": "axes units states period coordinates low high relations",
    "expectations": "met text value",
    "gap": "axes bands fixed samples slices",
    "hidden": "mode names spread harmless distribution ranked queries bound safety attack",
    "lanes": "at stage states",
    "lipschitz": "method provenance safety cells marked marked_share jumps",
    "loop": "ahead axes escape foreseen learned period playback runs stay wanted",
    "recorded": "at rank scores stretches",
    "recording": f"book number {_RECORDING}",
    "policies": _ROW,
    "relations": "text a b",
    "rows": "all no_transition outside",
    "samples": "bound lipschitz audit symmetry calibration",
    "slices": "gamma gap state unit",
    "stretches": "high low residual state t unit",
    "symmetry": "names axes pairs deviation proved",
    "transitions": "calibration fit",
    "windows": "calibration fit",
    "with_gamma": _ROW,
    "without_gamma": _ROW,
    "winning": "axes fixed goal labels outlines values with_gamma without_gamma",
}
"""Object, by the name under which it stands, or list of such → their fields."""
_NAMED = "controller evidence goal form beside states at spread coordinates versions timings digests files compare"
"""Those whose fields are names of axes, stages, files or specs, or what plugins tell."""


def fields(e: Evidence) -> str:
    """ "" where every field of these files is one that they have."""
    asked = set(registry().names("study")) & (read(e, "spec.json") or {}).keys()
    for name, top in _TOP.items():
        if name == "summary.json" and asked - _STUDIES:
            continue  # what other studies tell is their own
        for where, known, found in _objects(read(e, name) or {}, name, top):
            if extra := sorted(found.keys() - set(known.split())):
                return f"{name} has an unknown field {extra[0]!r}{where}"
    for name, state in e.data["states"].items():
        if extra := sorted(state.keys() - set(_STATE.split())):
            return f"certificate.json has an unknown field {extra[0]!r} of {name}"
    drawn = read(e, "figures.json")
    whole = [("figures.json", _TOP["figures.json"], drawn), ("the domain", _ONE["domain"], e.data["domain"])]
    whole += [("certificate.json", _BESIDE, e.data)] if "audit" in e.data else []
    if (of := e.data.get("recording")) is not None:
        whole += [("certificate.json", "cover seed digests", e.data), ("the recording", _RECORDING, of)]
    drawn = drawn or {}
    for part, one in (("gap", "slices"), ("gap", "bands"), ("recorded", "stretches")):
        whole += [(f"a picture of {one}", _ONE[one], found) for found in (drawn.get(part) or {}).get(one, ())]
    whole += [("the picture of recordings", _ONE["recorded"], drawn.get("recorded") or None)]
    for name, known, found in whole:
        if found is not None and not e.older and (lost := sorted(set(known.split()) - found.keys())):
            return f"{name} lacks {lost[0]}"
    return ""


def _objects(node: Any, name: str, known: str | None, where: str = "") -> Iterator[tuple[str, str, dict[str, Any]]]:
    if isinstance(node, list):
        for one in node:
            yield from _objects(one, name, known, where)
    elif isinstance(node, dict):
        if known is not None:
            yield where, known, node
        for key, value in node.items():
            if key not in _NAMED.split():
                yield from _objects(value, key, _ONE.get(key), f" in '{key}'")
