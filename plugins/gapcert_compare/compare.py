"""Which simulator? A matrix of certificates over backends, families, constants and seeds; and backend against backend."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    Build,
    Certificate,
    Domain,
    Emit,
    Event,
    HiddenConfig,
    MissingDependency,
    Model,
    Outcome,
    Shown,
    SpecError,
    Stages,
    Study,
    Undecided,
    UsageError,
    cpu_seconds,
    digest,
    stored,
    write_atomic,
)
from gapcert_compare.thresholds import THRESHOLDS
from gapcert_figures import Axis, CompareFigure, PairFigure

from .laboratory import Laboratory, Peer, peers
from .pairs import Pair, Pairs, map_axes
from .section import CompareConfig

FAMILY, ESTIMATOR = "envelope", "wood-zhang"
"""What certify() takes where the spec names none."""
ROW = ("backend", "family", "lipschitz", "seed", "tightness", "samples", "cpu_s", "claim", "violations")
PAIR = ("a", "b", "mean", "max", "state", "relative", "relative_max", "resolved")
SETTING = ("setting", "value", "was", "on", "reduction", "closes", "made", "effect", "site", "native", "parameters")


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
    return build.with_sections(backend=peer.config, hidden=HiddenConfig()).against(model)[1]


@final
@dataclass(frozen=True)
class Cell:
    """One combination of the matrix, and the spec that certifies it."""

    backend: str
    family: str
    lipschitz: str
    seed: int
    build: Build

    @property
    def place(self) -> Path:
        """Its folder inside the run folder."""
        words = (re.sub(r"[^a-z0-9_.=-]+", "-", w.lower()) for w in (self.family, self.lipschitz))
        return Path("rows", self.backend, "_".join([*words, str(self.seed)]))

    @property
    def names(self) -> dict[str, Any]:
        return {"backend": self.backend, "family": self.family, "lipschitz": self.lipschitz, "seed": self.seed}


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


def cells(build: Build, asked: CompareConfig, backends: Iterable[str]) -> Iterator[Cell]:
    """All combinations over the backends that can be used, in the order of the spec."""
    config = build.spec.config
    own = config.lipschitz.get("residual")
    families = asked.families or {getattr(config.gap, "kind", FAMILY): config.gap}
    constants = asked.lipschitz or {getattr(own, "kind", ESTIMATOR): own}
    for name in backends:
        for family, gap in families.items():
            for method, residual in constants.items():
                for seed in asked.seeds or (config.seed,):
                    lipschitz = {} if residual is None else {**config.lipschitz, "residual": residual}
                    one = build.with_sections(backend=asked.backends[name], gap=gap, lipschitz=lipschitz, seed=seed)
                    yield Cell(name, family, method, seed, one)


def row(cell: Cell, model: Model, folder: Path, emit: Emit) -> dict[str, Any]:
    """A certificate in one line; a refused one says why. A finished row of the same question is not made again."""
    place = folder / cell.place
    backend, domain = cell.build.against(model)
    question = digest(model, backend, domain)
    kept = stored(place, "row.json") or {}  # what is damaged is made again
    if kept.get("question") == question and isinstance(kept.get("row"), dict):
        return dict(kept["row"])
    begin = cpu_seconds()
    try:
        certificate = cell.build.certify(model, backend, domain, place, emit)
    except (UsageError, Undecided, MissingDependency, SpecError) as error:
        emit(Event("warning", "matrix", {"message": f"{cell.backend}, {cell.family}, {cell.lipschitz}: {error}"}))
        nothing = dict.fromkeys(("tightness", "samples", "cpu_s", "claim", "violations"))
        return {**cell.names, **nothing, "refused": str(error)}
    certificate.save(place)
    made = {**cell.names, **_figures(certificate), "cpu_s": round(cpu_seconds() - begin, 3)}
    write_atomic(place / "row.json", json.dumps({"question": question, "row": made}, indent=1).encode())
    return made


def _figures(certificate: Certificate) -> dict[str, Any]:
    """`tightness` is the mean over resolved states; `samples` are the transitions behind the bound and its constants."""
    c = certificate.summary()
    keys = ("tightness", "resolved", "gap_mean", "gamma_mean", "vacuous")
    states = {name: {k: s.get(k) for k in keys} for name, s in c["states"].items()}
    found = [s["tightness"] for s in states.values() if s["tightness"] is not None]
    return {
        "tightness": sum(found) / len(found) if found else None,
        "resolved": bool(found),
        "states": states,
        "samples": c["samples"]["bound"] + c["samples"]["lipschitz"],
        "claim": c["claim"]["kind"],
        "violations": c["audit"]["violations"] + c.get("attack", {}).get("violations", 0),
        "audit": c["samples"]["audit"],
        "digests": dict(certificate.digests),
    }


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


def write_tables(summary: Mapping[str, Any], folder: Path) -> None:
    """For spreadsheets rows.csv, pairs.csv and settings.csv: a line per row of the matrix, per pair, and per setting that was
    named; a pair also has its states and worst point.
    """
    rows = [{**{k: r[k] for k in ROW}, **_states(r, ("tightness", "resolved")), **_said(r)} for r in summary["rows"]]
    rows += [{**dict.fromkeys(ROW), "backend": u["backend"], "unavailable": u["reason"]} for u in summary["unavailable"]]
    pairs = []
    for p in summary["pairs"]:
        where = {f"where {k}": v for k, v in (p["where"] or {}).items()}
        step = {f"first step by {k}": v for k, v in p.get("first_differing_step", {}).items() if k in ("bits", "resolved")}
        head = {k: p.get(k) for k in PAIR}
        pairs.append({**head, **where, **step, **_states(p, ("mean", "max", "resolved")), **_said(p)})
    settings = [
        {"a": p["a"], "b": p["b"], "rank": rank, **{k: e.get(k) for k in SETTING}}
        for p in summary["pairs"]
        for rank, e in enumerate(p["explained_by"], 1)
    ]
    heads = {"rows": ROW, "pairs": PAIR, "settings": ("a", "b", "rank", *SETTING)}
    for (name, columns), table in zip(heads.items(), (rows, pairs, settings), strict=True):
        write_atomic(folder / f"{name}.csv", _csv(table, columns).encode())


def _states(entry: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {f"{k} {name}": s[k] for name, s in entry.get("states", {}).items() for k in keys}


def _said(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {"refused": entry["refused"]} if "refused" in entry else {}


def _csv(table: Sequence[Mapping[str, Any]], head: Sequence[str]) -> str:
    """RFC 4180; numbers with all their digits, mappings and lists as JSON, nothing for None."""
    columns = list(dict.fromkeys([*head, *(k for line in table for k in line)]))
    out = io.StringIO()
    writer = csv.DictWriter(out, columns)
    writer.writeheader()
    for line in table:
        writer.writerow({k: json.dumps(v) if isinstance(v, dict | list) else v for k, v in line.items()})
    return out.getvalue()
