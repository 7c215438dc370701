"""What kind of law a residual looks like: force features along the path, regressed over windows and judged on unseen ones.

The answer is a kind (a law of the present state, periodic, with memory, …), and for a law of the present state a formula. It is
what data alone suggest where no effect fits, and never a cause.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.signal import lfilter

from gapcert.diagnosis.tangent import Tangent
from gapcert.effect import Correction, EffectParameter, site_units
from gapcert.system import Array, Extension, Parameter

FOLDS = 5
TURNS = 40  # regressions on residuals whose windows have changed places and signs
CHANCE = 1.2  # times the best of these, which a share must beat
LOUD = 4.0  # times the median square of a window's residual
RIDGE = 10.0 ** np.arange(-5, 3)  # of the mean square of a column
LAGS = (0.01, 0.05, 0.2, 1.0)  # s: memories of the input that are tried
LATE = (0.005, 0.02, 0.05)  # s: delays of the input that are tried
WIDTHS = (0.03, 0.1, 0.3, 0.6)  # of an input's root mean square: half plays; of its rate: limits
BRISTLES = (0.005, 0.02, 0.05, 0.15)  # of the range of a coordinate: what a bristle may bend
PERIODS = np.arange(1.5, 16.1, 0.5)  # over the range of a coordinate
MEMORY = ("input memory", "input hysteresis", "position memory")
TERMS, WORTH = 4, 0.01  # of a formula: most terms, least share that one must add


@final
@dataclass(frozen=True)
class Learnt:
    """At one site: the share of the residual that each kind predicts, all laws without memory, and all kinds together."""

    site: str
    kinds: Mapping[str, float]
    law: float
    both: float

    @property
    def share(self) -> float:
        return max(self.law, self.both, *self.kinds.values())

    @property
    def memory(self) -> float:
        """What only a memory predicts."""
        plain = max(v for k, v in self.kinds.items() if k not in MEMORY)
        return max(self.both, *(self.kinds[k] for k in MEMORY)) - max(self.law, plain)


def learn(motion: Tangent, site: str) -> Learnt:
    features = {k: motion.responses(site, f) for k, f in _features(motion, site).items() if f.shape[-1]}
    kinds = {k: predicted(motion, rows) for k, rows in features.items()}
    law = predicted(motion, np.concatenate([rows for k, rows in features.items() if k not in MEMORY], axis=-1))
    both = predicted(motion, np.concatenate(list(features.values()), axis=-1))
    return Learnt(site, {k: kinds.get(k, 0.0) for k in ("static", "periodic", *MEMORY)}, law, both)


def predicted(motion: Tangent, columns: Array) -> float:
    """The share of the residual that a ridge regression on columns (W, R, K) predicts in windows it has not seen.

    0 where it is chance: with windows that stand out counting no more than others (a law acts everywhere, one push does not),
    the same regression does as well when whole windows of the residual change places and signs.
    """
    size = np.sqrt(np.mean(columns**2, axis=(0, 1)))
    columns = columns[..., size > 1e-9 * size.max(initial=1e-300)]
    if not columns.shape[-1]:
        return 0.0
    columns = columns / np.sqrt(np.mean(columns**2, axis=(0, 1)))
    energy = np.sum(motion.residual**2, axis=1)
    even = np.sqrt(np.minimum(1.0, LOUD * np.median(energy) / np.maximum(energy, 1e-300)))[:, None]
    level = even * motion.residual
    rng, count = np.random.default_rng(0), len(columns)
    moved = [np.roll(level, rng.integers(1, max(2, count)), axis=0) * rng.choice([-1.0, 1.0], (count, 1)) for _ in range(TURNS)]
    shares = _shares(even[..., None] * columns, np.stack([level, *moved], axis=-1))
    if shares[0] <= CHANCE * max(0.0, shares[1:].max()):
        return 0.0
    return max(0.0, float(_shares(columns, motion.residual[..., None])[0]))


def _shares(columns: Array, residuals: Array) -> Array:
    """Predicted shares (D,) of each of D residuals (W, R, D)."""
    grams, sides = _normal(columns, residuals)
    rows, left = columns.shape[0] * columns.shape[1], np.zeros((len(RIDGE), residuals.shape[-1]))
    for k in range(len(grams)):
        values, vectors = np.linalg.eigh(grams.sum(axis=0) - grams[k])
        along = vectors.T @ (sides.sum(axis=0) - sides[k])
        for i, ridge in enumerate(RIDGE * rows):
            weights = vectors @ (along / (np.maximum(values, 0)[:, None] + ridge))
            left[i] += np.sum(weights * (grams[k] @ weights - 2 * sides[k]), axis=0)
    return np.asarray(-left.min(axis=0) / np.maximum(np.sum(residuals**2, axis=(0, 1)), 1e-300))


def _normal(columns: Array, residuals: Array) -> tuple[Array, Array]:
    """Normal equations of each fold, (F, K, K) and (F, K, D): every fifth window."""
    fold = np.arange(len(columns)) % FOLDS
    parts = [
        (a.reshape(-1, a.shape[-1]), b.reshape(-1, b.shape[-1]))
        for a, b in ((columns[fold == i], residuals[fold == i]) for i in range(min(FOLDS, len(columns))))
    ]
    return np.stack([a.T @ a for a, _ in parts]), np.stack([a.T @ b for a, b in parts])


def _features(motion: Tangent, site: str) -> dict[str, Array]:
    """Forces (W, S, K) of each kind at a site."""
    u, drives, paths = motion.u, motion.drives(), motion.paths()
    q, v = motion.place(site)
    z = np.concatenate([motion.x, u], axis=-1)
    z = z / (np.sqrt(np.mean(z**2, axis=(0, 1))) + 1e-12)
    speed = np.tanh(10 * z[..., v : v + 1])
    static = [z, z * np.abs(z), z**3, np.tanh(3 * z), np.tanh(10 * z), speed * np.abs(z), np.ones_like(speed)]
    if u.shape[-1]:
        cuts = ((1, 0.8), (1, 0.95), (-1, 0.2), (-1, 0.05))
        static += [np.maximum(s * (u - np.quantile(u, p, axis=(0, 1))), 0) for s, p in cuts]
    memory: list[Array] = []
    for lag in LAGS:
        slow = [_low_pass(d, motion.model.period / lag) for d in drives]
        sizes = [_low_pass(np.abs(d), motion.model.period / lag) for d in drives]
        memory += [motion.gather(slow), motion.gather(sizes), u * motion.gather(sizes)]
    memory += [motion.gather([_late(d, round(s / motion.model.period)) for d in drives]) - u for s in LATE]
    size = np.sqrt(np.mean(np.concatenate(drives) ** 2, axis=0)) + 1e-300
    rate = np.sqrt(np.mean(np.concatenate([np.diff(d, axis=0) for d in drives]) ** 2, axis=0)) + 1e-300
    many = np.repeat(u, len(WIDTHS), axis=-1)
    hysteresis = [
        motion.gather([f(d, np.outer(x, WIDTHS)) for d in drives]) - many for f, x in ((_play, size), (_limited, rate))
    ]
    found = {"static": static, "input memory": memory, "input hysteresis": hysteresis}
    if q is not None:
        span = float(np.ptp(motion.x[..., q])) or 1.0
        angle = 2 * np.pi * PERIODS / span * motion.x[..., q : q + 1]
        found["periodic"] = [np.sin(angle), np.cos(angle)]
        half = span * np.array([BRISTLES])
        bend = motion.gather([np.repeat(p, len(BRISTLES), 1) - _play(p, half) for p in (x[:, q : q + 1] for x in paths)])
        found["position memory"] = [bend / half, bend * np.abs(bend) / half**2]
    return {k: np.concatenate(f, axis=-1) for k, f in found.items()}


def _low_pass(u: Array, share: float) -> Array:
    keep = math.exp(-share)
    return np.asarray(lfilter([1 - keep], [1.0, -keep], u - u[0], axis=0) + u[0])


def _late(u: Array, steps: int) -> Array:
    return np.concatenate([np.repeat(u[:1], steps, axis=0), u])[: len(u)]


def _play(u: Array, half: Array) -> Array:
    """What follows u (T, k) only once it has crossed a gap of ± half (k, w), (T, k·w)."""
    out = np.empty((len(u), *half.shape))
    at = np.repeat(u[0][:, None], half.shape[1], axis=1)
    for k in range(len(u)):
        at = np.clip(at, u[k][:, None] - half, u[k][:, None] + half)
        out[k] = at
    return out.reshape(len(u), -1)


def _limited(u: Array, most: Array) -> Array:
    """What follows u (T, k) by at most so much per step, (T, k·w)."""
    out = np.empty((len(u), *most.shape))
    at = np.repeat(u[0][:, None], most.shape[1], axis=1)
    for k in range(len(u)):
        at = at + np.clip(u[k][:, None] - at, -most, most)
        out[k] = at
    return out.reshape(len(u), -1)


@final
@dataclass(frozen=True)
class Term:
    """A readable force: its text with {c} for the coefficient and {s} for a scale, the units of both, its values (W, S)."""

    text: str
    unit: Mapping[str, int]
    values: Array
    scale: float | None = None
    scale_unit: Mapping[str, int] | None = None


def _terms(motion: Tangent, site: str) -> list[Term]:
    q, v = motion.place(site)
    speed = motion.x[..., v]
    brisk = float(np.sqrt(np.mean(speed**2))) or 1.0
    out = [Term("{c}", {"force": 1}, np.ones_like(speed))]
    powers = ((1, "{z}"), (2, "{z}*abs({z})"), (3, "{z}**3"))
    named = [("velocity", "{v}", speed)] + ([("position", "{q}", motion.x[..., q])] if q is not None else [])
    for kind, name, z in named:
        values = {1: z, 2: z * np.abs(z), 3: z**3}
        out += [Term("{c}*" + t.replace("{z}", name), {"force": 1, kind: -n}, values[n]) for n, t in powers]
    out += [
        Term("{c}*tanh({v}/{s})", {"force": 1}, np.tanh(speed / s), s, {"velocity": 1}) for s in (0.02 * brisk, 0.2 * brisk)
    ]
    if q is not None:
        place = motion.x[..., q]
        for k in 2 * np.pi * PERIODS / (float(np.ptp(place)) or 1.0):
            wave = {"sin": np.sin(k * place), "cos": np.cos(k * place)}
            out += [Term(f"{{c}}*{f}({{s}}*{{q}})", {"force": 1}, w, float(k), {"position": -1}) for f, w in wave.items()]
    for i, spec in enumerate(motion.model.inputs):
        drive = motion.u[..., i]
        values = {1: drive, 2: drive * np.abs(drive), 3: drive**3}
        out += [Term("{c}*" + t.replace("{z}", spec.name), {"force": 1, spec.name: -n}, values[n]) for n, t in powers]
    return out


def correction(motion: Tangent, site: str) -> Correction | None:
    """A formula of few terms for the missing force at a site, added one at a time while unseen windows gain by it."""
    terms = _terms(motion, site)
    columns = motion.responses(site, np.stack([t.values for t in terms], axis=-1))
    grams, signed = _normal(columns, motion.residual[..., None])
    sides, total = signed[..., 0], float(np.sum(motion.residual**2))
    all_gram, all_side = grams.sum(axis=0), sides.sum(axis=0)
    if total <= 0:
        return None

    def judged(chosen: list[int]) -> float:
        at, gained = np.ix_(chosen, chosen), 0.0
        for gram, side in zip(grams, sides, strict=True):
            w = np.linalg.lstsq((all_gram - gram)[at], (all_side - side)[chosen], rcond=1e-9)[0]
            gained += float(2 * side[chosen] @ w - w @ gram[at] @ w)
        return gained / total

    chosen: list[int] = []
    best = 0.0
    while len(chosen) < TERMS:
        scores = {i: judged([*chosen, i]) for i in range(len(terms)) if i not in chosen}
        i = max(scores, key=lambda k: scores[k])
        if scores[i] < best + WORTH:
            break
        chosen, best = [*chosen, i], scores[i]
    if not chosen:
        return None
    weights = np.linalg.lstsq(all_gram[np.ix_(chosen, chosen)], all_side[chosen], rcond=1e-9)[0]
    return _written(motion, site, [terms[i] for i in chosen], weights, best)


def _written(motion: Tangent, site: str, terms: list[Term], weights: Array, explained: float) -> Correction:
    """As text in the model's names, and as an Extension that `Model.extend` takes."""
    model = motion.model
    units = site_units(model, "coordinate", site) | {u.name: u.unit for u in model.inputs}
    q, v = motion.place(site)
    names = {"{v}": model.states[v].name, "{q}": model.states[q].name if q is not None else ""}
    texts, parts, numbers = {}, [], []
    for i, (term, weight) in enumerate(zip(terms, weights, strict=True)):
        own = {"{c}": f"correction_{site}_{i}", "{s}": f"correction_{site}_{i}_scale"}
        numbers.append(Parameter(own["{c}"], float(weight), _unit(term.unit, units)))
        if term.scale is not None and term.scale_unit is not None:
            numbers.append(Parameter(own["{s}"], term.scale, _unit(term.scale_unit, units)))
        shown = term.text.removeprefix("{c}*").replace("{c}", "1").replace("{s}", f"{term.scale:.4g}" if term.scale else "")
        texts[_filled(shown, names)] = float(weight)
        parts.append(_filled(term.text, own))
    extension = Extension("correction", site, tuple(numbers), force=" + ".join(parts))
    return Correction(site, "basis", texts, explained, extension)


def _filled(text: str, names: Mapping[str, str]) -> str:
    for placeholder, name in names.items():
        text = text.replace(placeholder, name)
    return text


def _unit(dimension: Mapping[str, int], units: Mapping[str, str]) -> str:
    return EffectParameter("", dimension, (), 0.0, 0.0).unit(dict(units))
