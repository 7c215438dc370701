"""What a run folder draws, made again: figures of the certificate, its controllers and runs, and the page around them."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gapcert.plugin import Array, Event, __version__, difference, order_statistics, pretty, registry
from gapcert_verify.calibration import scores
from gapcert_verify.evidence import Evidence, bounds

from .origin import Origin, predictor
from .summary import controllers, read

_CLOSE = 1e-9  # relative: a picture shows no less
_LOOKS = 20_000_000  # at samples, by the pixels of one slice that are made again


def figures(e: Evidence, o: Origin) -> str | None:
    """ "" where the stored figures are those of the certificate, its controllers and the stored runs."""
    if (drawn := read(e, "figures.json")) is None:
        return None
    with np.load(e.folder / "figures.npz", allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    if other := next((k for k, v in drawn.items() if v and k not in _DRAWN), ""):
        return f"a figure of {other} is drawn, and a certificate has none"
    if text := _lanes(e, drawn) or (_gap(e, o, drawn["gap"], arrays) if drawn["gap"] else ""):
        return text
    if drawn["recorded"] and (text := _recorded(e, drawn["recorded"], arrays)):
        return text
    if drawn["winning"] and (text := _winning(e, drawn["winning"], arrays)):
        return text
    return _loop(e, drawn["loop"], arrays) if drawn["loop"] else ""


_DRAWN = ("lanes", "gap", "recorded", "winning", "loop")
_STATE = re.compile(r"running|done|finished|holds|fails|unknown|claimed|\d+ violations")
_STAGE = re.compile(
    r"run|report|gates|sampling|certificate|lipschitz|fit|calibration|audit|attack|recording|controller|closed_loop|pictures|beside-[\w-]+"
)


def _lanes(e: Evidence, drawn: Mapping[str, Any]) -> str:
    """Stages, and the words that they ended with, are those that a run has; the run ended with its verdict."""
    told = (read(e, "summary.json") or {}).get("verdict")
    for lane in drawn["lanes"]:
        strange = [s for s in lane["states"] if not _STATE.fullmatch(s)]
        if strange or not _STAGE.fullmatch(lane["stage"]):
            return f"'{strange[0] if strange else lane['stage']}' is no stage, nor how one ends"
        if len(lane["at"]) != len(lane["states"]) or lane["states"][-1] == "running":
            return f"stage '{lane['stage']}' is drawn without an end"
        if lane["stage"] == "run" and lane["states"] not in (["running", told], [told]):
            return f"the run is drawn to have ended with {lane['states']}, and its verdict is {told}"
    return ""


def _gap(e: Evidence, o: Origin, figure: Mapping[str, Any], arrays: Mapping[str, Array]) -> str:
    z, nx = o.domain, o.domain.nx
    axes = [
        {"name": a.name, "unit": pretty(a.unit), "low": low, "high": high, "angle": a.kind == "angle"}
        for a, low, high in zip(z.axes, z.low.tolist(), z.high.tolist(), strict=True)
    ]
    if len(figure["bands"]) != nx * len(axes):
        return "there is no band for each state along each axis"
    for k, band in enumerate(figure["bands"]):
        j, i = divmod(k, nx)
        if text := _placed(f"/gap/bands/{k}", band, ("at", "low", "high", "gamma", "residual")):
            return text
        points = np.tile(z.centre, (len(arrays[band["at"]]), 1))
        points[:, j] = arrays[band["at"]]
        own = {"state": axes[i]["name"], "unit": axes[i]["unit"], "axis": axes[j]}
        if any(band[key] != v for key, v in own.items()) or band["constant"] != _constant(e, axes[i]["name"], band, arrays):
            return f"the band of {axes[i]['name']} along {axes[j]['name']} is called, or bounded, otherwise"
        low, high = (float(v[0]) for v in z.chord(z.centre[None], j))
        if not _near(points[:, j], np.linspace(low, high, len(points)), high - low):
            return f"the band along {axes[j]['name']} is drawn at other points"
        if text := _drawn_band(e, o, points, i, {key: arrays[band[key]] for key in ("low", "high", "gamma", "residual")}):
            return text
    order = _order(e, figure, arrays, nx)
    if figure["axes"] != [axes[j] for j in order]:
        return "the axes of the gap's pictures are others"
    fixed = ((axes[j]["name"], z.centre[j], axes[j]["unit"]) for j in order[2:])
    if figure["fixed"] != ", ".join(f"{n} = {m:.4g} {unit}".removesuffix(" 1") for n, m, unit in fixed):
        return "the axes that are held are held elsewhere"
    if not np.array_equal(arrays[figure["samples"]], e.samples[0][:, order]):
        return "other samples are drawn than the bound's"
    return _slices(e, o, figure, arrays, order) if figure["slices"] else ""


def _constant(e: Evidence, name: str, band: Mapping[str, Any], arrays: Mapping[str, Array]) -> float:
    return float(e.data["states"][name].get("constant_bound", np.max(arrays[band["gamma"]])))


def _near(stored: Array, made: Array, size: float, e: float = 0.0) -> bool:
    same = stored.shape == made.shape
    return same and np.allclose(stored, made, rtol=_CLOSE, atol=_CLOSE * abs(size) + 4 * e, equal_nan=True)


def _ends(e: Evidence, o: Origin, z: Array) -> tuple[Array, Array]:
    own = replace(e, arrays={**e.arrays, "predictor.drawn": predictor(e, o)(z)}) if e.data["predictor"] == "model" else e
    low, high = bounds(own, z, "predictor.drawn")
    return low.mid, high.mid


def _drawn_band(e: Evidence, o: Origin, z: Array, i: int, drawn: Mapping[str, Array]) -> str:
    low, high = (end[:, i] for end in _ends(e, o, z))
    size, rounded = float(np.abs([low, high]).max()), float(e.arrays["remainder.resolution"][i])
    made = {"low": low, "high": high, "gamma": np.maximum(np.abs(low), np.abs(high))}
    if name := next((k for k, v in made.items() if not _near(drawn[k], v, size, rounded)), ""):
        return f"{name} of state {i} is drawn otherwise than it is"
    if o.text and (np.abs(_apart(o, z, drawn["residual"], i)) > 2 * e.arrays["resolution"][i]).any():
        return f"the residual of state {i} is drawn otherwise than it is"
    return ""


def _apart(o: Origin, z: Array, drawn: Array, i: int) -> Array:
    r = o.residual(z)
    other = r.copy()
    other[:, i] = drawn
    return np.asarray(difference(o.model.states, r, other)[:, i])


def _order(e: Evidence, figure: Mapping[str, Any], arrays: Mapping[str, Array], nx: int) -> list[int]:
    """Axes along which hardly anything changes behind the others, those of a symmetry last."""
    swing = np.array([np.ptp(arrays[b["residual"]]) for b in figure["bands"]]).reshape(-1, nx)
    quiet = (swing < 0.1 * swing.max(axis=0)).all(axis=1)
    inert = (e.data.get("symmetry") or {}).get("axes", ())
    return sorted(range(len(swing)), key=lambda j: (j in inert, bool(quiet[j])))


def _slices(e: Evidence, o: Origin, figure: Mapping[str, Any], arrays: Mapping[str, Array], order: Sequence[int]) -> str:
    side = len(arrays[figure["slices"][0]["gamma"]])
    centres = [z + w * (2 * np.arange(side) + 1) / (2 * side) for z, w in zip(o.domain.low, o.domain.width, strict=True)]
    z = np.tile(o.domain.centre, (side * side, 1))
    second, first = np.meshgrid(centres[order[1]], centres[order[0]], indexing="ij")
    z[:, order[0]], z[:, order[1]] = first.ravel(), second.ravel()
    step = max(1, len(z) * len(e.samples[0]) // _LOOKS)
    inside = o.domain.contains(z)
    rows = np.flatnonzero(inside)[::step]
    low, high = _ends(e, o, z[rows])
    for i, drawn in enumerate(figure["slices"]):
        own = _placed(f"/gap/slices/{i}", drawn, ("gamma", "gap"))
        if text := own or _called(o.domain.axes[i].name, o.domain.axes[i].unit, drawn):
            return text
        gamma, gap = (arrays[drawn[k]].ravel() for k in ("gamma", "gap"))
        made = np.maximum(np.abs(low[:, i]), np.abs(high[:, i]))
        size, rounded = float(made.max(initial=0.0)), float(e.arrays["remainder.resolution"][i])
        if not _near(gamma[rows], made, size, rounded) or not np.isnan(gamma[~inside]).all():
            return f"γ of state {i} is drawn otherwise than it is"
        if o.text and (np.abs(gap[inside] - np.abs(o.residual(z[inside])[:, i])) > 2 * e.arrays["resolution"][i]).any():
            return f"|r| of state {i} is drawn otherwise than it is"
    return ""


def _placed(where: str, drawn: Mapping[str, Any], names: Sequence[str]) -> str:
    return next((f"{where}/{n} is stated as {drawn[n]}" for n in names if drawn[n] != f"{where}/{n}"), "")


def _called(name: str, unit: str, drawn: Mapping[str, Any]) -> str:
    same = (drawn["state"], drawn["unit"]) == (name, pretty(unit))
    return "" if same else f"{name} in {pretty(unit)} is called {drawn['state']} in {drawn['unit']} in a picture"


def _recorded(e: Evidence, figure: Mapping[str, Any], arrays: Mapping[str, Array]) -> str:
    held, r = e.arrays["held.window"], e.arrays["held.r"]
    low, high = (np.sort(order_statistics.worst(own, held)) for own in scores(e, e.arrays["held.z"], [r]))
    drawn, rank = arrays[figure["scores"]], e.data["recording"]["rank"]
    room = _CLOSE * np.abs(high)
    if figure["rank"] != rank or drawn.shape != low.shape or not ((low - room <= drawn) & (drawn <= high + room)).all():
        return "the scores are drawn otherwise than they are"
    for i, stretch in enumerate(figure["stretches"]):
        z, own = e.data["domain"], _placed(f"/recorded/stretches/{i}", stretch, ("t", "low", "high", "residual"))
        if (text := own or _called(z["axes"][i], z["units"][i], stretch)) or arrays[stretch["t"]].shape != arrays[
            stretch["low"]
        ].shape:
            return text or f"a stretch of {stretch['state']} has no times"
        rows = [np.flatnonzero(r[:, i] == v) for v in arrays[stretch["residual"]]]
        if not all(len(found) for found in rows):
            return f"a residual of {stretch['state']} is drawn that was not measured"
        at = np.array([found[0] for found in rows])
        ends = bounds(e, e.arrays["held.z"][at], "predictor.drawn") if e.data["predictor"] != "model" else None
        size = float(np.abs(r[:, i]).max())
        if ends is not None and all(len(found) == 1 for found in rows):
            made = {"low": ends[0].mid[:, i], "high": ends[1].mid[:, i]}
            rounded = float(e.arrays["remainder.resolution"][i])
            if name := next((k for k, v in made.items() if not _near(arrays[stretch[k]], v, size, rounded)), ""):
                return f"{name} of {stretch['state']} is drawn otherwise than it is"
    return ""


def _winning(e: Evidence, figure: Mapping[str, Any], arrays: Mapping[str, Array]) -> str:
    """Drawn once more of the saved controllers, where asking them is cheap."""
    both = controllers(e)
    if len(both) < 2 or any(c.resolution < 200 for c in both.values()):
        return ""
    with tempfile.TemporaryDirectory() as folder:
        for part in registry().of("illustrator"):
            tell = part.load()(Path(folder), lambda event: None)
            tell(Event("stage-finished", "controller", both))
            tell(Event("run-finished", "run", {"summary": {"name": "", "verdict": "holds"}}))
        again = json.loads((Path(folder) / "figures.json").read_text(encoding="utf-8"))["winning"]
        with np.load(Path(folder) / "figures.npz", allow_pickle=False) as stored:
            names = [n for n in stored.files if n.startswith("/winning/")]
            same = [n for n in arrays if n.startswith("/winning/")] == names and all(
                np.array_equal(stored[n], arrays[n], equal_nan=True) for n in names
            )
    return "" if again == figure and same else "the winning domains are drawn otherwise than the saved controllers are"


def _loop(e: Evidence, figure: Mapping[str, Any], arrays: Mapping[str, Array]) -> str:
    """The runs that are drawn are the stored ones, and break as often as the summary says."""
    told = (read(e, "summary.json") or {}).get("closed_loop", {})
    angles = [axis["angle"] for axis in figure["axes"]]
    with np.load(e.folder / "closed_loop.npz", allow_pickle=False) as stored:
        for runs in figure["runs"]:
            name = "with_gamma" if runs["gamma"] else "without_gamma"
            head, broke, x = told.get(name, {}), arrays[runs["broke"]], stored[f"{name}_x"]
            counts = (head.get("policy"), head.get("starts"), head.get("steps"), head.get("violations"))
            if (runs["policy"], runs["starts"], runs["steps"], int((broke >= 0).sum())) != counts or len(broke) != len(x):
                return f"the runs {name} are drawn otherwise than they are told"
            for trace in arrays[runs["traces"]]:
                apart = np.abs(x - trace)
                apart[..., angles] = np.abs(np.remainder(apart[..., angles] + np.pi, 2 * np.pi) - np.pi)
                gone = np.isnan(x) == np.isnan(trace)
                if not ((np.nan_to_num(apart) <= 1e-9) & gone).all(axis=(1, 2)).any():
                    return f"a run {name} is drawn that is not stored"
    return ""


def page(e: Evidence, o: Origin) -> str | None:
    """ "" where `report.html` is what summary and figures give; None for one of another version."""
    stored, told = e.folder / "report.html", read(e, "summary.json")
    if not stored.is_file() or told is None or e.data["versions"]["gapcert"] != __version__:
        return None
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder) / Path(told["run_dir"]).name
        where.mkdir()
        for item in e.folder.resolve().iterdir():
            if item.name != stored.name:
                with suppress(OSError):
                    (where / item.name).symlink_to(item)
        registry().get("report", "html").load()(where)
        same = (where / stored.name).read_bytes() == stored.read_bytes()
    return "" if same else "report.html is another page than summary and figures give"
