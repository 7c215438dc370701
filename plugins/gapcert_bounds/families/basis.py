"""A sum of named basis functions that dominates |r| on every sample, at the least integral of the certified bound."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, final

import numpy as np

from gapcert.plugin import Array, Domain, GapFamily, GapFunction, GapProblem, Interval, Ints, Samples, Undecided, UsageError
from gapcert_bounds.thresholds import THRESHOLDS
from gapcert_functions import Expression, Factor, Term, WeightedSum, band, dominate, weighted

from .grammar import MalformedError, Node, read

Terms = Sequence[Term | Expression]

_EPS = float(np.finfo(np.float64).eps)
_CHUNK = 1 << 14


@final
class BasisGap(GapFunction):
    """γ_i(z) = max(0, Σ_l w_il p_l(z) + margin_i), and [−γ, γ]. weights (nx, m), margin (nx,)."""

    family = "basis"

    def __init__(self, terms: Terms, weights: Array, margin: Array) -> None:
        self.terms, self.weights, self.margin = tuple(terms), weights, margin

    def interval(self, z: Array) -> tuple[Array, Array]:
        high = np.maximum(weighted(self.terms, self.weights, z) + self.margin, 0.0)
        return -high, high

    def interval_over(self, boxes: Interval) -> Interval:
        high = self.ends_over(boxes)[1].hi
        return Interval(-high, high)

    def ends_over(self, boxes: Interval) -> tuple[Interval, Interval]:
        high = (WeightedSum(self.terms, self.weights).tight_over(boxes) + self.margin).maximum(0.0)
        return -high, high

    def lipschitz(self, boxes: Interval) -> Array:
        nz = boxes.lo.shape[1]
        total = Interval.exact(np.zeros((len(boxes), len(self.margin), nz)))
        for k, term in enumerate(self.terms):
            slope = Interval.stack([term.derivative_over(boxes, j) for j in range(nz)], axis=1)
            total = total + slope[:, None, :] * Interval.exact(self.weights[:, k])[None, :, None]
        return total.mag

    def arrays(self) -> dict[str, Array]:
        return {"weights": self.weights, "margin": self.margin}

    @property
    def form(self) -> Mapping[str, Any]:
        """Each function as a list of [axis, "power" | "abs" | "sin" | "cos", exponent or factor of the argument]."""
        return {"form": "basis", "functions": [t.data() for t in self.terms], "text": [t.text for t in self.terms]}


@final
class Basis(GapFamily):
    """Family `basis`. Route theorem1 minimises ∫_Z (Σ_l w_l p_l + margin(w)) subject to Σ_l w_l p_l(z_k) ≥ |r_k| for every k.

    margin_i = L₁(w) √(εx² + εu²) + L₂x εx + L₂u εu + 2 e_i with L₁(w) = ‖(Σ_l |w_l| sup_Z |∂_j p_l|)_j‖₂, which makes it a
    second-order cone program. Most samples do not bind: it is solved on few, violated ones are added, and at the end every
    sample is checked and the constant raised by what is missing.

    Route dominate fits one sum to either side of the tightest band at random points, by the same program without a margin;
    shifts per cell of a table then lift both over it, which is proved on the whole domain.
    """

    name = "basis"
    routes = ("theorem1", "dominate")

    def __init__(
        self,
        functions: Sequence[str],
        cells: Sequence[int] | None = None,
        tolerance: float = 0.01,
        boxes: int = 200_000,
        predictor: Literal["none", "affine"] = "none",
    ) -> None:
        self.functions, self.predictor = tuple(functions), predictor
        self.cells, self.tolerance, self.boxes = cells, tolerance, boxes

    def fit(self, problem: GapProblem) -> GapFunction:
        """UsageError where a function cannot be bounded, or on route theorem1 the samples are no cover."""
        return self._dominating(problem) if problem.route == "dominate" else self._theorem1(problem)

    def _theorem1(self, problem: GapProblem) -> BasisGap:
        domain, samples, data_margin = problem.domain, problem.samples, problem.margin
        terms = bounded(self.functions, domain)
        weights = scenario(terms, samples, domain, _joint_radius(problem, terms), problem.seed)
        own = Interval.exact(own_slope(terms, weights, domain)) * _joint_radius(problem, terms)
        rounding = _rounding(terms, weights, domain)
        margin = own + Interval.exact(data_margin) + Interval.exact(rounding)
        shift = shortfall(terms, weights, samples).max(axis=0)
        return BasisGap(terms, weights, np.asarray((margin + Interval.exact(np.maximum(shift, 0.0))).hi))

    def _dominating(self, problem: GapProblem) -> GapFunction:
        domain, nz = problem.domain, len(problem.domain.low)
        counts = tuple(self.cells or (max(1, min(8, int(THRESHOLDS.shift_cells ** (1 / nz)))),) * nz)
        if len(counts) != nz:
            raise UsageError(f"gap.cells: found {list(counts)}; expected one number per axis, that is {nz}")
        terms = bounded(self.functions, domain)
        z = domain.draw(THRESHOLDS.asked_points, np.random.default_rng([problem.seed, 0xBA515]))
        p, (low, high) = problem.predictor(z), band(problem).interval(z)
        lower, upper = (
            WeightedSum(tuple(terms), -_above(terms, z, p - low)),
            WeightedSum(tuple(terms), _above(terms, z, high - p)),
        )
        return dominate(problem, self.name, lower, upper, counts, self.tolerance, self.boxes)


def _above(terms: Terms, z: Array, target: Array) -> Array:
    """(nx, m) weights of the sums with the least mean over the points that lie above the targets (n, nx) there."""
    matrix = np.stack([t.value(z) for t in terms], axis=1)
    sizes = np.maximum(np.abs(matrix).max(axis=0), np.finfo(float).tiny)
    units = np.maximum(np.abs(target).max(axis=0), np.finfo(float).tiny)
    scaled = matrix / sizes
    solved = [_solve(scaled, t / unit, scaled.mean(axis=0)) for t, unit in zip(target.T, units, strict=True)]
    kept = np.array([np.where(np.abs(v) < THRESHOLDS.dropped_weight, 0.0, v) for v in solved])
    return np.asarray(kept * (units[:, None] / sizes))


def own_slope(terms: Terms, weights: Array, domain: Domain) -> Array:
    """(nx,) L₁ = ‖(Σ_l |w_il| sup_Z |∂_j p_l|)_j‖₂, rounded up."""
    slopes = Interval.exact(np.stack([t.slope(domain.interval) for t in terms]))
    per_axis = (abs(Interval.exact(weights))[:, :, None] * slopes[None]).sum(1)
    return np.asarray((per_axis * per_axis).sum(-1).sqrt().hi)


def _joint_radius(problem: GapProblem, terms: Terms) -> float:
    """√(εx² + εu²) over the axes that some function involves, rounded up."""
    if problem.samples.cover is None:
        raise UsageError("basis: the samples are no uniform cover; use `sampling: {kind: grid, ...}`")
    involved = np.isin(np.arange(len(problem.domain.low)), [j for t in terms for j in t.axes])
    ex, eu = (Interval.exact(e) for e in problem.samples.cover.radii(involved))
    return float((ex * ex + eu * eu).sqrt().hi)


def _rounding(terms: Terms, weights: Array, domain: Domain) -> Array:
    """(nx,): twice a bound on |computed Σ w p − Σ w p|, once for the samples and once for every other point."""
    whole = domain.interval
    sizes = np.array([t.over(whole).mag[0] for t in terms])
    errors = np.array([t.error(domain.interval) for t in terms])
    return np.asarray(2 * np.abs(weights) @ (errors + 2 * (len(terms) + 2) * _EPS * sizes))


def _chunks(samples: Samples) -> Iterator[slice]:
    for start in range(0, len(samples), _CHUNK):
        yield slice(start, start + _CHUNK)


def shortfall(terms: Terms, weights: Array, samples: Samples) -> Array:
    """(chunks, nx): the largest |r_k| − Σ_l w_l p_l(z_k) of each chunk of samples."""
    parts = [(np.abs(samples.r[c]) - weighted(terms, weights, samples.z[c])).max(axis=0) for c in _chunks(samples)]
    return np.array([np.nextafter(p, np.inf) for p in parts])


def scenario(terms: Terms, samples: Samples, domain: Domain, radius: float, seed: int) -> Array:
    """(nx, m) weights of the scenario program by constraint generation, in units of the largest residual and function."""
    whole = domain.interval
    sizes = np.array([max(float(t.over(whole).mag[0]), np.finfo(float).tiny) for t in terms])
    units = np.maximum(np.abs(samples.r).max(axis=0), np.finfo(float).tiny)
    cost = np.array([t.mean(domain.interval) for t in terms]) / sizes
    slopes = np.stack([t.slope(domain.interval) for t in terms], axis=1) / sizes * radius
    active = [_extremes(samples, i, seed) for i in range(len(units))]
    scaled = np.zeros((len(units), len(terms)))
    pending = set(range(len(units)))
    for _ in range(THRESHOLDS.exchange_rounds):
        for i in pending:
            z = samples.z[active[i]]
            matrix = np.stack([t.value(z) for t in terms], axis=1) / sizes
            solved = _solve(matrix, np.abs(samples.r[active[i], i]) / units[i], cost, slopes)
            # What is left of a function that the solver dropped.
            scaled[i] = np.where(np.abs(solved) < THRESHOLDS.dropped_weight, 0.0, solved)
        worst = _violated(terms, scaled * (units[:, None] / sizes), samples, units)
        pending = {i for i in pending if len(worst[i])}
        if not pending:
            break
        for i in pending:
            active[i] = np.union1d(active[i], worst[i])
    return np.asarray(scaled * (units[:, None] / sizes))


def _extremes(samples: Samples, i: int, seed: int) -> Ints:
    """The samples with the largest |r_i|, and a few hundred at random."""
    size = np.abs(samples.r[:, i])
    largest = np.argpartition(size, -min(100, len(size)))[-min(100, len(size)) :]
    some = np.random.default_rng([seed, i, 0xBA5]).choice(len(size), min(300, len(size)), replace=False)
    return np.union1d(largest, some)


def _violated(terms: Terms, weights: Array, samples: Samples, units: Array) -> list[Ints]:
    """Per state, the samples that are violated most: at most two of each chunk, so that they lie apart."""
    rows: list[list[Ints]] = [[] for _ in units]
    for c in _chunks(samples):
        missing = (np.abs(samples.r[c]) - weighted(terms, weights, samples.z[c])) / units
        for i in range(len(units)):
            top = np.argpartition(missing[:, i], -min(2, len(missing)))[-min(2, len(missing)) :]
            rows[i].append(c.start + top[missing[top, i] > THRESHOLDS.exchange_error])
    return [np.concatenate(r) for r in rows]


def _solve(matrix: Array, target: Array, cost: Array, slopes: Array | None = None) -> Array:
    """Minimise cost · v + ‖slopes · |v|‖₂ subject to matrix · v ≥ target. slopes (nz, m) contains the cover radius; None: 0."""
    cp: Any = importlib.import_module("cvxpy")
    v, size = cp.Variable(len(cost)), cp.Variable(len(cost))
    objective, subject = cost @ v, [matrix @ v >= target]
    if slopes is not None:
        objective, subject = objective + cp.norm(slopes @ size, 2), [*subject, size >= v, size >= -v]
    program = cp.Problem(cp.Minimize(objective), subject)
    try:
        program.solve(solver=cp.CLARABEL)
    except cp.SolverError as error:
        raise Undecided(f"basis: the scenario program was not solved ({error}); use fewer functions, of one size") from None
    if program.status in ("user_limit", "unbounded_inaccurate", "infeasible_inaccurate"):
        raise Undecided(f"basis: the solver ended with '{program.status}'; use fewer functions, of one size")
    if v.value is None or not np.isfinite(v.value).all():
        raise UsageError(
            f"basis: the scenario program is {program.status}: no combination of the functions dominates the samples; "
            f"add the function '1'"
        )
    return np.asarray(v.value, dtype=np.float64)


def parse(text: str, axes: Sequence[str]) -> Term | Expression:
    """The function that `text` writes over named axes: a product of one-dimensional factors where it is one, or an expression.

    UsageError where it is outside the grammar or names no axis.
    """
    try:
        node = read(text)
    except MalformedError as error:
        raise UsageError(f"gap.functions: '{text}': {error}") from None
    tree = _tree(node, text, axes)
    factors = [_factors(part, axes) for part in (node.parts if node.op == "*" else (node,))]
    if any(f is None for f in factors):
        return Expression(text.strip(), tree)
    return Term(text.strip(), _merged([f for part in factors for f in part or ()]))


def bounded(texts: Sequence[str], domain: Domain) -> list[Term | Expression]:
    """The functions that texts write; UsageError where one, or its slope, is not bounded on the domain's box."""
    terms = [parse(text, [a.name for a in domain.axes]) for text in texts]
    for term in terms:
        if not np.isfinite(term.error(domain.interval)):
            raise UsageError(
                f"gap.functions: '{term.text}' or a slope in it is unbounded on the domain's box, or not defined there "
                f"(sqrt and log need positive arguments); change the function, or make the domain smaller"
            )
    return terms


def _tree(node: Node, text: str, axes: Sequence[str]) -> Any:
    if node.op == "number":
        return node.number
    if node.op == "axis":
        if node.name not in axes:
            near = difflib.get_close_matches(node.name, axes, 1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(axes)}"
            raise UsageError(f"gap.functions: '{text}': '{node.name}' is no state or input; {hint}")
        return ["axis", list(axes).index(node.name)]
    parts = [_tree(part, text, axes) for part in node.parts]
    return [node.op, *parts, int(node.number)] if node.op == "^" else [node.op, *parts]


def _factors(node: Node, axes: Sequence[str]) -> list[Factor] | None:
    """axis^n, abs(axis)^n, sin(a axis)^n or cos(a axis)^n as factors, the number 1 as none; None for anything else."""
    if node.op == "number":
        return []
    power, base = (int(node.number), node.parts[0]) if node.op == "^" else (1, node)
    if base.op == "axis":
        return [Factor(axes.index(base.name), "power", power)]
    if base.op not in ("abs", "sin", "cos"):
        return None
    inner, scale = base.parts[0], 1.0
    if base.op != "abs" and inner.op == "*" and [p.op for p in inner.parts] == ["number", "axis"]:
        scale, inner = inner.parts[0].number, inner.parts[1]
    if inner.op != "axis" or scale < 0:
        return None
    axis = axes.index(inner.name)
    if base.op == "abs":
        return [Factor(axis, "abs", power)]
    return [Factor(axis, "sin" if base.op == "sin" else "cos", scale)] * power


def _merged(factors: Sequence[Factor]) -> tuple[Factor, ...]:
    """Powers of one axis as one power: x · x alone would range over negative numbers as well."""
    powers: dict[tuple[int, str], float] = {}
    waves = [f for f in factors if f.kind in ("sin", "cos")]
    for f in factors:
        if f.kind in ("power", "abs"):
            powers[f.axis, f.kind] = powers.get((f.axis, f.kind), 0) + f.number
    merged = [Factor(axis, "abs" if kind == "abs" else "power", n) for (axis, kind), n in powers.items()]
    return (*merged, *waves)
