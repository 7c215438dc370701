"""How clear a hidden effect is, and which others would do the same: from noiseless motions of what is not held out.

With noise, a difference of the costs of two fits is what the best test could see; one that charges ln n for a number, as every
sound one does, cannot see less than that between a law and a shorter one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import final

import numpy as np

from exams.hidden.laws import KIND, NAMES, Hidden, shape, sites
from exams.hidden.plants import TOLERANCE
from exams.hidden.refit import Fitted, Refit
from exams.hidden.rig import COARSE, Rig
from gapcert.numerics.arrays import Array

EVIDENT = 9.0  # difference of costs: three standard deviations
SAME = 21.5  # below this a test at three standard deviations misses one case in twenty: (3 + 1.64)²
GRID = (0.1, 0.4, 1.0)  # shares of an alternative's largest strength from which its fit starts
SMALL = (0.02, 0.1, 0.4)  # the same, where the motion is linear in the strength, unless that throws it elsewhere
LINEAR = (
    "viscous-friction",
    "quadratic-drag",
    "linear-spring",
    "cubic-spring",
    "constant-force",
    "gravity-tilt",
    "payload",
    "joint-coupling",
    "input-gain",
    "input-offset",
    "sensor-bias",
    "sensor-scale",
    "parameter",
)  # in whose strength the motion is nearly so
REACH = 10.0  # times the largest strength of an alternative that is drawn: what stands in for another may have to be stronger
NEAR = 0.1  # share of the cost without any effect that is worth a second fit
HOPE = 0.25  # an alternative is fitted if, to first order, it leaves less than this share of the cost


@final
class Truth:
    """Judgements about the effects hidden in a rig, seen through channels with noise `sigma` (name → σ)."""

    def __init__(self, rig: Rig, effects: tuple[Hidden, ...], sigma: Mapping[str, float]) -> None:
        self.rig, self.effects, self.sigma = rig, effects, sigma
        self.data = Refit(rig, effects, sigma)
        self.stated = self.data.stated
        self._lacking: dict[tuple[Hidden, ...], tuple[Fitted, Callable[[Array | None], Array]]] = {}
        self._free = cache(lambda: rig.play((), COARSE))

    def strength(self) -> float:
        """RMS change of 1 s rollouts by the effects, in σ, of the channel that shows them best."""
        return self._largest(self.data.misfit((), self.rig.parameters, self.data.starts))

    def remains(self) -> float:
        """RMS misfit in σ once parameters within tolerance and starts have been refitted without the effects."""
        return self._largest(self.data.fit(bounded=True).residual)

    def beside(self) -> float:
        """What remains, RMS in σ, of the one of several effects that the others hide best: they and all numbers refitted.

        A joint that another effect holds still shows nothing of its spring.
        """
        rests = [tuple(h for h in self.effects if h is not lacking) for lacking in self.effects]
        return min(self._largest(self._without(rest)[0].residual) for rest in rests)

    def evidence(self) -> float:
        """By how much the cost without any effect exceeds that of the truth."""
        return self._without(())[0].cost - self._own

    def share(self) -> float:
        """RMS of the effects' acceleration over that of the whole effort (motion and inputs together), of the most moved.

        From single steps along the true motion, on which all memories go on; 1 for faults of sensors.
        """
        if all(KIND[h.effect] == "output" for h in self.effects):
            return 1.0
        n, u = self.rig.plant.n, self.data.motion.u[: len(self.data.resets) * self.data.length]
        every = np.arange(0, len(u) - 1, 2)
        before = self.data.motion.x[every, n:]

        def after(effects: tuple[Hidden, ...], inputs: Array) -> Array:
            """Speeds one sample later."""
            y = self.rig.replay(effects, inputs, every, self.data.motion.x[every], self.rig.parameters, self.data.step)
            return np.asarray(y[every + 1, n:])

        changed, without, idle = after(self.effects, u), after((), u), after((), np.zeros_like(u))
        moved, driven, moved_more = (_rms(d) for d in (without - before, without - idle, changed - without))
        return float(np.max(moved_more / np.maximum(np.hypot(moved, driven), 1e-12)))

    def classes(self, rng: np.random.Generator) -> tuple[tuple[tuple[str, str], ...], ...]:
        """Per effect, itself first, the others that could stand in for it beside the rest: its class."""
        keys = [(e, site) for e in NAMES for site in sites(self.rig.plant, e) if self._visible(e, site)]
        return tuple((h.key, *(k for k in keys if k != h.key and self.resembles(h, k, rng))) for h in self.effects)

    def resembles(self, truth: Hidden, other: tuple[str, str], rng: np.random.Generator) -> bool:
        """Does another effect, with no more numbers, fit these data as well as the truth does, within the noise?"""
        rest = tuple(h for h in self.effects if h is not truth)
        if truth.effect == "sensor-quantisation" or other in {h.key for h in rest}:
            return False
        lacking, _ = self._without(rest)
        if lacking.cost <= self._own + EVIDENT:
            return False
        start = self._start(rest, Hidden(*other, {}), len(truth.numbers), rng)
        if start is None:
            return False
        spared = len(truth.numbers) - len(start.numbers)
        limit = self._own + SAME + spared * float(np.log(self.data.rows.size * self.data.thin * len(self.sigma)))
        first = self.data.fit((*rest, start), base=lacking, limit=limit)
        if first.cost <= limit or first.cost > NEAR * lacking.cost:
            return first.cost <= limit
        # Parameters that stood in for the effect may have caught on their bounds: from the true ones again.
        return self.data.fit((*rest, start), base=self.data.true, limit=limit).cost <= limit

    def stands(self, said: tuple[Hidden, ...]) -> bool:
        """Do the effects of an answer, their numbers refitted, fit these data as well as the truth does, within the noise?"""
        free = tuple(h for h in said if h.effect != "sensor-quantisation")
        if len(free) < len(said) or not free:
            return False
        spared = max(0, sum(len(h.numbers) for h in self.effects) - sum(len(h.numbers) for h in free))
        limit = self._own + SAME + spared * float(np.log(self.data.rows.size * self.data.thin * len(self.sigma)))
        bases = (self.data.true, self._without(())[0], None)
        return any(self.data.fit(free, base=b, limit=limit).cost <= limit for b in bases)

    def _largest(self, r: Array) -> float:
        return float(_rms(r / np.sqrt(self.data.thin)).max())

    @property
    def _own(self) -> float:
        """Cost of the truth: how far its parameters are from the stated ones."""
        off = (self.rig.parameters - self.stated) / (TOLERANCE * np.abs(self.stated))
        return float(off @ off)

    def _without(self, rest: tuple[Hidden, ...]) -> tuple[Fitted, Callable[[Array | None], Array]]:
        """The best fit with `rest` alone, and the projection off its numbers and starts."""
        if rest not in self._lacking:
            fitted = self.data.fit(rest)
            self._lacking[rest] = fitted, self.data.tangent(fitted)
        return self._lacking[rest]

    def _visible(self, effect: str, site: str) -> bool:
        return effect != "sensor-quantisation" and (KIND[effect] != "output" or site in self.sigma)

    def _start(self, rest: tuple[Hidden, ...], other: Hidden, most: int, rng: np.random.Generator) -> Hidden | None:
        """First numbers of an alternative, or None where it has too many, or none of its signs and sizes helps."""
        z = self.rig.scales(self._free(), KIND[other.effect], other.site)
        lacking, project = self._without(rest)
        best, found = HOPE * lacking.cost, None
        for sign in (1.0, -1.0):
            drawn = shape(other.effect, z, rng, sign)
            if len(drawn.at(drawn.most)) > most:
                return None
            for share in SMALL if other.effect in LINEAR else GRID:
                tried = Hidden(*other.key, drawn.at(share * drawn.most))
                left, scale = self._left(lacking, project, rest, tried)
                if left < best and scale > 0:
                    size = float(np.clip(scale * share, 0.01, REACH if other.effect in LINEAR else 1.0))
                    best, found = left, Hidden(*other.key, drawn.at(size * drawn.most))
        return found

    def _left(
        self, lacking: Fitted, project: Callable[[Array | None], Array], rest: tuple[Hidden, ...], other: Hidden
    ) -> tuple[float, float]:
        """Cost that remains to first order if a multiple of the alternative's change is added, and that multiple."""
        z = self.data.numbers((*rest, other), False, lacking)
        theta = np.concatenate([z.value[: len(self.stated)], lacking.theta[len(self.stated) :]])
        theta = np.concatenate([theta, z.value[len(theta) :]])
        change = self.data.misfit(z.effects(theta), theta[: len(self.stated)], lacking.starts) - lacking.residual
        rows, target = project(change), project(None)
        inner = float(rows @ rows)
        gain = -float(rows @ target) / inner if inner > 0 else 0.0
        return float(target @ target) + 2 * gain * float(rows @ target) + gain**2 * inner, gain


def _rms(a: Array) -> Array:
    return np.asarray(np.sqrt(np.mean(a**2, axis=0)))
