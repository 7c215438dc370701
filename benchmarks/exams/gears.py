"""Play in the angle between a motor and its link, of which the log shows one: teeth that are springs and dampers.

The library's law brings a knock to rest within two of its sub-steps; here a tooth gives way and presses back, in steps of its
own. A case counts where the seen angle is left at `LEFT` standard deviations of noise or more once the rigid model's inertia,
friction and the starts of windows have been refitted. Every fourth has no play.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np

import gapcert as gc
from exams import sit
from exams.hidden.draw import generator
from gapcert.numerics.arrays import Array

FINE, LEFT, WINDOW = 60, 2.0, 120


@final
@dataclass(frozen=True)
class Gear:
    """J and b of both together, `share` of them the link's; width of the gap, or 0; side: is the motor (0) seen or the link?"""

    J: float
    b: float
    share: float
    width: float
    side: int
    period: float

    def play(self, u: Array) -> Array:
        """(T, 2): angles of motor and link at the samples, under torques u (T,) on the motor."""
        h, (one, two) = self.period / FINE, ((1 - self.share) * self.J, self.share * self.J)
        meet = one * two / self.J
        # A tooth whose oscillation dies within a sample, critically damped: 3 rad a sample.
        stiff, damped = meet * (3 / self.period) ** 2, 2 * meet * 3 / self.period
        lost, q, v, z, w, out = self.b / self.J, 0.0, 0.0, 0.0, 0.0, []
        for level in u.tolist():
            out.append((q, z))
            for _ in range(FINE):
                apart, half = q - z, 0.5 * self.width
                deep = apart - min(max(apart, -half), half)
                press = stiff * deep + damped * (v - w) if deep or not self.width else 0.0
                # Teeth press and do not pull.
                press = press if press * deep > 0 or not self.width else 0.0
                v, w = v + h * ((level - press) / one - lost * v), w + h * (press / two - lost * w)
                q, z = q + h * v, z + h * w
        return np.array(out)

    def rigid(self, x: Array, u: Array, J: float, b: float) -> Array:
        """Angles (W, L) of the rigid model from states x (W, 2) under u (W, L)."""
        decay = math.exp(-b / J * self.period)
        out, q, v = np.empty(u.shape), x[:, 0], x[:, 1]
        for k in range(u.shape[1]):
            out[:, k], end = q, u[:, k] / b
            q = q + end * self.period + (v - end) * (1 - decay) * J / b
            v = end + (v - end) * decay
        return out


@final
@dataclass(frozen=True)
class Case:
    gear: Gear
    u: Array
    y: Array
    sigma: float
    remains: float
    stated: tuple[float, float]

    def model(self) -> gc.Model:
        values = {
            "J": {"value": f"{self.stated[0]!r} kg*m^2", "tolerance": "10 %"},
            "b": {"value": f"{self.stated[1]!r} N*m*s/rad", "tolerance": "20 %"},
        }
        said = {"coordinates": {"q": "rad"}, "inputs": {"u": "N*m"}, "mass_matrix": [["J"]], "forces": {"q": "u - b*q_dot"}}
        return sit.model({"kind": "equations", **said, "parameters": values, "period": f"{self.gear.period!r} s"})

    def recording(self) -> gc.Recording:
        t = np.arange(len(self.u), dtype=np.float64) * self.gear.period
        return gc.Recording.of(t, {"q": self.y, "u": self.u}, hold="zero")


def case(part: str, seed: int, index: int) -> Case:
    rng = generator(part, seed, index)
    while True:
        made = _drawn(rng, index)
        if index % 4 == 3 or made.remains > LEFT:
            return made


def _drawn(rng: np.random.Generator, index: int) -> Case:
    def spread(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    J, slow, reach = spread(0.003, 0.6), spread(1.5, 5), spread(0.3, 3)
    period, count = float(f"{spread(0.002, 0.01):.2g}"), int(rng.integers(1400, 2400))
    gear = Gear(J, J / spread(0.3, 3), rng.uniform(0.2, 0.65), 0.0, index % 2, period)
    waves = zip(slow * np.array([1, 2.4, 5.5]), (1, 0.7, 0.45), rng.uniform(0, 2 * np.pi, 3), strict=True)
    t = np.arange(count) * period
    u = J * slow**2 * reach * sum(a * np.sin(w * t + p) for w, a, p in waves)
    width = spread(0.01, 0.1) * float(np.ptp(gear.play(u)[:, gear.side])) if index % 4 != 3 else 0.0
    gear = Gear(J, gear.b, gear.share, width, gear.side, period)
    clean = gear.play(u)[:, gear.side]
    moved = width * (gear.share, 1 - gear.share)[gear.side]
    sigma = moved / spread(10, 100) if width else spread(1e-4, 1e-3) * float(np.std(clean))
    y = clean + sigma * rng.standard_normal(count)
    stated = J * (1 + 0.05 * rng.uniform(-1, 1)), gear.b * (1 + 0.1 * rng.uniform(-1, 1))
    return Case(gear, u, y, sigma, _remains(gear, clean, u, sigma), stated)


def _remains(gear: Gear, clean: Array, u: Array, sigma: float) -> float:
    """Root mean square, in σ, of what the refitted rigid model leaves."""
    count = len(u) // WINDOW
    y, u = (a[: count * WINDOW].reshape(count, WINDOW) for a in (clean, u))
    speed = (y[:, 1] - y[:, 0]) / gear.period
    x, values = np.stack([y[:, 0], speed], axis=1), np.array([gear.J, gear.b])
    for _ in range(4):
        plain, columns = gear.rigid(x, u, *values), []
        for j in range(2):
            moved = values * (1 + 1e-5 * (np.arange(2) == j))
            columns.append((gear.rigid(x, u, *moved) - plain).ravel() / 1e-5)
        for j, row in np.ndindex(2, count):
            slope = np.zeros_like(y)
            nudged = gear.rigid(x[row : row + 1] + 1e-6 * (np.arange(2) == j), u[row : row + 1], *values)
            slope[row] = (nudged[0] - plain[row]) / 1e-6
            columns.append(slope.ravel())
        step = np.linalg.lstsq(np.stack(columns, axis=1), (y - plain).ravel(), rcond=None)[0]
        values = values * np.clip(1 + step[:2], 0.5, 2)
        x = x + step[2:].reshape(2, count).T
    return float(np.sqrt(np.mean((y - gear.rigid(x, u, *values)) ** 2))) / sigma


def ask(part: str, seed: int, index: int, limit: float) -> dict[str, Any]:
    c = case(part, seed, index)
    g, key = c.gear, ["gear-play", "q"]
    # The width itself a link may not show: what it is moved by is all that its angle tells.
    moved = {("motor_shift", "link_shift")[g.side]: g.width * (g.share, 1 - g.share)[g.side], "width": g.width}
    asked = {
        "part": part,
        "seed": seed,
        "index": index,
        "plant": ("motor", "link")[g.side],
        "excitation": "multisine",
        "period": g.period,
        "hold": "zero",
        "noise": [float(f"{c.sigma:.3g}")],
        "hidden": [{"effect": key[0], "site": key[1], "numbers": moved}] if g.width else [],
        "label": "clear",
        "remains": round(c.remains, 3),
        "classes": [[key]] if g.width else [],
    }
    return asked | sit.timed(lambda: sit.answer(gc.diagnose(c.model(), c.recording())), limit)
