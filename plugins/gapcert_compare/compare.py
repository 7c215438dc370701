"""Which simulator? A matrix of certificates over backends, families, constants and seeds; and backend against backend."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import Build, Domain, Emit, Event, Model, Outcome, Shown, Stages, Study
from gapcert_compare.thresholds import THRESHOLDS
from gapcert_figures import Axis, CompareFigure, PairFigure

from .laboratory import Laboratory, Peer, peers
from .matrix import cells, row
from .pairs import Pair, Pairs, map_axes
from .section import CompareConfig
from .tables import write_tables


@final
@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """What was found: the JSON summary, and the pictures of the pairs."""

    summary: Mapping[str, Any]
    figure: CompareFigure


def compare(build: Build, asked: CompareConfig, folder: Path, stages: Stages) -> Comparison:
    """Carry out a `compare:` section in a run folder; finished rows and shards that lie there are not made again."""
    emit = stages.emit
    model: Model = build.make("model")
    found, lost = peers(build, asked, model)
    domain = next((_domain(build, peer, model) for peer in found.values()), Domain.of(model, build.spec.config.domain or {}))
    for name, reason in lost.items():
        emit(Event("warning", "backends", {"message": f"{name} is unavailable: {reason}"}))
    with stages.stage("matrix"):
        rows = _rows(build, asked, model, found, folder, emit)
    stages.finished("matrix")
    sampling = build.spec.config.sampling
    laboratory = Laboratory(
        folder / "pairs", domain, asked, build.spec.config.seed, build.executor(), sampling.chunk if sampling else 100_000, emit
    )
    with stages.stage("pairs"):
        measured = list(Pairs(build, model, laboratory, emit).all(found))
    summary = {
        **_verdict([p.summary for p in measured]),
        "backends": {name: _standing(name, p, [one.summary for one in measured]) for name, p in found.items()},
        "unavailable": [{"backend": name, "reason": reason} for name, reason in lost.items()],
        "rows": rows,
        "pairs": [p.summary for p in measured],
        "digest": _digest(rows, laboratory.digests),
    }
    write_tables(summary, folder)
    comparison = Comparison(summary, _figure(model, laboratory, measured))
    stages.finished("pairs", comparison=comparison)
    return comparison


@final
class ComparisonStudy(Study):
    def run(self, build: Build, folder: Path, stages: Stages, made: Outcome) -> Outcome:
        comparison = compare(build, build.spec.config.sections["compare"], folder, stages)
        return Outcome(comparison.summary, {"comparison": comparison})


def _domain(build: Build, peer: Peer, model: Model) -> Domain:
    """Where the pairs meet: states, inputs and relations of the spec, whatever the matrix does about hidden state."""
    config = replace(build.spec.config, backend=peer.config, hidden=None)
    return replace(build, spec=replace(build.spec, config=config)).against(model)[1]


def _rows(
    build: Build, asked: CompareConfig, model: Model, found: Mapping[str, Peer], folder: Path, emit: Emit
) -> list[dict[str, Any]]:
    matrix = list(cells(build, asked, found))
    rows = []

    def brief(event: Event) -> None:
        # The stages of each certificate are one stage to who watches a matrix.
        if event.name in ("progress", "warning"):
            emit(event)

    for k, cell in enumerate(matrix, 1):
        rows.append(row(cell, model, folder, brief))
        tight = [r["tightness"] for r in rows if r["tightness"] is not None]
        best = {"tightest": min(tight)} if tight else {}
        emit(Event("progress", "matrix", {"done": k, "total": len(matrix), "unit": "rows", "best": best}))
    return rows


def _digest(rows: Sequence[Mapping[str, Any]], answers: Mapping[str, str]) -> str:
    """SHA-256 over every shard behind the rows and the pairs: equal for equal specs, however often they were interrupted."""
    return hashlib.sha256(json.dumps([[r.get("digests") for r in rows], dict(answers)], sort_keys=True).encode()).hexdigest()


def closed(pair: Mapping[str, Any]) -> bool:
    """Whether a verified change of settings closes, or all but closes, the difference of a pair."""
    return any(map(_closes, pair["explained_by"][:1]))


def _closes(entry: Mapping[str, Any]) -> bool:
    return bool(entry["closes"] or entry["reduction"] >= THRESHOLDS.closing_share)


def _verdict(pairs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """`agree`, `explained` or `differ`; `compared` where there was no pair to measure."""
    measured = [p for p in pairs if "refused" not in p]
    apart = [p for p in measured if p["resolved"]]
    same = [p for p in measured if not p["resolved"]]
    named = [p for p in apart if closed(p)]
    if not measured:
        verdict, reason = "compared", "there are no two backends to lay side by side"
    elif not apart:
        verdict, reason = "agree", ("all pairs agree" if len(same) > 1 else "the two agree") + " within their resolution"
    else:
        verdict = "explained" if len(named) == len(apart) else "differ"
        reason = f"{len(apart)} of {len(measured)} pairs differ, and settings that close it are named for {len(named)} of them"
    agree = {"pairs": len(same), "max": max((p["max"] for p in same), default=None)}
    return {"verdict": verdict, "reason": reason, "agree": agree, "differ": {"pairs": len(apart), "explained": len(named)}}


def _standing(name: str, peer: Peer, pairs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Whom one backend agrees with, and which of its own settings separate it from all those with whom it does not."""
    mine = [(p, p["b"] if p["a"] == name else p["a"]) for p in pairs if name in (p["a"], p["b"]) and "refused" not in p]
    apart = [p for p, _ in mine if p["resolved"]]
    closing = [{e["setting"] for e in p["explained_by"] if e.get("on") == name and _closes(e)} for p in apart]
    return {
        "kind": getattr(peer.config, "kind", ""),
        "agrees_with": [other for p, other in mine if not p["resolved"]],
        "differs_from": [other for p, other in mine if p["resolved"]],
        "separated_by": sorted(set.intersection(*closing)) if closing else [],
    }


def _figure(model: Model, laboratory: Laboratory, measured: Sequence[Pair]) -> CompareFigure:
    domain = laboratory.domain
    axes = Axis.all_of(domain.states) + Axis.all_of(domain.inputs)
    drawn = []
    for pair in measured:
        if pair.at is None:
            continue
        values = np.empty((0, 0)) if pair.slice is None else pair.slice
        shown = map_axes(laboratory) if pair.slice is not None else ()
        at = enumerate(zip(axes, pair.at.tolist(), strict=True))
        held = [f"{a.name} = {v:.3g} {a.unit}" for k, (a, v) in at if k not in shown]
        unit = axes[pair.state].unit
        drift = np.empty(0) if pair.drift is None else pair.drift
        names = pair.summary["a"], pair.summary["b"], pair.summary["state"], unit
        drawn.append(PairFigure(*names, tuple(axes[k] for k in shown), ", ".join(held), values, drift))
    return CompareFigure(model.period, tuple(drawn))
