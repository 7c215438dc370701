"""Misfits planted in one output equation: what only a sensor shows, in plants of a third hand, with steps of their own.

A case counts where the channel, once parameters and the starts of windows have been refitted to all channels, is still left at
more than 1.5 noise floors: `nothing` is then a lie. With nothing planted, `nothing` is the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from scipy.optimize import lsq_linear
from scipy.signal import lfilter

import gapcert as gc
from exams import sit
from exams.hidden.draw import generator
from exams.hidden.log import coloured
from exams.plain import wave
from gapcert.numerics.arrays import Array

Record = dict[str, Any]
LOUD, WINDOWS, FITTED, FINE, REACH = 1.8, 12, 0.75, 8, 0.12
KINDS = ("scale", "offset", "term missing", "term turned", "square", "cube", "kink", "dry", "product", "lag", "play")


@final
@dataclass(frozen=True)
class Plant:
    """values: name → (value, unit, known only roughly?); terms: output → what its equation sums up; slow: its time in s."""

    states: Mapping[str, str]
    inputs: Mapping[str, str]
    values: Mapping[str, tuple[float, str, bool]]
    derivative: Mapping[str, str]
    terms: Mapping[str, Sequence[str]]
    slow: float
    middle: float
    peak: float
    rest: Sequence[float]

    @property
    def outputs(self) -> dict[str, str]:
        return {y: " + ".join(terms).replace("+ -", "- ") for y, terms in self.terms.items()}

    def compiled(self, text: str) -> Callable[..., Any]:
        """Of (parameters, states, input), by name."""
        names = ", ".join((*self.values, *self.states, *self.inputs))
        known = {n: getattr(np, n) for n in ("sin", "cos", "sqrt", "tanh")} | {"max": np.maximum}
        return eval(f"lambda {names}: {text}", known)


def plant(name: str, rng: np.random.Generator) -> Plant:
    def drawn(low: float, high: float) -> float:
        return float(f"{math.exp(rng.uniform(math.log(low), math.log(high))):.4g}")

    if name == "motor":
        R, K, slow = drawn(0.5, 5), drawn(0.02, 0.2), drawn(0.08, 0.4)
        values = {"R": (R, "ohm", True), "K": (K, "N*m/A", True), "J": (slow * K**2 / R, "kg*m^2", True)}
        values["b"] = (drawn(0.05, 0.3) * K**2 / R, "N*m*s/rad", True)
        rate = {"w": "(K*(V - K*w)/R - b*w)/J"}
        return Plant({"w": "rad/s"}, {"V": "V"}, values, rate, {"w": ["w"], "i": ["V/R", "-K*w/R"]}, slow, 0.0, 12.0, (0.0,))
    if name == "cart":
        m, w, z = drawn(0.3, 5), drawn(2, 12), drawn(0.05, 0.5)
        values = {"m": (m, "kg", True), "d": (2 * z * w * m, "N*s/m", True), "k": (w**2 * m, "N/m", True)}
        rate = {"x": "v", "v": "(u - d*v - k*x)/m"}
        terms = {"x": ["x"], "a": ["u/m", "-d*v/m", "-k*x/m"]}
        return Plant({"x": "m", "v": "m/s"}, {"u": "N"}, values, rate, terms, 2 / w, 0.0, 0.2 * w**2 * m, (0.0, 0.0))
    if name == "strut":
        force = drawn(50, 2000)
        values = {"k": (force * drawn(3, 20), "N/m", True), "c": (force * drawn(2, 8), "N*s/m", True)}
        values["F0"] = (0.3 * force * drawn(0.3, 1), "N", True)
        values["vs"] = (0.05, "m/s", False)
        terms = {"x": ["x"], "F": ["k*x", "c*v", "F0*tanh(v/vs)"]}
        return Plant({"x": "m"}, {"v": "m/s"}, values, {"x": "v"}, terms, drawn(0.1, 0.3), 0.0, 0.15, (0.0,))
    if name == "pendulum":
        m, length = drawn(0.2, 2), drawn(0.2, 1)
        values = {"m": (m, "kg", True), "l": (length, "m", True), "g": (9.81, "m/s**2", False)}
        values["d"] = (m * length**2 * drawn(0.2, 1.5), "N*m*s/rad", True)
        rate = {"q": "w", "w": "(T - d*w - m*g*l*sin(q))/(m*l**2)"}
        terms = {"q": ["q"], "S": ["m*g*cos(q)", "m*l*w**2"]}
        top = 0.6 * m * 9.81 * length
        return Plant(
            {"q": "rad", "w": "rad/s"}, {"T": "N*m"}, values, rate, terms, 0.4 * math.sqrt(length), 0.0, top, (0.0, 0.0)
        )
    if name == "tank":
        A, level, slow = drawn(0.05, 0.5), drawn(0.4, 1.0), drawn(20, 80)
        flow = 2 * level * A / slow
        values = {"A": (A, "m^2", True), "a": (flow / math.sqrt(2 * 9.81 * level), "m^2", True), "g": (9.81, "m/s^2", False)}
        out = "a*sqrt(2*g*max(h, 0))"
        terms = {"h": ["h"], "n": ["q", f"-{out}"], "o": [out]}
        return Plant({"h": "m"}, {"q": "m^3/s"}, values, {"h": f"(q - {out})/A"}, terms, slow, flow, 0.3 * flow, (level,))
    R, slow = drawn(1e3, 1e5), drawn(0.01, 0.2)
    values = {"R": (R, "ohm", True), "C": (slow / R, "F", True)}
    terms = {"c": ["c"], "i": ["u/R", "-c/R"]}
    return Plant({"c": "V"}, {"u": "V"}, values, {"c": "(u - c)/(R*C)"}, terms, slow, 0.0, 5.0, (0.0,))


NAMES = ("motor", "cart", "strut", "pendulum", "tank", "rc")


def motion(p: Plant, values: Sequence[float], u: Array, period: float, first: bool, starts: Mapping[int, Array]) -> Array:
    """States (T, nx) at the samples, by Heun steps of 1/FINE of a sample; starts: sample → the state put there."""
    rate = p.compiled("[" + ", ".join(p.derivative[x] for x in p.states) + "]")
    h, x, out = period / FINE, np.array(starts[0], dtype=np.float64), np.empty((len(u), len(p.states)))
    given, ahead = [float(v) for v in values], np.append(u[1:], u[-1]) if first else u
    for k, (a, b) in enumerate(zip(u.tolist(), ahead.tolist(), strict=True)):
        z = [float(v) for v in starts.get(k, x)]
        out[k] = z
        for j in range(FINE):
            one = rate(*given, *z, a + (b - a) * j / FINE)
            then = [v + h * d for v, d in zip(z, one, strict=True)]
            two = rate(*given, *then, a + (b - a) * (j + 1) / FINE)
            z = [v + 0.5 * h * (c + d) for v, c, d in zip(z, one, two, strict=True)]
        x = np.array(z)
    return out


def shown(p: Plant, view: Sequence[str], values: Sequence[float], x: Array, u: Array) -> Array:
    return np.stack([p.compiled(p.outputs[y])(*values, *x.T, u) + 0 * u for y in view], axis=1)


def misfit(kind: str, p: Plant, y: str, values: Sequence[float], x: Array, u: Array, period: float) -> Array | None:
    """What is added to an output (T,), of any size; None where its equation has no such term."""
    z, whole = x[:, -1] - x[:, -1].mean(), shown(p, [y], values, x, u)[:, 0]
    terms = [p.compiled(t)(*values, *x.T, u) + 0 * u for t in p.terms[y]]
    least = min(terms, key=lambda t: float(np.std(t)))
    s = (u - u.mean()) / u.std()
    laws: dict[str, Callable[[], Array | None]] = {
        "scale": lambda: whole,
        "offset": lambda: np.ones(len(u)),
        "term missing": lambda: -least if len(terms) > 1 else None,
        "term turned": lambda: -2 * least if len(terms) > 1 else None,
        "square": lambda: (z / z.std()) ** 2,
        "cube": lambda: (z / z.std()) ** 3,
        "kink": lambda: np.abs(s),
        "dry": lambda: np.tanh(20 * s),
        "product": lambda: s * z / z.std(),
        "lag": lambda: np.asarray(lfilter([0.1], [1, -0.9], s)),
        "play": lambda: _play(z, 0.3 * float(z.std())),
    }
    return laws[kind]()


def _play(z: Array, half: float) -> Array:
    at, out = float(z[0]), []
    for value in z.tolist():
        at = min(max(at, value - half), value + half)
        out.append(value - at)
    return np.array(out)


@final
@dataclass(frozen=True)
class Case:
    """u (T,), y (T, ny) with noise of σ (ny,); remains: what is left of the misfit, in σ, once all else is refitted."""

    plant: Plant
    name: str
    wave: str
    period: float
    stated: Array
    view: tuple[str, ...]
    u: Array
    y: Array
    sigma: Array
    colour: float
    first: bool
    kind: str
    site: str
    remains: float

    def model(self) -> gc.Model:
        p, stated = self.plant, dict(zip(self.plant.values, self.stated.tolist(), strict=True))
        loose = {n: {"tolerance": "3 %"} if rough else {} for n, (_, _, rough) in p.values.items()}
        values = {n: {"value": f"{stated[n]!r} {unit}", **loose[n]} for n, (_, unit, _) in p.values.items()}
        said = {"states": dict(p.states), "inputs": dict(p.inputs), "parameters": values, "derivative": dict(p.derivative)}
        return sit.model({"kind": "equations", **said, "outputs": p.outputs, "period": f"{self.period!r} s"})

    def recording(self) -> gc.Recording:
        named = {n: self.y[:, j] for j, n in enumerate(self.view)} | {next(iter(self.plant.inputs)): self.u}
        return gc.Recording.of(np.arange(len(self.u)) * self.period, named, hold="first" if self.first else "zero")


def case(part: str, seed: int, index: int, planted: bool) -> Case:
    """Kinds in turn, in plants as they come; drawn again until the misfit cannot hide."""
    rng = generator(part, seed, index)
    while True:
        made = _drawn(str(rng.choice(NAMES)), KINDS[index % len(KINDS)] if planted else "", rng)
        if made is not None and (not planted or made.remains > LOUD):
            return made


def _drawn(name: str, kind: str, rng: np.random.Generator) -> Case | None:
    p, excitation, first = plant(name, rng), str(rng.choice(["steps", "multisine", "chirp"])), bool(rng.random() < 0.5)
    period = float(f"{p.slow / rng.uniform(8, 30):.2g}")
    count = int(rng.integers(1200, 2400))
    u = p.middle + p.peak * rng.uniform(0.5, 1) * wave(excitation, count, period, (p.slow, p.slow / 2), rng)
    true = np.array([v for v, _, _ in p.values.values()])
    loose = [j for j, (_, _, rough) in enumerate(p.values.values()) if rough]
    stated = true.copy()
    stated[loose] *= 1 + 0.01 * rng.uniform(-1, 1, len(loose))
    first = first and excitation != "steps"
    x = motion(p, true.tolist(), u, period, first, {0: np.array(p.rest)})
    last = list(p.outputs)[-1] if name != "tank" else str(rng.choice(["n", "o"]))
    site = last
    view = (last,) if rng.random() < 0.3 else (next(iter(p.outputs)), last)
    clean = shown(p, view, true.tolist(), x, u)
    rho = float(rng.choice([0, 0, 0, 0.5, 0.8]))
    sigma = np.exp(rng.uniform(math.log(0.001), math.log(0.05))) * clean.std(axis=0)
    noise = np.stack([coloured(count, rho, rng) for _ in view], axis=1)
    noise *= sigma / noise.std(axis=0)
    remains, column = 0.0, view.index(site)
    if kind:
        law = misfit(kind, p, site, true.tolist(), x, u, period)
        if law is None or not np.isfinite(law).all() or np.std(law) + abs(np.mean(law)) == 0:
            return None
        size = math.exp(rng.uniform(math.log(2.0), math.log(40.0))) * sigma[column] / math.sqrt(float(np.mean(law**2)))
        law = law if kind.startswith("term") else law * size
        clean[:, column] += law
        remains = _remains(p, view, true, loose, x, u, period, first, law, sigma, column)
    return Case(
        p, name, excitation, period, stated, view, u, clean + noise, sigma, rho, first, kind, site if kind else "", remains
    )


def _remains(
    p: Plant,
    view: Sequence[str],
    true: Array,
    loose: Sequence[int],
    x: Array,
    u: Array,
    period: float,
    first: bool,
    law: Array,
    sigma: Array,
    column: int,
) -> float:
    """Root mean square, in σ, of what changes of parameters, by up to REACH of them, and of starts leave of a misfit."""
    count = round(FITTED * len(u))
    x, u, law = x[:count], u[:count], law[:count]
    at = np.linspace(0, count, WINDOWS, endpoint=False).astype(int).tolist()
    starts = {k: x[k] for k in at}
    plain = shown(p, view, true.tolist(), motion(p, true.tolist(), u, period, first, starts), u)
    columns = []
    for j in loose:
        moved = true.copy()
        moved[j] *= 1.0001
        y = shown(p, view, moved.tolist(), motion(p, moved.tolist(), u, period, first, starts), u)
        columns.append(((y - plain) / sigma / 1e-4).ravel())
    owner = np.searchsorted(at, np.arange(count), side="right") - 1
    for i in range(x.shape[1]):
        nudge = 1e-4 * max(float(x[:, i].std()), 1e-9)
        y = shown(
            p,
            view,
            true.tolist(),
            motion(p, true.tolist(), u, period, first, {k: s + nudge * (np.arange(len(s)) == i) for k, s in starts.items()}),
            u,
        )
        slope = (y - plain) / sigma * 1e4
        columns += [np.where((owner == w)[:, None], slope, 0.0).ravel() for w in range(len(at))]
    target = np.zeros_like(plain)
    target[:, column] = law / sigma[column]
    A = np.stack(columns, axis=1)
    size = np.linalg.norm(A, axis=0) + 1e-300
    reach = np.where(np.arange(len(size)) < len(loose), REACH * size, np.inf)
    found = lsq_linear(A / size, target.ravel(), (-reach, reach)).x
    left = target.ravel() - A / size @ found
    return float(np.sqrt(np.mean(left.reshape(plain.shape)[:, column] ** 2)))


def ask(part: str, seed: int, index: int, limit: float, planted: bool) -> Record:
    c = case(part, seed, index, planted)
    asked = {
        "part": part,
        "seed": seed,
        "index": index,
        "plant": c.name,
        "excitation": c.wave,
        "period": c.period,
        "channels": list(c.view),
        "colour": c.colour,
        "dirt": [],
        "engine": None,
        "hold": "first" if c.first else "zero",
        "noise": [float(f"{s:.3g}") for s in c.sigma],
        "hidden": [{"effect": c.kind, "site": c.site, "numbers": {}}] if planted else [],
        "label": "clear",
        "strength": round(c.remains, 3),
        "remains": round(c.remains, 3),
        "classes": [],
    }
    model, recording = c.model(), c.recording()

    def answered() -> Record:
        found = gc.diagnose(model, recording)
        true = dict(zip(c.view, c.sigma, strict=True))
        return sit.answer(found) | {"floors": {n: round(float(m.noise_floor / true[n]), 2) for n, m in found.residual.items()}}

    return asked | sit.timed(answered, limit)
