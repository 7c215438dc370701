"""A gap function with its claim, assumptions and evidence: saved as data, checked again by `verify` without this code."""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np

import gapcert
from gapcert.certification.gates.hidden_state import Gate
from gapcert.certification.ledger import Entry
from gapcert.certification.refutation import warnings
from gapcert.contracts.gaps.claim import Claim
from gapcert.contracts.gaps.gap import GapFunction, GapProblem
from gapcert.contracts.gaps.lipschitz import LipschitzBound
from gapcert.contracts.gaps.predictor import Samples
from gapcert.contracts.plugins.presentation import Shown
from gapcert.contracts.systems.domain import Domain, Outside
from gapcert.contracts.systems.system import Model, difference
from gapcert.numerics.arrays import Array, Bools
from gapcert.numerics.atomic_files import npz_bytes, write_atomic

if TYPE_CHECKING:
    from gapcert.contracts.data.recording import Recording


@final
@dataclass(frozen=True)
class Audit:
    """Fresh points that no fit has seen: z (n, nz), r (n, nx), and where l ≤ r ≤ u or |r| ≤ γ fails (n,)."""

    z: Array
    r: Array
    entry: Entry
    epsilon: float
    beta: float
    outside: Bools
    above: Bools
    limit: int = 0

    @property
    def k(self) -> int:
        """Its number among those of the question, by which it spends β_k."""
        return self.entry.k

    @property
    def violations(self) -> int:
        return int(self.outside.sum())

    @property
    def refutes(self) -> bool:
        """More violations than the claim allows: `limit` is 0 but for a calibrated band, which may fail at a share ε."""
        return self.violations > self.limit

    def witness(self, gap: GapFunction) -> dict[str, Any] | None:
        """The point where r leaves [l, u] by most, or None."""
        if not self.violations:
            return None
        rows = np.flatnonzero(self.outside)
        low, high = gap.interval(self.z[rows])
        excess = np.maximum(low - self.r[rows], self.r[rows] - high)
        row, state = np.unravel_index(int(np.argmax(excess)), excess.shape)
        k = rows[row]
        return {
            "z": self.z[k].tolist(),
            "state": int(state),
            "residual": float(self.r[k, state]),
            "low": float(low[row, state]),
            "high": float(high[row, state]),
        }


def points_refute(audit: Audit, attack: Mapping[str, int], gate: Gate | None) -> bool:
    """Does a point contradict the band: of the audit, of the further attack, or from other hidden states?"""
    attacked = attack.get("violations", 0) > attack.get("allowed", 0)
    moved = gate is not None and gate.attack.get("violations", 0) > 0
    return audit.refutes or attacked or moved


@final
@dataclass(frozen=True)
class StateEvidence:
    """Figures of one state over the audit's points; see docs/concepts.md.

    tightness = Σγ / Σ|r|, absent where the mean gap is below ten resolutions (`resolved` false).
    """

    gap_mean: float
    gamma_mean: float
    gamma_max: float
    constant_bound: float
    safety_factor: float
    resolved: bool
    vacuous: bool
    envelope_mean: float | None = None
    tightness: float | None = None
    tightness_vs_envelope: float | None = None
    overpowered: float | None = None

    def summary(self) -> dict[str, Any]:
        return {k: v for k, v in vars(self).items() if v is not None}


def figures(
    gap: GapFunction, problem: GapProblem, model: Model, z: Array, r: Array, constant: Array, envelope: Array | None = None
) -> dict[str, StateEvidence]:
    """By name of the state: z (n, nz), r (n, nx); constant, envelope (nx,): the constant bound, and the envelope's mean."""
    gamma, mean_gap = gap.gamma(z), np.abs(r).mean(axis=0)
    x, u = problem.domain.split(z)
    still = np.abs(difference(model.states, model.step(x, u).x, x) + r).mean(axis=0)
    power = overpowered(gamma, model, problem.domain, z)
    out = {}
    for i, state in enumerate(model.states):
        resolved = bool(mean_gap[i] >= 10 * problem.arithmetic[i])
        mean = float(gamma[:, i].mean())
        out[state.name] = StateEvidence(
            gap_mean=float(mean_gap[i]),
            gamma_mean=mean,
            gamma_max=float(gamma[:, i].max()),
            constant_bound=float(constant[i]),
            safety_factor=problem.lipschitz.safety,
            resolved=resolved,
            vacuous=resolved and bool(mean > constant[i] * (1 + 1e-9) or mean >= still[i]),
            envelope_mean=None if envelope is None else float(envelope[i]),
            tightness=mean / float(mean_gap[i]) if resolved else None,
            tightness_vs_envelope=None if envelope is None or not resolved else mean / float(envelope[i]),
            overpowered=power[i],
        )
    return out


def overpowered(gamma: Array, model: Model, domain: Domain, z: Array) -> list[float | None]:
    """Per state, the share of points where γ_i exceeds half the range of f_i over U's corners, or over what relations leave of
    the way there from the point's own input; None where f_i ignores u.
    """
    if not model.nu:
        return [None] * model.nx
    x, _ = domain.split(z)
    corners = np.stack(np.meshgrid(*zip(domain.inputs.low, domain.inputs.high, strict=True)), axis=-1).reshape(-1, model.nu)
    ends = [domain.reach(z, np.hstack([x, np.broadcast_to(c, (len(x), model.nu))])) for c in corners]
    images = np.stack([model.step(*domain.split(end)).x for end in ends])
    span = np.ptp(images, axis=0)
    # A range at rounding level means that the input does not reach the state within one step.
    moved = span.max(axis=0) > 1e-12 * np.maximum(np.abs(images).max(axis=(0, 1)), 1e-300)
    return [float((gamma[:, i] > span[:, i] / 2).mean()) if moved[i] else None for i in range(gamma.shape[1])]


class Record(ABC):
    """How a route came to its band, where that is no function of samples and constants alone: further points, say."""

    entry: Entry
    """Where the book counts it: it has spent β_k of its number k."""

    @property
    def k(self) -> int:
        return self.entry.k

    @property
    @abstractmethod
    def draws(self) -> str:
        """What was drawn beside (x, u), as a claim names it; empty where nothing was."""

    @abstractmethod
    def reason(self, audit: Audit) -> str:
        """Why the claim holds, after its level."""

    @abstractmethod
    def allowed(self, points: int, epsilon: float) -> int:
        """How many of so many fresh points may lie outside and the claim stand."""

    @abstractmethod
    def samples(self) -> int:
        """Transitions that it took."""

    @abstractmethod
    def summary(self) -> dict[str, Any]:
        """The object `calibration` of the certificate's summary."""

    @abstractmethod
    def arrays(self, problem: GapProblem) -> dict[str, Array]:
        """What `gapcert verify` needs besides the samples, named as in `certificate.npz`."""


Band = Callable[[Array], tuple[Array, Array]]
"""(l, u) at points z (n, nz), each (n, nx)."""


class Statement(ABC):
    """What is said of γ on a set Z, by a certificate, a person, or either as it was stored: asked there, and held against
    measurements. Points are in the coordinates of Z: where a spec has `coordinates:`, u are these.
    """

    @abstractmethod
    def _about(self) -> tuple[Domain, Band]:
        """Z, and (l, u) at points of it."""

    def interval(self, x: Array, u: Array, *, outside: Outside = "raise") -> tuple[Array, Array]:
        """(l, u) with l ≤ f̂ − f ≤ u: x (n, nx) or (nx,), u (n, nu) or (nu,) → (n, nx) each.

        Where (x, u) is not in Z, nothing is known: UsageError that names the axis and its value, or with `outside="nan"` a row
        of NaN.
        """
        domain, band = self._about()
        z = domain.turned(np.concatenate([np.atleast_2d(np.asarray(v, dtype=float)) for v in (x, u)], axis=1))
        inside = domain.asked(z, outside)
        both = np.full((2, len(z), domain.nx), np.nan)
        if inside.any():
            both[:, inside] = band(z[inside])
        return both[0], both[1]

    def gamma(self, x: Array, u: Array, *, outside: Outside = "raise") -> Array:
        """γ(x, u) = max(|l|, |u|), (n, nx); x, u and outside as for `interval`."""
        low, high = self.interval(x, u, outside=outside)
        return np.asarray(np.maximum(np.abs(low), np.abs(high)))

    def check(self, recording: Recording, noise: Mapping[str, float] | None = None) -> Any:
        """New measurements against γ, as a `Check`; noise: by how much channels may err, in the model's units."""
        return gapcert.check(gapcert.Certified.of(self), recording, noise)

    def monitor(self) -> Any:
        """γ watched online, one transition at a time: a `Monitor`."""
        return gapcert.Monitor(gapcert.Certified.of(self))


FORMAT = 2
"""Of what `save` writes: 1, which was not told, had no units and no period beside Z."""


class SavedStatement(Statement, Shown):
    """One that holds its gap function: it is shown, and saved."""

    gap: GapFunction
    model: Model | None
    versions: Mapping[str, str]

    @abstractmethod
    def summary(self) -> dict[str, Any]:
        """The `certificate` object of the JSON contract."""

    def _write(self, folder: Path, predictor: str, arrays: Mapping[str, Array], **more: Any) -> None:
        """`certificate.json`, the summary and `more`, and `certificate.npz`, γ's own arrays and others."""
        content = npz_bytes({**{f"gap.{k}": v for k, v in self.gap.arrays().items()}, **arrays})
        data = {
            **self.summary(),
            "format": FORMAT,
            "form": dict(self.gap.form),
            "predictor": predictor,
            "domain": domain_data(self._about()[0], self.model),
            "arrays": hashlib.sha256(content).hexdigest(),
            "versions": dict(self.versions),
            **more,
        }
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(folder / "certificate.npz", content)
        write_atomic(folder / "certificate.json", json.dumps(data, indent=1, sort_keys=True).encode())


@final
@dataclass(frozen=True, repr=False)
class Certificate(SavedStatement):
    """γ with l ≤ r ≤ u, what that rests on, and the evidence."""

    gap: GapFunction
    problem: GapProblem
    claim: Claim
    assumptions: tuple[str, ...]
    states: Mapping[str, StateEvidence]
    audit: Audit
    attack: Mapping[str, int] = field(default_factory=dict)
    digests: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    gate: Gate | None = None
    model: Model | None = None
    calibration: Record | None = None

    @property
    def domain(self) -> Domain:
        return self.problem.domain

    def _about(self) -> tuple[Domain, Band]:
        return self.domain, self.gap.interval

    @property
    def samples(self) -> Samples:
        return self.problem.samples

    @property
    def lipschitz(self) -> LipschitzBound:
        return self.problem.lipschitz

    @property
    def holds(self) -> bool:
        """No audited or attacked point refutes the claim."""
        return not points_refute(self.audit, self.attack, self.gate)

    @property
    def vacuous(self) -> bool:
        return any(s.vacuous for s in self.states.values())

    @property
    def reason(self) -> str:
        """Why it holds, where nothing refutes it."""
        c, n = self.claim, len(self.audit.z)
        if c.kind == "assumed":
            return f"γ is declared and assumed; {n} audited points do not refute it"
        level = f"statistical (ε = {c.epsilon:g}, β = {c.beta:g}, {c.distribution})" if c.kind == "statistical" else c.kind
        if (made := self.calibration) is not None:
            return f"the gap function holds at level {level}: {made.reason(self.audit)}"
        return f"the gap function holds at level {level}: {n} audited points without a violation"

    def summary(self) -> dict[str, Any]:
        """The `certificate` object of the JSON contract."""
        a = self.audit
        out: dict[str, Any] = {
            "claim": self.claim.summary(),
            "family": self.gap.family,
            "route": self.problem.route,
            "states": {name: s.summary() for name, s in self.states.items()},
            "assumptions": list(self.assumptions),
            "samples": {"bound": self.samples.total, "lipschitz": self.lipschitz.samples, "audit": len(a.z)},
            "audit": {
                "points": len(a.z),
                "violations": a.violations,
                "gamma_violations": int(a.above.sum()),
                "epsilon": a.epsilon,
                "beta": a.beta,
                **a.entry.summary(),
            },
            "vacuous": self.vacuous,
            "lipschitz": self.lipschitz.summary(self.domain.axes),
        }
        if (symmetry := self.problem.symmetry) is not None:
            out["samples"]["symmetry"] = 2 * symmetry.pairs
        if (made := self.calibration) is not None:
            out["samples"]["calibration"] = made.samples()
            out["audit"]["allowed"] = a.limit
            out["calibration"] = made.summary()
        if self.attack:
            out["attack"] = dict(self.attack)
        if (witness := a.witness(self.gap)) is not None:
            out["audit"]["witness"] = witness | {"at": {a.name: v for a, v in zip(self.domain.axes, witness["z"], strict=True)}}
        said = [
            *(self.gate.warnings if self.gate is not None else ()),
            *warnings(self.lipschitz, self.domain.axes),
            *a.entry.warnings,
        ]
        hidden = self.gate.summary() if self.gate is not None else None
        out |= {k: v for k, v in (("hidden", hidden), ("warnings", said)) if v}
        return out

    def save(self, folder: Path) -> None:
        """Write `certificate.json` and `certificate.npz`; the samples stay in their shards, named here with their digests."""
        p = self.problem
        arrays = {f"predictor.{k}": v for k, v in p.predictor.arrays().items()}
        arrays |= {"lipschitz": p.lipschitz.value, "resolution": p.resolution, "remainder.resolution": p.remainder_resolution}
        arrays |= {} if p.lipschitz.cells is None else p.lipschitz.cells.arrays()
        arrays |= {} if p.arithmetics is None else {"rounding": p.arithmetic}
        arrays |= {} if p.lipschitz.curvature is None else {"curvature": p.lipschitz.curvature}
        for j, slab in enumerate(p.lipschitz.slabs or ()):
            arrays |= {} if slab is None else {f"curvature.cuts{j}": slab[0], f"curvature.slabs{j}": slab[1]}
        arrays["predictor.audit"] = p.predictor(self.audit.z)
        arrays |= {} if self.calibration is None else self.calibration.arrays(p)
        if p.predictor.kind == "model":
            arrays["predictor.samples"] = p.predictor(p.samples.z)
        self._write(
            folder,
            p.predictor.kind,
            arrays,
            symmetry=None if p.symmetry is None else p.symmetry.to_data(),
            cover=list(p.samples.cover.counts) if p.samples.cover else None,
            seed=p.seed,
            digests=dict(self.digests),
            arithmetic=None if p.arithmetics is None else [a.to_data() for a in p.arithmetics],
        )


def domain_data(domain: Domain, model: Model | None) -> dict[str, Any]:
    """Z as it is stored: names, units, how many are states, ends and relations; the model's period and relative inputs."""
    relative = getattr(model, "relative", None)
    return {
        "axes": [a.name for a in domain.axes],
        "units": [a.unit for a in domain.axes],
        "states": domain.nx,
        "period": None if model is None else model.period,
        "coordinates": {} if relative is None else dict(zip((a.name for a in relative.axes), relative.texts, strict=True)),
        "low": domain.low.tolist(),
        "high": domain.high.tolist(),
        "relations": [{"text": r.text, "a": list(r.coefficients), "b": r.bound} for r in domain.relations],
    }


def saved_digest(folder: Path) -> str:
    """The SHA-256 of the certificate saved in a folder, by which controllers name it."""
    return hashlib.sha256((folder / "certificate.json").read_bytes()).hexdigest()


def gap_digest(gap: GapFunction, problem: GapProblem) -> str:
    """Identity of the audited object: the gap function's data, and the seed that draws the audit's points."""
    h = hashlib.sha256(json.dumps([gap.family, dict(gap.form), problem.seed], sort_keys=True).encode())
    for name, array in sorted(gap.arrays().items()):
        h.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return h.hexdigest()
