"""Certificates of hard texts, by families × constants × routes.

They have kinks, steep waves, powers at 0 and cancellation, at scales from 1e-8 to 1e8 and offsets of 1e10.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from attacks import Attempt
from gapcert.contracts.gaps.lipschitz import Residual

POINTS = 50_000
"""Per certificate: half drawn as its audit draws them, half aimed."""
FLOATS = 400
"""How many floats away from samples, edges and kinks is aimed at, at most."""
AUDIT = {"claim": "statistical", "violation": 1e-2, "confidence": 0.999}
TRAINED = {"hidden": [8], "steps": 60}
FUNCTIONS = ["1", "p^2", "sin(v)", "abs(u)"]


def term(rng: np.random.Generator, low: float, high: float, size: float) -> str:
    """A summand of some `size` that is hard somewhere in [low, high] of p."""
    width = high - low
    c, a = (float(f"{v:.6g}") for v in (rng.uniform(low, high), size * rng.normal()))
    w = float(f"{rng.choice([1, 6, 60]) * rng.uniform(0.5, 2) / width:.6g}")
    t = f"({w!r}*(p - ({c!r})))"
    kinds = (
        f"abs({t})", f"max({t}, 0)", f"min({t}, 0.3)", f"sin({t})", f"cos({t})*sin(v)", f"tanh({t})", f"{t}**2", f"{t}**3",
        f"exp(-{t}**2)", f"(1/(1 + {t}**2))", f"sqrt(1 + {t}**2)", f"abs({t})**1.5", "u*abs(u)", f"v*{t}",
        f"((1e8 + {t}) - 1e8)",
        f"sign({t})*{t}", f"log(1 + {t}**2)",
    )  # fmt: skip
    return f"({a!r})*{kinds[rng.integers(len(kinds))]}"


def drawn(rng: np.random.Generator) -> dict[str, Any]:
    scale, offset = 10.0 ** rng.integers(-8, 9), float(rng.choice([0.0, 0.0, 0.0, 1.0, -1e3, 1e10]))
    low, high = (float(f"{offset + scale * v:.17g}") for v in (-1.0, rng.uniform(0.2, 1.5)))
    low, high = (low, high) if high > low else (offset, float(np.nextafter(offset, np.inf)) + abs(offset) * 1e-12)
    size = scale * float(rng.choice([1e-3, 0.1, 1.0]))
    plain = " + ".join(["0.3*v", *(term(rng, low, high, size) for _ in range(rng.integers(0, 3)))])
    gap = " + ".join(term(rng, low, high, size) for _ in range(rng.integers(1, 4)))
    model = {
        "kind": "equations", "states": {"p": "1", "v": "1"}, "inputs": {"u": "1"}, "parameters": {"T": "1 s"},
        "derivative": {"p": f"({plain})/T", "v": "(u - 0.5*v)/T"}, "period": "100 ms",
        "integrator": str(rng.choice(["euler", "semi_implicit", "rk4"])), "substeps": int(rng.choice([1, 1, 3])),
    }  # fmt: skip
    backend = {**model, "derivative": {"p": f"({plain} + {gap})/T", "v": "(u - 0.5*v)/T"}}
    constants = str(rng.choice(["interval", "interval", "piecewise", "wood-zhang"]))
    family = str(rng.choice(["constant", "envelope", "envelope", "multilinear", "basis", "neural"]))
    bent = {}
    if family == "multilinear":
        constants, bent = constants.replace("piecewise", "gradient-elite"), {"curvature": True}
    fit = {"basis": {"functions": FUNCTIONS}, "neural": TRAINED}.get(family, {})
    routes = gc.registry().get("gap_family", family).load()(**fit).routes
    route, budget = str(rng.choice(routes)), int(rng.integers(40, 200))
    sampling: dict[str, Any] = {"kind": "lattice" if family == "multilinear" else "adaptive", "budget": budget}
    if route == "theorem1":
        sampling = {"kind": "grid", "counts": dict(zip("pvu", rng.integers(3, 9, 3).tolist(), strict=True))}
    claim = {"claim": "deterministic"} if constants == "interval" and rng.random() < 0.8 else AUDIT
    return {
        "version": 1, "name": "drawn", "model": model, "backend": backend, "seed": int(rng.integers(2**31)),
        "domain": {"p": [low, high], "v": [-1, 1], "u": [-1, 1]},
        "sampling": sampling, "lipschitz": {"residual": {"kind": constants, **bent}}, "gap": {"kind": family, **fit},
        "certificate": {**claim, "route": route},
    }  # fmt: skip


def aimed(certificate: Any, n: int, rng: np.random.Generator) -> np.ndarray:
    """Samples, edges of tables and cells, and ends of the domain, and floats near these; other axes anywhere."""
    domain, gap, z = certificate.domain, certificate.gap, certificate.domain.draw(n, rng)
    whole = certificate.samples.z[rng.integers(len(certificate.samples.z), size=n)]
    near = rng.random(n) < 0.4  # all coordinates are those of one sample
    z[near] = whole[near]
    cells = certificate.lipschitz.cells
    for j, (low, high) in enumerate(zip(domain.low, domain.high, strict=True)):
        parts = [np.array([low, high, 0.5 * (low + high), 0.0]), certificate.samples.z[:, j]]
        parts += [gap.table.edges[j]] if hasattr(gap, "table") else []
        parts += [cells.boxes.lo[:, j], cells.boxes.hi[:, j]] if cells is not None else []
        rows = ~near & (rng.random(n) < 0.5)
        z[rows, j] = rng.choice(np.unique(np.concatenate(parts)), int(rows.sum()))
        z[:, j] += rng.integers(-FLOATS, FLOATS + 1, n) * (rng.random(n) < 0.7) * np.spacing(z[:, j])
        z[:, j] = np.clip(z[:, j], low, high)
    return z


def broken(certificate: Any, residual: Residual, z: np.ndarray) -> np.ndarray:
    low, high = certificate.gap.interval(z)
    r = residual(z)
    return ~((low <= r) & (r <= high)).all(axis=1)


def climbed(certificate: Any, residual: Residual, z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random search uphill on max_i |r_i| / γ_i from the worst of these points."""
    domain = certificate.domain

    def worth(at: np.ndarray) -> np.ndarray:
        gamma = np.maximum(certificate.gap.gamma(at), 1e-300)
        return (np.abs(residual(at)) / gamma).max(axis=1)

    best = z[np.argsort(-worth(z))[:64]]
    have = worth(best)
    for k in range(60):
        step = (domain.high - domain.low) * 0.3 * 0.75**k * rng.normal(size=best.shape)
        tried = np.clip(best + step, domain.low, domain.high)
        now = worth(tried)
        best, have = np.where((now > have)[:, None], tried, best), np.maximum(now, have)
    return best


def attempt(rng: np.random.Generator, folder: Path, tries: int = POINTS) -> Attempt:
    spec = drawn(rng)
    made = {k: spec[k] for k in ("domain", "gap", "lipschitz", "certificate")} | {
        "text": spec["backend"]["derivative"]["p"], "integrator": [spec["model"]["integrator"], spec["model"]["substeps"]]
    }  # fmt: skip
    try:
        run = gc.run(spec, overrides=("report.html=false", "report.rerun=false"), out=folder, executor="threads")
    except gc.GapcertError as error:
        return Attempt("refused", case={**made, "why": str(error).splitlines()[0][:300]})
    if (certificate := run.certificate) is None:
        return Attempt("refused", case={**made, "why": run.summary["reason"]})
    claim = certificate.claim.kind if certificate.holds else "refused"
    residual = Residual(run.artifacts["backend"], run.artifacts["model"])
    plain = certificate.domain.draw(tries // 2, rng)
    hard = aimed(certificate, tries - len(plain), rng)
    hard = np.concatenate([hard, climbed(certificate, residual, plain[:2000], rng)])
    seen, sharp = broken(certificate, residual, plain), broken(certificate, residual, hard)
    counts = (len(plain) + len(hard), int(seen.sum() + sharp.sum()))
    level = (certificate.claim.epsilon, certificate.claim.beta) if claim == "statistical" else (None, None)
    return Attempt(claim, *counts, *level, (len(plain), int(seen.sum())), made)
