"""The exam in plants of another hand: cases drawn from (seed, part, index) alone, asked and judged.

A case is clear if rollouts of the longest horizon change by 5 noise floors or more, and, once parameters and starts have been
refitted without the effect, one at least remains, root mean square, or parameters are five tolerances off, all in all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, final

import numpy as np

import gapcert as gc
from exams import sit
from exams.hidden.draw import generator
from exams.hidden.laws import Hidden
from exams.hidden.log import coloured
from exams.hidden.plain import NAMES, RUN, STEPS, WINDOW, Plant, Rig, plant
from exams.hidden.truth import SAME
from gapcert.numerics.arrays import Array

CLEAR, LEFT, STRONGEST, TOLERANCES = 5.0, 1.0, 40.0, 5.0
KINDS = (
    "viscous-friction",
    "coulomb-friction",
    "quadratic-drag",
    "external-push",
    "input-gain",
    "input-offset",
    "input-dead-zone",
    "input-dead-zone:uneven",
    "input-saturation",
    "input-saturation:soft",
    "input-delay",
    "input-lag",
    "input-rate-limit",
    "supply-sag",
    "sensor-bias",
    "sensor-scale",
    "sensor-delay",
    "parameter",
    "input-gain:slip",
    "sensor-scale:slip",
)
LATER, FIRST = ("sensor-lag",), 400  # more in turn would draw every exam anew: these are drawn from that index on
ALIKE = (*KINDS[:3], *KINDS[5:7], *KINDS[8:14])  # with rivals that an input tells apart
UNSLIPPED = tuple(k for k in KINDS if not k.endswith(":slip"))
TURNED = (math.pi / 180, 60 / (2 * math.pi), 1000.0, 9.80665)
SLIPS = (*TURNED, *(1 / s for s in TURNED))
WAVES = ("steps", "multisine", "chirp", "feedback")
POOR = ("sine", "one way", "one level")  # under which laws look alike
LOOPED = tuple(n for n in NAMES if n != "strut")  # plants of which an output is controlled
LAST = 0.75  # share of a single record that takes part in the fit
MOST = 60  # rollouts that judge a case


def wave(kind: str, count: int, period: float, times: tuple[float, float], rng: np.random.Generator) -> Array:
    """(count,) within ±1; times: slowest and fastest time constants."""
    t, slow, fast = np.arange(count) * period, times[0], max(times[1], 2 * period)
    if kind == "multisine":
        f = np.exp(rng.uniform(math.log(0.03 / slow), math.log(0.25 / fast), 10))
        w = np.sin(2 * np.pi * f[:, None] * t + rng.uniform(0, 2 * np.pi, (10, 1))).sum(axis=0)
    elif kind in POOR:
        s = np.sin(2 * np.pi * (rng.uniform(0.03, 0.12) / slow * t + rng.random()))
        swing, ramp = rng.uniform(0.1, 0.4), np.minimum(t / (5 * slow), 1)
        w = {"sine": s, "one way": (1 + swing * s) * ramp, "one level": np.floor(1 + 3 * t / (count * period)) / 3}[kind]
    elif kind == "chirp":
        low, high, long = 0.03 / slow, 0.2 / fast, max(count * period / 2, 10 * slow)
        s = t % long
        w = np.sin(2 * np.pi * (low * s + (high - low) * s**2 / (2 * long)))
    else:
        holds = rng.uniform(0.5, 4, count) * slow
        level = rng.uniform(0.3, 1, count) * rng.choice([-1, 1], count)
        w = level[np.searchsorted(np.cumsum(holds), t, side="right")]
    return np.asarray(w / np.abs(w).max())


def rig(p: Plant, kind: str, rng: np.random.Generator) -> Rig:
    """A plant under an input, with noise of 0.1 to 3 % of each output's deviation."""
    slow, fast = p.times
    least, most = (1.0, 10.0) if slow > 20 else (0.001, 0.02)
    period = float(f"{min(max(slow / rng.uniform(8, 40), least), most, 4 * fast if p.name == 'motor' else 2 * fast):.2g}")
    short = 0.03 < slow <= 0.4 and rng.random() < 0.3
    runs = int(rng.integers(20, 41)) if short else 1
    seconds = rng.uniform(1, 2) if short else min(max(rng.uniform(30, 80) * slow, 1200 * period), 4000 * period)
    period = max(period, float(f"{seconds / 400:.2g}")) if short else period
    each = round(seconds / period)
    count = runs * each
    sub = max(STEPS, math.ceil(STEPS * period / fast))
    driven = kind if kind != "feedback" else str(rng.choice(["steps", "multisine"]))
    w = np.concatenate([wave(driven, each, period, p.times, rng) for _ in range(runs)])
    tolerance, loose = float(rng.choice([0.02, 0.03])), np.array([rough for _, _, rough in p.values.values()])
    true = np.array([v for v, _, _ in p.values.values()])
    stated = true * (1 + 0.01 * rng.uniform(-1, 1, len(true)) * loose)
    # A controller sees what it is to hold.
    views = [v for v in p.views if kind != "feedback" or p.shown[0] in v]
    view = views[int(rng.integers(len(views)))]
    law, reference = np.array([0.0, 0, 0, p.middle, 0, -1]), np.zeros(count)
    middle, peak = p.middle, p.peak * rng.uniform(0.5, 1)
    if kind == "feedback":
        column = 0
        integral, rate = ((0, 0), (1, 0), (1, 0.05))[int(rng.integers(3))]
        # What lies behind the slow pole bounds the loop.
        behind = 0.1 if len(p.states) > 1 else 1.0
        gain = behind * rng.uniform(0.7, 4) / p.loop
        law = np.array([gain, integral * gain / slow, rate * behind * gain * slow, middle, 3 * p.peak, column])
        reference = p.rest[column] + 0.6 * peak * p.loop * w
    starts = np.tile(np.array(p.rest, dtype=np.float64), (runs, 1))
    begins = np.zeros(count, dtype=np.int64)
    begins[::each] = RUN
    horizon = float(f"{min(3 * slow, each * period / (3 if short else 10)):.2g}")
    rho = float(rng.choice([0, 0, 0, 0.5, 0.8]))
    noise = np.stack([coloured(count, rho, rng) for _ in p.shown], axis=1)
    made = Rig(
        p,
        true,
        stated,
        tolerance,
        period,
        sub,
        middle + peak * w,
        reference,
        law,
        0 * noise,
        begins,
        starts,
        view,
        horizon,
        kind + (f", {runs} runs" if short else ""),
        p.hold,
        rho,
    )
    sigma = math.exp(rng.uniform(math.log(0.001), math.log(0.03))) * np.std(made.play()[1], axis=0)
    return replace(made, noise=noise * sigma)


@final
@dataclass(frozen=True)
class Case:
    """strength: change of rollouts in σ; remains: what refitting leaves of it."""

    part: str
    seed: int
    index: int
    rig: Rig
    hidden: tuple[Hidden, ...]
    label: str
    strength: float = 0.0
    remains: float = 0.0

    def recording(self) -> gc.Recording:
        r = self.rig
        _, y, u = r.play(self.hidden)
        shown, each = y + r.noise, np.flatnonzero(r.begins == RUN)
        rows = np.split(np.arange(len(u)), each[1:])
        named = {n: shown[:, j] for n, j in zip(r.view, r.columns, strict=True)} | {next(iter(r.plant.inputs)): u}
        runs = [gc.Recording.of(np.arange(len(k)) * r.period, {n: v[k] for n, v in named.items()}, hold=r.hold) for k in rows]
        trajectories = tuple(replace(one.trajectories[0], name=f"run {i}") for i, one in enumerate(runs))
        return replace(runs[0], trajectories=trajectories)

    @cached_property
    def judge(self) -> Judge:
        return Judge(self.rig, self.hidden)

    def given(self, u: Array, start: Array, held: float, salt: int) -> Case:
        """The same machine from another start and held input, under another input (T, nu), with fresh noise of its kind."""
        r, count, rng = self.rig, len(u), generator(self.part, self.seed, self.index, salt)
        noise = np.stack([coloured(count, r.colour, rng) for _ in r.plant.shown], axis=1) * r.noise.std(axis=0)
        begins = np.where(np.arange(count) == 0, RUN, 0).astype(np.int64)
        more = {"reference": np.zeros(count), "law": np.array([0.0, 0, 0, held, 0, -1]), "starts": start[None]}
        return replace(self, rig=replace(r, u=u[:, 0], noise=noise, begins=begins, **more))

    def question(self) -> dict[str, Any]:
        r = self.rig
        return {
            "part": self.part,
            "seed": self.seed,
            "index": self.index,
            "plant": r.plant.name,
            "excitation": r.excitation,
            "period": r.period,
            "samples": len(r.u),
            "horizon": r.horizon,
            "channels": list(r.view),
            "hold": r.hold,
            "dirt": [],
            "engine": None,
            "tolerance": r.tolerance,
            "colour": r.colour,
            "noise": [float(f"{s:.3g}") for s in r.noise.std(axis=0)[r.columns]],
            "hidden": [{"effect": h.effect, "site": h.site, "numbers": sit.plain(h.numbers)} for h in self.hidden],
            "label": self.label,
            "strength": round(self.strength, 3),
            "remains": round(self.remains, 3),
            "classes": [[list(k) for k in alike(r, h)] for h in self.hidden],
        }


def alike(r: Rig, h: Hidden) -> list[tuple[str, str]]:
    """The effect and its equals by the structure of the plant, as seen through what is measured: of these any is right.

    Gains of a plant that is linear in its input and output, constants that shift its rest, delays and lags of its one way
    through, friction that a stated parameter is; each only with one output measured, where more would tell them apart.
    """
    name, (u,), alone = r.plant.name, tuple(r.plant.inputs), len(r.view) == 1
    linear = name in ("motor", "wheel", "rc", "rlc", "twin")
    y, groups = r.view[0], list[set[tuple[str, str]]]()
    if alone and (linear or name == "strut"):
        gains = {("input-gain", u), ("sensor-scale", y)} if linear else set()
        groups += [gains | ({("parameter", "K")} if name == "wheel" else set())]
    if alone:
        groups += [{("input-delay", u), ("sensor-delay", y)}]
    if alone and (linear or name in ("heater", "oven")):
        groups += [{("input-lag", u), ("sensor-lag", y)}]
    if alone and (linear or name in ("heater", "oven")):
        # A constant twist between two speeds shows in neither, and a constant voltage at a condenser not in its current.
        unseen = {"tw", *(("i",) if (name, y) == ("rlc", "i") else ())}
        shifts = {("constant-force", s) for s in r.plant.states if s not in unseen} | {("sensor-bias", y)}
        groups += [shifts | (set() if "i" in unseen else {("input-offset", u)})]
    first = {"motor": "i", "wheel": "v", "heater": "T", "tank": "h", "rc": "vc", "rlc": "i", "twin": "w1"}
    first = (first | {"tanks": "h1", "oven": "T1"}).get(name)
    if first:
        groups += [{("input-offset", u), ("constant-force", first)}]
    friction = {"motor": [("w", "b"), ("i", "R")], "twin": [("w1", "b")], "rlc": [("i", "R")], "rc": [("vc", "R"), ("vc", "C")]}
    groups += [{("viscous-friction", s), ("parameter", b)} for s, b in friction.get(name, [])]
    if name == "rc":
        groups += [{("parameter", "R"), ("parameter", "C")}]
    if name == "wheel":
        groups += [{("input-saturation", u), ("wheel-slip", "v")}]
    if name == "cylinder":
        groups += [{("input-gain", u), ("parameter", "k")}]
    return [h.key, *sorted({k for g in groups if h.key in g for k in g} - {h.key})]


@final
class Judge:
    """What rollouts of the longest horizon from free starts say without noise, in σ, about effects that could be there."""

    def __init__(self, r: Rig, effects: Sequence[Hidden]) -> None:
        self.rig = r
        self.x, self.y, self.u = r.play(effects)
        self.sigma = r.noise.std(axis=0)[r.columns]
        length = max(2, round(r.horizon / r.period))
        self.begins, runs = r.begins.copy(), np.flatnonzero(r.begins == RUN)
        ends = [*runs[1:], len(self.u)]
        for first, end in zip(runs, ends, strict=True):
            for k in range(first + length, end - length + 1, length):
                self.begins[k] = WINDOW
        # What is held out is nobody's evidence; of many runs the first ones say enough.
        many = np.flatnonzero(self.begins)[MOST:]
        count = round(LAST * len(self.u)) if len(runs) == 1 or not len(many) else int(many[0])
        self.x, self.y, self.u, self.begins = (a[:count] for a in (self.x, self.y, self.u, self.begins))
        self.rows, self.at = np.arange(count), np.flatnonzero(self.begins)
        self.thin = max(1, len(self.rows) // 3000)

    def misfit(self, effects: Sequence[Hidden], p: Array, starts: Array, before: Array | None = None) -> Array:
        y = self.rig.replay(effects, p, self.u, self.begins, starts, before)
        return np.asarray((y - self.y)[:, self.rig.columns] / self.sigma)

    def strength(self) -> float:
        return _largest(self.misfit((), self.rig.true, self.x[self.at]))

    def fit(self, effects: Sequence[Hidden] = (), steps: int = 8, past: bool = False) -> tuple[float, float, float]:
        """(cost, what parameters pay of it, largest RMS) once numbers, parameters and starts have been refitted.

        past: and what was commanded before each run, which no log tells.
        """
        r, nx = self.rig, self.x.shape[1]
        runs = np.flatnonzero(self.begins == RUN) if past else np.empty(0, dtype=int)
        within, size = np.searchsorted(runs, self.rows, side="right") - 1, max(float(np.std(self.u)), 1e-9)
        loose = [j for j, (_, _, rough) in enumerate(r.plant.values.values()) if rough]
        keys = [(i, n) for i, h in enumerate(effects) for n in h.numbers if n != "soft"]
        freed = {list(r.plant.values).index(h.site) for h in effects if h.effect == "parameter"}
        loose = [j for j in loose if j not in freed]
        scale = np.maximum(np.std(self.x, axis=0), 1e-9)
        sizes = np.array([v if abs(v) > 1e-9 else 1e-9 for v in (effects[i].numbers[n] for i, n in keys)])
        owner = np.searchsorted(self.at, self.rows, side="right") - 1
        weight = 1 / (r.tolerance * np.abs(r.stated[loose]))

        def parts(z: Array) -> tuple[tuple[Hidden, ...], Array, Array, Array | None]:
            numbers = [dict(h.numbers) for h in effects]
            for (i, n), s, v in zip(keys, sizes, z, strict=False):
                numbers[i][n] = float(s * v)
            p, starts = r.true.copy(), self.x[self.at].copy()
            p[loose] = r.stated[loose] + z[len(keys) : len(keys) + len(loose)] / weight
            starts += z[few:own_past].reshape(-1, nx) * scale
            before = r.plant.middle + size * z[own_past:] if past else None
            return tuple(replace(h, numbers=m) for h, m in zip(effects, numbers, strict=True)), p, starts, before

        def rest(z: Array) -> Array:
            with np.errstate(all="ignore"):
                out = self.misfit(*parts(z))
            out = np.nan_to_num(out, nan=1e6, posinf=1e6, neginf=-1e6)
            # As coloured noise would be made white: in slow noise, slow differences count less.
            out[1:] = (out[1:] - r.colour * out[:-1]) / math.sqrt(1 - r.colour**2)
            return out

        def cost(e: Array, z: Array) -> float:
            own = z[len(keys) : len(keys) + len(loose)]
            return float((e**2).sum() + own @ own)

        few = len(keys) + len(loose)
        own_past = few + nx * len(self.at)
        z = np.concatenate([np.ones(len(keys)), (r.true - r.stated)[loose] * weight, np.zeros(own_past - few + len(runs))])
        e, damp = rest(z), 1e-6
        best = cost(e, z)
        for _ in range(steps):
            J = np.zeros((*e.shape, len(z)))
            for j in range(few):
                J[..., j] = (rest(z + 1e-4 * (np.arange(len(z)) == j)) - e) / 1e-4
            for i in range(nx):
                moved = z.copy()
                moved[few + i : own_past : nx] += 1e-4
                J[np.arange(len(e)), :, few + nx * owner + i] = (rest(moved) - e) / 1e-4
            if past:
                moved = z.copy()
                moved[own_past:] += 1e-4
                J[np.arange(len(e)), :, own_past + within] = (rest(moved) - e) / 1e-4
            A = J[:: self.thin].reshape(-1, len(z))
            own = np.zeros(len(z))
            own[len(keys) : few] = 1 / math.sqrt(self.thin)
            H = A.T @ A + np.diag(own**2)
            g = A.T @ e[:: self.thin].reshape(-1) + own**2 * z
            before = best
            for _ in range(5):
                step = np.linalg.solve(H + damp * np.diag(np.diag(H) + 1e-9), -g)
                tried = rest(z + step)
                if (now := cost(tried, z + step)) < best:
                    z, e, best, damp = z + step, tried, now, 0.1 * damp
                    break
                damp = max(30 * damp, 1e-4)
            if best > before * (1 - 1e-3):
                break
        return best, float(z[len(keys) : few] @ z[len(keys) : few]), _largest(self.misfit(*parts(z)))

    @property
    def own(self) -> float:
        """Cost of the truth: how far its parameters are from the stated ones."""
        off = (self.rig.true / self.rig.stated - 1) / self.rig.tolerance
        return float(off @ off)

    def stands(self, said: Sequence[Hidden], numbers: int) -> tuple[bool, float]:
        """(do other effects, refitted, fit as well as the truth, which has so many numbers?, the cost that they have more)."""
        spared = max(0, numbers - sum(len(h.numbers) for h in said))
        excess = self.fit(said, 40, True)[0] - self.own
        return excess <= SAME + spared * math.log(len(self.rows) * len(self.sigma)), excess


def _largest(r: Array) -> float:
    return float(np.sqrt(np.mean(r**2, axis=0)).max())


def shape(kind: str, site: str, r: Rig, rng: np.random.Generator, still: tuple[Array, Array, Array]) -> tuple[Any, float]:
    """(strength → numbers, the most): everything drawn but the strength."""
    effect, _, form = kind.partition(":")
    x, y, u = still
    p, slow = r.plant, r.plant.times[0]
    sign, part = float(rng.choice([-1, 1])), float(rng.uniform(0.1, 0.6))
    size, peak = float(np.std(u)), float(np.abs(u).max())
    one, two = (1.0, float(rng.uniform(-0.2, 0.7)))[:: int(sign)]
    stretch = float(rng.uniform(0.3, 3)) * slow
    if effect == "parameter":
        value = r.true[list(p.values).index(site)]
        return lambda k: {"value": float(value * (1 + k if sign > 0 else 1 / (1 + k)))}, 0.6
    if form == "slip":
        slip = SLIPS[int(rng.integers(len(SLIPS)))]
        return lambda k: {effect.split("-")[1]: slip}, 1.0
    if effect in ("viscous-friction", "coulomb-friction", "quadratic-drag", "external-push"):
        column = x[:, tuple(p.states).index(site)]
        v, f = float(np.sqrt(np.mean(column**2))), float(max(np.std(column), 1e-3 * np.abs(column).max())) / slow
        if effect == "external-push":
            when, long = part * LAST * len(u) * r.period, float(rng.uniform(0.3, 2)) * slow
            return lambda k: {"force": sign * k * f, "time": when, "duration": long}, 10.0
        law = {
            "viscous-friction": {"coefficient": f / v},
            "coulomb-friction": {"level": f},
            "quadratic-drag": {"coefficient": f / v**2},
        }
        return lambda k: {n: k * s for n, s in law[effect].items()}, 0.8 if effect == "coulomb-friction" else 3.0
    swing = float(np.std(y[:, p.shown.index(site)])) if effect.startswith("sensor") else 1.0
    late = 12 * r.period
    ramp = 4 * r.period + 0.3 * slow
    shapes: Mapping[str, tuple[Any, float]] = {
        "input-gain": (lambda k: {"gain": 1 + k if sign > 0 else 1 / (1 + k)}, 0.8),
        "input-offset": (lambda k: {"offset": sign * k * size}, 1.0),
        "input-dead-zone": (lambda k: {"width": k * size}, 1.0),
        "input-dead-zone:uneven": (lambda k: {"minus": one * k * size, "plus": two * k * size}, 1.0),
        "input-saturation": (lambda k: {"level": peak / (1 + k)}, 4.0),
        "input-saturation:soft": (lambda k: {"level": peak / k, "soft": 1.0}, 3.0),
        "input-delay": (lambda k: {"delay": k * late}, 1.0),
        "input-lag": (lambda k: {"time_constant": k * slow}, 1.0),
        "input-rate-limit": (lambda k: {"rate": 2 * peak / (k * ramp)}, 5.0),
        "supply-sag": (lambda k: {"sag": k / peak, "time_constant": stretch}, 0.8),
        "sensor-bias": (lambda k: {"bias": sign * k * swing}, 1.0),
        "sensor-scale": (lambda k: {"scale": 1 + k if sign > 0 else 1 / (1 + k)}, 0.5),
        "sensor-delay": (lambda k: {"delay": k * late}, 1.0),
        "sensor-lag": (lambda k: {"time_constant": k * slow}, 1.0),
    }
    return shapes[kind]


def places(kind: str, p: Plant, view: Sequence[str]) -> tuple[str, ...]:
    effect = kind.partition(":")[0]
    if effect == "parameter":
        return tuple(n for n, (_, _, rough) in p.values.items() if rough)
    if effect == "external-push":
        return p.pushed
    # A one-sided input, and one about a middle far from zero, cannot have what acts at zero.
    if p.name in ("heater", "tank", "tanks", "oven") and kind.startswith(("input-dead-zone", "input-saturation:soft")):
        return ()
    return (
        tuple(view) if effect.startswith("sensor") else tuple(p.inputs) if effect.startswith(("input", "supply")) else p.sites
    )


def doubtful(part: str, seed: int, index: int) -> Case:
    """One effect, kinds in turn, in a short noisy log of a single poor input, where several may look alike."""
    rng, kind, case = generator(part, seed, index), ALIKE[index % len(ALIKE)], None
    for k in range(1000):
        if k >= 20 and case is not None:
            break
        p = plant(str(rng.choice(NAMES)), rng)
        r = rig(p, str(rng.choice(POOR)), rng)
        if not (sites := places(kind, p, r.view)) or "runs" in r.excitation:
            continue
        n = int(rng.integers(600, 1000))
        short = {name: getattr(r, name)[:n] for name in ("u", "reference", "noise", "begins")}
        short["noise"] = short["noise"] * (rng.uniform(0.01, 0.04) * np.std(r.play()[1]) / r.noise.std(axis=0).max())
        r = replace(r, **short, hold="zero", horizon=float(f"{min(r.horizon, n * r.period / 12):.2g}"))
        at, most = shape(kind, site := str(rng.choice(sites)), r, rng, r.play())
        case, _ = _reached(Case(part, seed, index, r, (), "hidden"), Hidden(kind.partition(":")[0], site, {}), at, most, rng)
        if case.label == "clear":
            break
    assert case is not None
    return case


def nothing(part: str, seed: int, index: int, waves: Sequence[str] = WAVES) -> Case:
    names = NAMES if waves == WAVES else LOOPED
    rng = generator(part, seed, index)
    return Case(part, seed, index, _drawn(names[index % len(names)], rng, waves), (), "nothing")


def _drawn(name: str, rng: np.random.Generator, waves: Sequence[str] = WAVES) -> Rig:
    p = plant(name, rng)
    return rig(p, str(rng.choice([w for w in waves if w != "feedback" or p.loop])), rng)


def single(part: str, seed: int, index: int, waves: Sequence[str] = WAVES) -> Case:
    """One effect, kinds in turn, in a plant that can have it; drawn again until it is clear."""
    rng, kinds, best = generator(part, seed, index), KINDS if waves == WAVES else UNSLIPPED, None
    kinds = kinds if index < FIRST else LATER
    kind, names = kinds[index % len(kinds)], NAMES if waves == WAVES else LOOPED
    for _ in range(40):
        r = _drawn(str(rng.choice(names)), rng, WAVES[:3] if kind.endswith(":slip") else waves)
        case = _hiding(Case(part, seed, index, r, (), "hidden"), kind, rng)
        if case is not None and case.label == "clear":
            return case
        best = case if best is None or (case is not None and case.strength > best.strength) else best
    assert best is not None
    return best


def pair(part: str, seed: int, index: int) -> Case:
    """Two effects, each clear alone; with the other refitted, one noise floor remains of each, or parameters are off."""
    rng, best = generator(part, seed, index), None
    for _ in range(60):
        case = Case(part, seed, index, _drawn(str(rng.choice(NAMES)), rng), (), "hidden")
        a, b = (_hiding(case, kind, rng) for kind in (UNSLIPPED[index % len(UNSLIPPED)], str(rng.choice(UNSLIPPED))))
        if a is None or b is None or a.label != "clear" or b.label != "clear":
            continue
        one, two = a.hidden[0], b.hidden[0]
        if two.key in alike(case.rig, one):
            continue
        judge = Judge(case.rig, (one, two))
        left = [judge.fit((other,)) for other in (two, one)]
        clear = all(remains >= LEFT or paid >= TOLERANCES**2 for _, paid, remains in left)
        label, remains = "clear" if clear else "hidden", min(remains for _, _, remains in left)
        best = replace(case, hidden=(one, two), label=label, strength=judge.strength(), remains=remains)
        if clear:
            return best
    assert best is not None
    return best


def _hiding(case: Case, kind: str, rng: np.random.Generator) -> Case | None:
    """The case with an effect of that kind at a site that is drawn; None where its plant cannot have one."""
    r, effect = case.rig, kind.partition(":")[0]
    sites = places(kind, r.plant, r.view)
    if not sites or (effect == "external-push" and "runs" in r.excitation):
        return None
    site, still = str(rng.choice(sites)), r.play()
    at, most = shape(kind, site, r, rng, still)
    if kind.endswith(":slip"):
        slip = next(iter(at(1.0).values()))
        if effect == "input-gain":
            r = replace(r, u=r.u / slip)
        else:
            r = replace(r, noise=r.noise * np.where(np.array(r.plant.shown) == site, slip, 1.0))
    return _sized(replace(case, rig=r), Hidden(effect, site, {}), at, most, rng)


def looped(part: str, seed: int, index: int) -> Case:
    """Under feedback: one effect, or in every fifth case nothing."""
    if index % 5 < 4:
        return single(part, seed, index, WAVES[3:])
    return replace(nothing(part, seed, index // 5, WAVES[3:]), index=index)


def _reached(case: Case, h: Hidden, at: Any, most: float, rng: np.random.Generator) -> tuple[Case, float]:
    """The effect at a strength drawn between CLEAR and STRONGEST, or the most that it can have; and its size."""
    target = math.exp(rng.uniform(math.log(1.1 * CLEAR), math.log(STRONGEST)))

    @cache
    def strength(k: float) -> float:
        return Judge(case.rig, (Hidden(*h.key, at(k)),)).strength()

    low, high, size = math.log(1e-4 * most), math.log(most), most
    if strength(most) > target and at(most) != at(low):
        for _ in range(10):
            middle = 0.5 * (low + high)
            value = strength(math.exp(middle))
            low, high = (low, middle) if value >= target else (middle, high)
            if abs(value / target - 1) < 0.05:
                break
        size = math.exp(high)
    found = strength(size)
    label = "clear" if np.isfinite(found) and found >= CLEAR else "hidden"
    return replace(case, hidden=(Hidden(*h.key, at(size)),), label=label, strength=found), size


def _sized(case: Case, h: Hidden, at: Any, most: float, rng: np.random.Generator) -> Case:
    """As `_reached`, and larger where refitting would hide it."""
    reached, size = _reached(case, h, at, most, rng)
    if (
        reached.strength > 2 * STRONGEST
    ):  # it jumps with the size, as where a run begins: no size of it is one that was asked for
        return replace(reached, label="hidden")
    while True:
        judge = Judge(case.rig, (Hidden(*h.key, at(size)),))
        strength, (_, paid, remains) = judge.strength(), judge.fit()
        seen = remains >= LEFT or paid >= TOLERANCES**2
        if size >= most or seen or strength < CLEAR:
            break
        size = min(1.5 * size, most)
    clear = np.isfinite(strength) and strength >= CLEAR and seen
    return replace(
        case, hidden=(Hidden(*h.key, at(size)),), label="clear" if clear else "hidden", strength=strength, remains=remains
    )


def ask(case: Case, limit: float, effects: Any = "all") -> dict[str, Any]:
    """The record of a case; an answer from outside its class is put to the test, and a single cause that fits joins it.

    floors: by channel, the noise floor that was found over the noise that is there.
    """
    r = case.rig
    recording = case.recording()

    def answered() -> dict[str, Any]:
        found = gc.diagnose(sit.model(r.section), recording, effects, horizons=[r.horizon])
        true = dict(zip(r.view, r.noise.std(axis=0)[r.columns], strict=True))
        return sit.answer(found) | {"floors": {n: round(m.noise_floor / true[n], 2) for n, m in found.residual.items()}}

    record = case.question() | sit.timed(answered, limit)
    said = [Hidden(c["effect"], c["site"], c["numbers"]) for c in record.get("causes", [])]
    known = {tuple(k) for c in record["classes"] for k in c}
    if not case.hidden or not said or all(h.key in known for h in said):
        return record | {"stands": False}
    numbers = sum(len([n for n in h.numbers if n != "soft"]) for h in case.hidden)
    try:
        stands, excess = case.judge.stands(said, numbers)
    except (KeyError, ValueError):  # what was named is not among what is simulated here
        return record | {"stands": False}
    record |= {"stands": stands, "excess": round(excess, 1)}
    if stands and len(said) == 1 and sum(len(h.numbers) for h in said) <= numbers:
        record["classes"][0].append(list(said[0].key))
    return record


def unknown(part: str, seed: int, index: int, limit: float) -> dict[str, Any]:
    """With the effect, its equals and everything that contains one of them taken out of the library."""
    case = single(part, seed, index)
    return ask(case, limit, sit.without([list(k) for k in alike(case.rig, case.hidden[0])]))
