"""What kind of law a residual looks like: force features along the path, regressed over windows and judged on unseen ones.

The answer is a kind (a law of the present state, periodic, with memory, …), and for a law of the present state a formula. It is
what data alone suggest where no effect fits, and never a cause.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from gapcert.plugin import Array, EffectParameter, Extension, Parameter, position, site_units
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.results import Correction
from gapcert_diagnosis.thresholds import THRESHOLDS

Chosen = npt.NDArray[np.bool_]
RIDGE = 10.0 ** np.arange(-5, 3)  # of the mean square of a column
PERIODS = np.arange(1.5, 16.1, 0.5)  # over the range of a coordinate
MEMORY = ("input memory", "input hysteresis", "position memory")


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
    """Of a force, from what the inputs and the path suggest at a site."""
    found = {**input_features(motion), **features(motion, site)}
    made = motion.responses(site, np.concatenate(list(found.values()), axis=-1))
    return _learnt(motion, site, found, made, motion.residual[..., None])


def learn_shown(motion: Tangent, channel: int) -> Learnt:
    """Of the residual of one channel: what its output equation lacks, which changes no state."""
    found, name = {**input_features(motion), **_shown_features(motion)}, motion.windows.measured.channels[channel].name
    if name in (s.name for s in motion.model.states):
        del found["position memory"]  # the path of a state is as its own channel measured it, noise included
    made = motion.shown(channel, np.concatenate(list(found.values()), axis=-1))
    own = np.zeros((*motion.windows.y.shape, 1))
    own[:, :, channel, 0] = motion.residual.reshape(motion.windows.y.shape)[..., channel]
    return _learnt(motion, name, found, made, own.reshape(*motion.residual.shape, 1))


def _learnt(motion: Tangent, site: str, found: Mapping[str, Array], made: Array, rows: Array) -> Learnt:
    columns = motion.coarse(made)
    kind = np.repeat(list(found), [f.shape[-1] for f in found.values()])
    columns = columns / (np.sqrt(np.mean(columns**2, axis=(0, 1))) + 1e-300)
    sound = np.isfinite(columns).all(axis=(0, 1))  # where a state runs away, forces leave no number
    columns, kind = columns[..., sound], kind[sound]
    if not kind.size:
        return Learnt(site, dict.fromkeys(("static", "periodic", *MEMORY), 0.0), 0.0, 0.0)
    residual = motion.coarse(rows)[..., 0]
    energy = np.sum(residual**2, axis=1)
    even = np.sqrt(np.minimum(1.0, THRESHOLDS.loud_window * np.median(energy) / np.maximum(energy, 1e-300)))[:, None]
    rng, count = np.random.default_rng(0), len(columns)
    level = even * residual
    moved = [
        np.roll(level, rng.integers(1, max(2, count)), axis=0) * rng.choice([-1.0, 1.0], (count, 1))
        for _ in range(THRESHOLDS.chance_turns)
    ]
    loud = _Regression.of(columns, residual[..., None])
    fair = _Regression.of(even[..., None] * columns, np.stack([level, *moved], axis=-1))

    def predicted(chosen: Chosen) -> float:
        """The share in windows not seen, 0 where it is chance: there, the same features do as well on windows that have changed
        places and signs. In that comparison windows that stand out count no more than others: one push is no law."""
        shares = fair.shares(chosen)
        by_chance = shares[0] <= THRESHOLDS.chance_share * max(0.0, float(shares[1:].max()))
        return 0.0 if by_chance else max(0.0, float(loud.shares(chosen)[0]))

    kinds = {k: predicted(kind == k) if (kind == k).any() else 0.0 for k in ("static", "periodic", *MEMORY)}
    return Learnt(site, kinds, predicted(~np.isin(kind, MEMORY)), predicted(np.ones(len(kind), dtype=bool)))


@final
@dataclass(frozen=True)
class _Regression:
    """Normal equations of each fold (every fifth window): grams (F, K, K), sides (F, K, D) of D residuals, totals (D,)."""

    grams: Array
    sides: Array
    totals: Array
    rows: int

    @classmethod
    def of(cls, columns: Array, residuals: Array) -> _Regression:
        fold = np.arange(len(columns)) % THRESHOLDS.folds
        parts = []
        for i in range(min(THRESHOLDS.folds, len(columns))):
            a, b = columns[fold == i].reshape(-1, columns.shape[-1]), residuals[fold == i].reshape(-1, residuals.shape[-1])
            parts.append((a.T @ a, a.T @ b))
        totals = np.sum(residuals**2, axis=(0, 1))
        grams, sides = (np.stack(p) for p in zip(*parts, strict=True))
        return cls(grams, sides, totals, columns.shape[0] * columns.shape[1])

    def shares(self, chosen: Chosen) -> Array:
        """Shares (D,) that a ridge regression on some columns predicts in windows that it has not seen."""
        at, left = np.ix_(chosen, chosen), np.zeros((len(RIDGE), len(self.totals)))
        whole, side = self.grams.sum(axis=0)[at], self.sides.sum(axis=0)[chosen]
        for gram, own in zip(self.grams, self.sides[:, chosen], strict=True):
            values, vectors = np.linalg.eigh(whole - gram[at])
            along, inner = vectors.T @ (side - own), vectors.T @ gram[at] @ vectors
            mine = vectors.T @ own
            for i, ridge in enumerate(RIDGE * self.rows):
                weights = along / (np.maximum(values, 0)[:, None] + ridge)
                left[i] += np.sum(weights * (inner @ weights - 2 * mine), axis=0)
        return np.asarray(-left.min(axis=0) / np.maximum(self.totals, 1e-300))


def input_features(motion: Tangent) -> dict[str, Array]:
    """Forces (W, S, K) that follow the inputs with a memory, in units of the input."""
    makers = {"input memory": _input_memory, "input hysteresis": _input_hysteresis}
    return {kind: motion.once(kind, partial(make, motion)) for kind, make in makers.items()}


def _input_memory(motion: Tangent) -> Array:
    u, drives, repeat = motion.u, motion.windows.measured.driven, motion.windows.measured.repeat
    memory: list[Array] = []
    for lag in THRESHOLDS.input_lags:
        slow = [_low_pass(d, 1 / (lag * repeat)) for d in drives]
        sizes = [_low_pass(np.abs(d), 1 / (lag * repeat)) for d in drives]
        memory += [motion.gather(slow), motion.gather(sizes), u * motion.gather(sizes)]
    memory += [motion.gather([_late(d, round(s * repeat)) for d in drives]) - u for s in THRESHOLDS.input_delays]
    return np.concatenate(memory, axis=-1)


def _input_hysteresis(motion: Tangent) -> Array:
    drives = motion.windows.measured.driven
    size = np.sqrt(np.mean(np.concatenate(drives) ** 2, axis=0)) + 1e-300
    rate = np.sqrt(np.mean(np.concatenate([np.diff(d, axis=0) for d in drives]) ** 2, axis=0)) + 1e-300
    many = np.repeat(motion.u, len(THRESHOLDS.play_widths), axis=-1)
    kinds = ((_play, np.outer(size, THRESHOLDS.play_widths)), (_limited, np.outer(rate, THRESHOLDS.play_widths)))
    return np.concatenate([motion.gather([f(d, widths) for d in drives]) - many for f, widths in kinds], axis=-1)


def features(motion: Tangent, site: str) -> dict[str, Array]:
    """Forces (W, S, K) of the present state and input, and of the path of the site's position."""
    q, v = motion.place(site)
    z, static = _static(motion)
    found = {"static": np.concatenate([static, np.tanh(10 * z[..., v : v + 1]) * np.abs(z)], axis=-1)}
    if q is not None:
        span = float(np.ptp(motion.x[..., q])) or 1.0
        angle = 2 * np.pi * PERIODS / span * motion.x[..., q : q + 1]
        found["periodic"] = np.concatenate([np.sin(angle), np.cos(angle)], axis=-1)
        bend = motion.once("bends", lambda: _bends(motion))[:, :, q]
        found["position memory"] = np.concatenate([bend, bend * np.abs(bend)], axis=-1)
    return found


def _shown_features(motion: Tangent) -> dict[str, Array]:
    """What may be added (W, S, K) to a reading: laws of the present state and input, and of the path of any state."""
    bend = motion.once("bends", lambda: _bends(motion)).reshape(*motion.x.shape[:2], -1)
    z, static = _static(motion)
    n = z.shape[-1]
    several = [z[..., i : i + 1] * z[..., i + 1 :] for i in range(n)]
    curves = [hats(z[..., i], np.quantile(z[..., i], THRESHOLDS.curve_knots)) for i in range(n)]
    law = np.concatenate([static, *several, *curves], axis=-1)
    return {"static": law, "position memory": np.concatenate([bend, bend * np.abs(bend)], axis=-1)}


def _static(motion: Tangent) -> tuple[Array, Array]:
    """State and input over their root mean squares, and functions of single ones of them."""
    u, z = motion.u, np.concatenate([motion.x, motion.u], axis=-1)
    z = z / (np.sqrt(np.mean(z**2, axis=(0, 1))) + 1e-12)
    static = [z, z * np.abs(z), z**3, np.tanh(3 * z), np.tanh(10 * z), np.ones((*z.shape[:2], 1))]
    if u.shape[-1]:
        cuts = ((1, 0.8), (1, 0.95), (-1, 0.2), (-1, 0.05))
        static += [np.maximum(s * (u - np.quantile(u, p, axis=(0, 1))), 0) for s, p in cuts]
    return z, np.concatenate(static, axis=-1)


def hats(z: Array, knots: Array) -> Array:
    """Piecewise linear functions (…, K) of z, each 1 at one knot and 0 at the others."""
    at = np.unique(knots)
    return np.stack([np.interp(z, at, e) for e in np.eye(len(at))], axis=-1)


def _bends(motion: Tangent) -> Array:
    """How far each state is from what follows it with play, (W, S, nx, w), in units of that play."""
    spans = np.ptp(motion.x, axis=(0, 1))
    half = np.outer(np.where(spans > 0, spans, 1.0), THRESHOLDS.bristle_bends)
    bends = [np.repeat(p, len(THRESHOLDS.bristle_bends), axis=1) - _play(p, half) for p in motion.windows.measured.paths]
    return np.asarray(motion.gather(bends).reshape(*motion.x.shape, -1) / half)


def _low_pass(u: Array, share: float) -> Array:
    keep = math.exp(-share)
    return np.asarray(lfilter([1 - keep], [1.0, -keep], u - u[0], axis=0) + u[0])


def _late(u: Array, steps: int) -> Array:
    return np.concatenate([np.repeat(u[:1], steps, axis=0), u])[: len(u)]


def _play(u: Array, half: Array) -> Array:
    """What follows u (T, k) only once it has crossed a gap of ± half (k, w), (T, k·w)."""
    low, high = u[:, :, None] - half, u[:, :, None] + half
    at, out = np.repeat(u[0][:, None], half.shape[1], axis=1), np.empty((len(u), *half.shape))
    for least, most, new in zip(low, high, out, strict=True):
        np.maximum(at, least, out=new)
        at = np.minimum(new, most, out=new)
    return out.reshape(len(u), -1)


def _limited(u: Array, most: Array) -> Array:
    """What follows u (T, k) by at most so much per step, (T, k·w)."""
    at, least, out = np.repeat(u[0][:, None], most.shape[1], axis=1), -most, np.empty((len(u), *most.shape))
    for goal, new in zip(u[:, :, None], out, strict=True):
        np.subtract(goal, at, out=new)
        np.maximum(new, least, out=new)
        np.minimum(new, most, out=new)
        at = np.add(at, new, out=new)
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
    def powers(dimension: str, z: str, values: Array) -> list[Term]:
        found = ((1, z, values), (2, f"{z}*abs({z})", values * np.abs(values)), (3, f"{z}**3", values**3))
        return [Term("{c}*" + text, {"force": 1, dimension: -n}, power) for n, text, power in found]

    q, v = motion.place(site) if position(motion.model, site) is not None else (None, motion.place(site)[1])
    speed = motion.x[..., v]
    brisk = float(np.sqrt(np.mean(speed**2))) or 1.0
    out = [Term("{c}", {"force": 1}, np.ones_like(speed)), *powers("velocity", "{v}", speed)]
    out += [] if q is None else powers("position", "{q}", motion.x[..., q])
    out += [
        Term("{c}*tanh({v}/{s})", {"force": 1}, np.tanh(speed / s), s, {"velocity": 1}) for s in (0.02 * brisk, 0.2 * brisk)
    ]
    if q is not None:
        place = motion.x[..., q]
        for k in 2 * np.pi * PERIODS / (float(np.ptp(place)) or 1.0):
            wave = {"sin": np.sin(k * place), "cos": np.cos(k * place)}
            out += [Term(f"{{c}}*{f}({{s}}*{{q}})", {"force": 1}, w, float(k), {"position": -1}) for f, w in wave.items()]
    for i, spec in enumerate(motion.model.inputs):
        out += powers(spec.name, spec.name, motion.u[..., i])
    return out


def correction(motion: Tangent, site: str) -> Correction | None:
    """A formula of few terms for the missing force at a site, added one at a time while unseen windows gain by it."""
    terms = _terms(motion, site)
    columns = motion.coarse(motion.responses(site, np.stack([t.values for t in terms], axis=-1)))
    normal = _Regression.of(columns, motion.coarse(motion.residual[..., None]))
    grams, sides, total = normal.grams, normal.sides[..., 0], float(normal.totals[0])
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
    while len(chosen) < THRESHOLDS.formula_terms:
        scores = {i: judged([*chosen, i]) for i in range(len(terms)) if i not in chosen}
        i = max(scores, key=lambda k: scores[k])
        if scores[i] < best + THRESHOLDS.term_share:
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
