"""What no effect in the library explains: is anything left, does it need memory, did single pushes happen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np

from gapcert.effect import Push, Unexplained
from gapcert.evidence import Fit, fit
from gapcert.measured import Windows
from gapcert.search import probe
from gapcert.system import Array, Model, difference

SHORT = 0.3  # s
LAGS = (0.05, 0.2, 1.0)  # s: memories of the input that are tried
BINS, CLEAR = 10, 0.8  # places in a short window where a push is looked for; share of the residual that it must explain
FOLDS = 5
LEARNT = 0.1  # least share of the residual, in windows not seen, that counts as learnt
EDGE = 0.1  # s: how far from its middle a push may still act


def shortened(last: Fit, long: Windows) -> tuple[Windows, Fit]:
    """The same hypothesis on short windows."""
    m = long.measured
    windows = m.windows(min(m.samples(SHORT), long.length))
    return windows, fit(last.hypothesis, windows, theta=last.theta, iterations=5)


def remains(last: Fit, short: Fit) -> bool:
    """Is the residual more than noise?

    growth = χ_long/max(χ_short, 1): noise, coloured or not, is the same in long and in short windows; a missing force adds up.
    """
    long, brief = float(last.chi.mean()), float(short.chi.mean())
    growth = long / max(brief, 1.0)
    return brief > 25 or growth > (1.06 + math.sqrt(2 / last.residual.size) if brief < 1.3 else 2.0)


def unexplained(model: Model, windows: Windows, short: Fit) -> Unexplained:
    """The kind of what is left: forces along the fitted path are pushed through the linearised motion and regressed."""
    sites = model.sites("coordinate")
    if not sites:
        return Unexplained(False)
    motion = Motion.of(model, windows, short)
    static = np.concatenate([motion.responses(s, motion.static()) for s in sites], axis=-1)
    memory = np.concatenate([motion.responses(s, motion.memory()) for s in sites], axis=-1)
    both, law = motion.learnt(np.concatenate([static, memory], axis=-1)), motion.learnt(static)
    if both - max(law, 0.0) > LEARNT:
        return Unexplained(True)
    if law > LEARNT:
        return Unexplained(False)
    # A push at the edge of a window hides in its free start, so these windows overlap by half.
    overlapping = windows.measured.windows(windows.length, max(1, windows.length // 2))
    again = fit(short.hypothesis.holding(short.theta), overlapping)
    motion = Motion.of(model, overlapping, again)
    events = _single(motion.pushes(sites))
    return Unexplained(False, events if motion.quiet(events) else ())


@final
@dataclass(frozen=True)
class Motion:
    """The linearised motion of short windows: x, u (W, S, ·) at every model step, A (W, S, nx, nx), residual (W, L·ny)."""

    model: Model
    windows: Windows
    x: Array
    u: Array
    A: Array
    observe: Array
    residual: Array

    @classmethod
    def of(cls, model: Model, windows: Windows, short: Fit) -> Motion:
        m = windows.measured
        x = short.hypothesis.motion(windows, short.theta[None], short.start[None])[:, :-1]
        u = np.repeat(windows.u, m.repeat, axis=1)[:, m.history * m.repeat :][:, : x.shape[1]]
        flat = x.reshape(-1, model.nx), u.reshape(-1, model.nu)
        A = model.jacobian(*flat)[:, :, : model.nx].reshape(*x.shape, model.nx)
        base = flat[0][:1], flat[1][:1]
        shifted = model.output(base[0] + 1e-6 * np.eye(model.nx), np.repeat(base[1], model.nx, axis=0))
        slope = difference(model.outputs, shifted, model.output(*base)) / 1e-6
        observe = slope[:, m.columns].T / m.sigma[:, None]
        return cls(model, windows, x, u, A, observe, -short.residual.reshape(len(windows), -1))

    def responses(self, site: str, force: Array) -> Array:
        """What forces (W, S, K) at a site do to the measured channels, (W, L·ny, K), with the starts free to follow."""
        w, steps, k = force.shape
        B = probe(self.model, site, self.x.reshape(-1, self.model.nx), self.u.reshape(-1, self.model.nu)).reshape(w, steps, -1)
        state = np.concatenate([np.zeros((w, self.model.nx, k)), np.tile(np.eye(self.model.nx), (w, 1, 1))], axis=-1)
        drive = np.concatenate([force, np.zeros((w, steps, self.model.nx))], axis=-1)
        out, repeat = [self.observe @ state], self.windows.measured.repeat
        for i in range(steps):
            state = self.A[:, i] @ state + B[:, i, :, None] * drive[:, i, None, :]
            if (i + 1) % repeat == 0:
                out.append(self.observe @ state)
        rows = np.stack(out, axis=1).reshape(w, -1, k + self.model.nx)
        free, _ = np.linalg.qr(rows[..., k:])
        return np.asarray(rows[..., :k] - free @ (np.swapaxes(free, 1, 2) @ rows[..., :k]))

    def static(self) -> Array:
        """Functions of the present state and input, (W, S, K)."""
        z = np.concatenate([self.x, self.u], axis=-1)
        z = z / (np.sqrt(np.mean(z**2, axis=(0, 1))) + 1e-12)
        waves = [f(k * self.x) for k in (1, 2, 4, 8, 16) for f in (np.sin, np.cos)]
        return np.concatenate([z, z * np.abs(z), z**3, np.tanh(10 * z), *waves, np.ones((*z.shape[:2], 1))], axis=-1)

    def memory(self) -> Array:
        """Inputs and their sizes as they were: low-passed over the window and its history, (W, S, K)."""
        m = self.windows.measured
        past = np.repeat(self.windows.u, m.repeat, axis=1)[:, : m.history * m.repeat + self.x.shape[1]]
        out = []
        for lag in LAGS:
            share = -math.expm1(-self.model.period / lag)
            level = past[:, 0]
            slow = np.empty_like(past)
            for i in range(past.shape[1]):
                level = level + share * (past[:, i] - level)
                slow[:, i] = level
            out += [slow, np.abs(slow), past - slow]
        return np.concatenate(out, axis=-1)[:, m.history * m.repeat :]

    def learnt(self, columns: Array) -> float:
        """The share of the residual that a ridge regression on the columns predicts in windows it has not seen."""
        size = np.sqrt(np.mean(columns**2, axis=(0, 1))) + 1e-300
        columns = columns / size
        fold = np.arange(len(columns)) % FOLDS
        left = 0.0
        for k in range(FOLDS):
            train, test = columns[fold != k], columns[fold == k]
            gram = np.einsum("wri,wrj->ij", train, train)
            gram += 1e-4 * np.trace(gram) / len(gram) * np.eye(len(gram))
            weights = np.linalg.solve(gram, np.einsum("wri,wr->i", train, self.residual[fold != k]))
            left += float(np.sum((self.residual[fold == k] - test @ weights) ** 2))
        return 1 - left / float(np.sum(self.residual**2))

    def pushes(self, sites: tuple[str, ...]) -> list[tuple[float, Push]]:
        """(share, push) of windows that stand out and that one short force explains."""
        energy = np.sum(self.residual**2, axis=1)
        rows = np.flatnonzero(energy > 8 * np.median(energy))
        if not 0 < len(rows) <= 0.2 * len(energy):
            return []
        steps = self.x.shape[1]
        edges = np.linspace(0, steps, BINS + 1).astype(int)
        bins = np.digitize(np.arange(steps), edges[1:-1])[:, None] == np.arange(BINS)
        found = []
        for site in sites:
            columns = self.responses(site, np.tile(bins.astype(np.float64), (len(energy), 1, 1)))
            for w in rows.tolist():
                along = columns[w].T @ self.residual[w]
                size = np.sum(columns[w] ** 2, axis=0) + 1e-300
                j = int(np.argmax(along**2 / size))
                if (share := float(along[j] ** 2 / size[j] / energy[w])) > CLEAR:
                    impulse = float(along[j] / size[j] * (edges[j + 1] - edges[j]) * self.model.period)
                    at = float(self.windows.t[w] + (edges[j] + edges[j + 1]) / 2 * self.model.period)
                    found.append((share * energy[w], Push(at, site, 1 if impulse > 0 else -1, abs(impulse))))
        return found

    def quiet(self, events: tuple[Push, ...]) -> bool:
        """Is the residual noise where no event is near? What is left all over the recording is a law, not events."""
        span = self.windows.length * self.windows.measured.period
        far = np.ones(len(self.windows), dtype=bool)
        for event in events:
            far &= (event.t < self.windows.t - EDGE) | (event.t > self.windows.t + span + EDGE)
        rest = self.residual[far]
        return bool(rest.size and np.mean(rest**2) < 1.06 + math.sqrt(2 / rest.size))


def _single(found: list[tuple[float, Push]]) -> tuple[Push, ...]:
    """Each push once, in order of time: of those that overlapping windows show, the one with the most energy."""
    kept: list[Push] = []
    for _, push in sorted(found, key=lambda f: -f[0]):
        if all(abs(push.t - k.t) > SHORT for k in kept):
            kept.append(push)
    return tuple(sorted(kept, key=lambda p: p.t))
