"""Two residuals whose constants and curvature are known exactly, and the certified mean bound over their true mean gap.

Peer of each row: the family envelope with the true constants and as many samples.
"""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import replace

import harness
import numpy as np

from gapcert import AdaptiveSampling, GapFunction, Interval, LatticeSampling, StateSpec
from gapcert.contracts.systems.domain import Box, Domain
from gapcert.plugin import GapProblem, LipschitzBound, Samples, supremum
from gapcert_bounds.constants.gradient_elite import GradientElite
from gapcert_bounds.constants.interval import IntervalJacobian
from gapcert_bounds.families.envelope import Envelope
from gapcert_bounds.families.multilinear import Multilinear
from gapcert_bounds.testing.fields import Field, lipschitz_problem
from gapcert_equations.config import EquationsConfig
from gapcert_equations.model import EquationsModel

SOLID, WHEELS = (0.5, 2.0, 1.7, 0.4, 2.5, 0.3), (0.3, 0.2, 0.1, 0.05, 0.1)


class Solid(Field):
    """S3: r = a sin(αx) cos(βy) + b sin(γu) + c x u on [−1, 1]³, with (a, α, β, b, γ, c) = (0.5, 2, 1.7, 0.4, 2.5, 0.3).

    sup |∂x| = aα + c at the origin with u = 1; |∂y| = aβ and |∂²| = aα², aβ², bγ² at quarter waves; |∂u| = bγ + c.
    """

    text = "a*sin(p*x0)*cos(q*u0) + b*sin(s*u1) + c*x0*u1"
    sizes = types.MappingProxyType(dict(zip("apqbsc", SOLID, strict=True)))

    def __init__(self) -> None:
        super().__init__(1, 2)
        a, p, q, b, s, c = SOLID
        self.constants = np.nextafter(np.array([[a * p + c, a * q, b * s + c]]), np.inf)
        self.curvature = np.nextafter(np.array([[a * p**2, a * q**2, b * s**2]]), np.inf)

    def _step(self, x: np.ndarray, u: np.ndarray, **options: object) -> np.ndarray:
        a, p, q, b, s, c = SOLID
        return a * np.sin(p * x) * np.cos(q * u[:, :1]) + b * np.sin(s * u[:, 1:]) + c * x * u[:, 1:]

    def jacobian_enclosure(self, z: Interval) -> Interval:
        raise TypeError("no interval bounds are asked of it")

    def enclosure(self, z: Interval) -> Interval:
        raise TypeError("no interval bounds are asked of it")


class Wheels(Field):
    """S4: r = a cos(θ) w1 + b sin(θ) w2 + c tanh(w3 / δ) + q (w1² + w2²) on [−π, π] × [−1, 1]³.

    (a, b, c, δ, q) = (0.3, 0.2, 0.1, 0.05, 0.1). sup |∂θ| = sup |∂²θ| = √(a² + b²) at w = (1, 1); |∂w1| = a + 2 q,
    |∂w2| = b + 2 q, |∂w3| = c / δ; |∂²w1| = |∂²w2| = 2 q, |∂²w3| = 4 c / (3 √3 δ²).
    """

    text = "a*cos(x0)*u0 + b*sin(x0)*u1 + c*tanh(u2/d) + q*(u0**2 + u1**2)"
    sizes = types.MappingProxyType(dict(zip("abcdq", WHEELS, strict=True)))

    def __init__(self) -> None:
        super().__init__(1, 3)
        a, b, c, d, q = WHEELS
        r = np.hypot(a, b)
        self.constants = np.array([[r, a + 2 * q, b + 2 * q, c / d]]) * (1 + 1e-15)
        self.curvature = np.array([[r, 2 * q, 2 * q, 4 * c / (3 * np.sqrt(3) * d**2)]]) * (1 + 1e-15)
        self.states = (StateSpec("x0"),)
        cuts = np.array([0.0, 0.2, 1.2, 1.8, 2.4, 3.2, 4.5, 7.0, 1 / d])
        peak = np.arctanh(1 / np.sqrt(3))
        v = np.clip(peak, cuts[:-1], cuts[1:])  # where 2 tanh(v) sech(v)² is largest: it grows up to its peak, and falls beyond
        half = 2 * c / d**2 * np.tanh(v) / np.cosh(v) ** 2 * (1 + 1e-12)
        slab = np.concatenate([-d * cuts[:0:-1], d * cuts]), np.concatenate([half[::-1], half])[None]
        self.slabs = (None, None, None, slab)

    @property
    def domain(self) -> Domain:
        return Domain(Box(self.states, (-np.pi,), (np.pi,)), Box(self.inputs, (-1.0,) * 3, (1.0,) * 3))

    def _step(self, x: np.ndarray, u: np.ndarray, **options: object) -> np.ndarray:
        a, b, c, d, q = WHEELS
        w1, w2, w3 = (u[:, j : j + 1] for j in range(3))
        return a * np.cos(x) * w1 + b * np.sin(x) * w2 + c * np.tanh(w3 / d) + q * (w1**2 + w2**2)

    jacobian_enclosure = Solid.jacobian_enclosure
    enclosure = Solid.enclosure


def problem(field: Field, sampling: AdaptiveSampling | LatticeSampling, bound: LipschitzBound) -> GapProblem:
    """Samples of all rounds, with no predictor."""
    asked = lipschitz_problem(field)
    z = sampling.first(field.domain)
    z = z.chunk(0, len(z))
    further = sampling.further(field.domain, z, field(z), bound.value, bound)
    points = z if further is None else np.concatenate([z, further])
    axes = tuple(np.unique(c) for c in further.T) if isinstance(sampling, LatticeSampling) and further is not None else None
    return GapProblem(
        Samples(points, field(points), lattice=axes), field.domain, bound, asked.predictor, asked.resolution, "dominate"
    )


def proved(field: Solid | Wheels) -> LipschitzBound:
    """Constants and curvature by intervals, from the same residual as text."""
    given = {"states": {s.name: "1" for s in field.states}, "inputs": {u.name: "1" for u in field.inputs}, "period": "1 s"}
    other, nothing = (
        EquationsModel(
            EquationsConfig.model_validate({"kind": "equations", **given, "parameters": dict(sizes), "next": {"x0": text}})
        )
        for text, sizes in ((field.text, field.sizes), ("0*x0", {}))
    )
    return IntervalJacobian(curvature=True).bound(replace(lipschitz_problem(field), model=nothing, backend=other))


def ratio(gap: GapFunction, field: Field, points: int) -> tuple[float, int]:
    """(mean γ over mean |r|, points outside [l, u]) on fresh uniform points."""
    total, true, outside, rng = 0.0, 0.0, 0, np.random.default_rng(7)
    for start in range(0, points, 50_000):
        z = field.domain.draw(min(50_000, points - start), rng)
        r, (low, high) = field(z), gap.interval(z)
        total += float(np.maximum(np.abs(low), np.abs(high)).sum())
        true += float(np.abs(r).sum())
        outside += int(((r < low) | (r > high)).any(axis=1).sum())
    return total / true, outside


def rows(quick: bool) -> Iterator[harness.Row]:
    """Of both fields: constant, envelope, multilinear with true curvature, with proved, and with estimated curvature × 1.2."""
    many, few = (100_000, 10_000) if quick else (1_000_000, 20_000)
    for case, field, budget in (("smooth, 3-D", Solid(), 8_000), ("wheels, 4-D", Wheels(), 20_000)):
        true = LipschitzBound(field.constants, np.zeros_like(field.constants), "analytic", "exact", curvature=field.curvature)
        cloud = problem(field, AdaptiveSampling(budget), true)
        envelope = Envelope("none").fit(cloud)
        peer, missed = ratio(envelope, field, few)
        name = f"envelope, true constants, {len(cloud.samples):,} samples"
        top = supremum(envelope, field.domain, budget=20_000)[0]
        mean = float(np.abs(field(field.domain.draw(many, np.random.default_rng(7)))).mean())
        yield harness.row(case, "tightness of the constant", "1", float(top[0]) / mean, peer, name)
        guess = GradientElite(curvature=True).bound(lipschitz_problem(field))
        bounds = [("true curvature", true), (f"{guess.safety:g} × estimated curvature", guess)]
        bounds.append(("curvature proved by intervals", proved(field)))
        if isinstance(field, Wheels):
            bounds.append(("true curvature in 16 slabs of w3", replace(true, slabs=field.slabs)))
        for what, bound in bounds:
            nodes = problem(field, LatticeSampling(budget=budget), replace(bound, steep=None))
            gap = Multilinear("none").fit(nodes)
            ours, outside = ratio(gap, field, many)
            counts = "×".join(str(len(a)) for a in nodes.samples.lattice or ())
            yield harness.row(case, f"tightness of multilinear, {what}, {counts} nodes", "1", ours, peer, name)
            text = f"violations of l ≤ r ≤ u on {many:,} fresh points, {what}"
            yield harness.Row(case, text, "1", outside, missed, f"{name}, {few:,} points", None)
