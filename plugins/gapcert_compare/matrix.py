"""The matrix: one certificate for each backend, family, estimator of constants and seed."""

from __future__ import annotations

import json
import re
import resource
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

from gapcert.plugin import (
    Build,
    Certificate,
    Emit,
    Event,
    MissingDependency,
    Model,
    SpecError,
    Undecided,
    UsageError,
    digest,
    write_atomic,
)

from .section import CompareConfig

FAMILY, ESTIMATOR = "envelope", "wood-zhang"
"""What certify() takes where the spec names none."""


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
                    one = replace(config, backend=asked.backends[name], gap=gap, lipschitz=lipschitz, seed=seed)
                    yield Cell(name, family, method, seed, replace(build, spec=replace(build.spec, config=one)))


def row(cell: Cell, model: Model, folder: Path, emit: Emit) -> dict[str, Any]:
    """A certificate in one line; a refused one says why. A finished row of the same question is not made again."""
    place = folder / cell.place
    backend, domain = cell.build.against(model)
    question = digest(model, backend, domain)
    if (kept := _kept(place / "row.json", question)) is not None:
        return kept
    begin = cpu()
    try:
        certificate = cell.build.certify(model, backend, domain, place, emit)
    except (UsageError, Undecided, MissingDependency, SpecError) as error:
        emit(Event("warning", "matrix", {"message": f"{cell.backend}, {cell.family}, {cell.lipschitz}: {error}"}))
        nothing = dict.fromkeys(("tightness", "samples", "cpu_s", "claim", "violations"))
        return {**cell.names, **nothing, "refused": str(error)}
    certificate.save(place)
    made = {**cell.names, **_figures(certificate), "cpu_s": round(cpu() - begin, 3)}
    write_atomic(place / "row.json", json.dumps({"question": question, "row": made}, indent=1).encode())
    return made


def _kept(path: Path, question: str) -> dict[str, Any] | None:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        kept: dict[str, Any] | None = data["row"] if data["question"] == question else None
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return None  # what is damaged is made again
    return kept


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


def cpu() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(u.ru_utime + u.ru_stime for u in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))
