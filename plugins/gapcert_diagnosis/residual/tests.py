"""Tests of a residual, as numbers: is it white, does it go with an input, a state or the time, does it need a memory.

Correlations are in standard deviations of what independent series of the same colour would show; from about 4 on they are no
accident. `memory` is a share: 0 for a law of the present state and input, 1 where these say nothing about the missing force.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from scipy.spatial import KDTree

from gapcert.plugin import Array
from gapcert_diagnosis.fitting.fit import lag_one
from gapcert_diagnosis.fitting.linearised import Tangent
from gapcert_diagnosis.thresholds import THRESHOLDS

from .unexplained import Left


def evidence(found: Left) -> dict[str, dict[str, float]]:
    """Test → channel → number for the residual of the final model; tests of the missing force are by coordinate."""
    long, names = found.long, [c.name for c in found.long.windows.measured.channels]
    r: Array = long.residual.reshape(long.windows.y.shape)
    brief: Array = found.short.residual.reshape(found.short.windows.y.shape)
    m = long.windows.measured

    def by(values: Array) -> dict[str, float]:
        return dict(zip(names, map(float, values), strict=True))

    out = {
        "mean square": by(np.mean(r**2, axis=(0, 1))),
        "mean square, short windows": by(np.mean(brief**2, axis=(0, 1))),
        "beyond coloured noise": by(found.growth.beyond),
        "autocorrelation": by(lag_one(r)),
        "size with time": by(_together(r**2, long.windows.t[:, None] + m.period * np.arange(r.shape[1]))),
    }
    for i, spec in enumerate(long.model.inputs):
        out[f"with {spec.name}"] = by(_leading(r, long.windows.u[..., i], m.history, m.samples(THRESHOLDS.leading_input)))
    forces = {s: Missing.of(found.short, s) for s in long.model.sites("coordinate")}
    seen = {s: f for s, f in forces.items() if f.seen}
    for i, spec in enumerate((*long.model.states, *long.model.inputs) if seen else ()):
        out[f"force with {spec.name}"] = {s: f.together(i) for s, f in seen.items()}
    memories = {s: v for s, f in seen.items() if (v := f.memory()) is not None}
    return out | ({"memory": memories} if memories else {})


def _leading(r: Array, u: Array, history: int, most: int) -> Array:
    """The largest correlation (ny,) of r (W, L, ny) with an input (W, H + L) that leads by up to `most` samples."""
    length, lags = r.shape[1], range(min(history, most) + 1)
    colour = _colour(r)
    found = [_together(r, u[:, history - k : history - k + length], colour) for k in lags]
    # The best of many lags is larger by chance: about as many of them are independent as fit into one correlation time.
    penalty = np.sqrt(2 * np.log(max(2.0, len(lags) ** 0.5)))
    return np.asarray(np.maximum(np.max(np.abs(found), axis=0) - penalty, 0.0))


def _colour(r: Array) -> Array:
    """Autocovariances (2·L, ny) of r (W, L, ny) about its mean."""
    waves = np.fft.rfft(r - r.mean(axis=(0, 1)), 2 * r.shape[1], axis=1)
    return np.asarray(np.fft.irfft(np.sum(np.abs(waves) ** 2, axis=0), 2 * r.shape[1], axis=0))


def _together(r: Array, z: Array, colour: Array | None = None) -> Array:
    """Correlation (ny,) of r (W, L, ny) with z (W, L), over its standard deviation if they were independent."""
    z = z - z.mean()
    of_z, of_r = _colour(z[..., None])[:, 0], _colour(r) if colour is None else colour
    norm = np.sqrt(of_r[0] * np.sum(z**2)) + 1e-300
    # Bartlett: the variance of the correlation is Σ ρ_r(k) ρ_z(k) / n.
    variance = np.maximum(of_z @ of_r / (of_z[0] * of_r[0] + 1e-300), 0.1) / z.size
    along = np.tensordot(z, r - r.mean(axis=(0, 1)))
    return np.asarray(along / norm / np.sqrt(variance))


@final
@dataclass(frozen=True)
class Missing:
    """The force (W, P) that the residual asks for at a coordinate, constant over short pieces; noise: its variance from noise.

    z (W, P, nx + nu): state and input there; t (W, P) in s. The first and the last piece of a window can hide in its free
    start and take no part.
    """

    force: Array
    noise: float
    z: Array
    t: Array

    @classmethod
    def of(cls, tangent: Tangent, site: str) -> Missing:
        steps = tangent.x.shape[1]
        count = min(max(3, round(steps * tangent.model.period / THRESHOLDS.constant_force)), steps)
        member = np.arange(steps) * count // steps
        pieces = np.tile(member[:, None] == np.arange(count), (len(tangent.x), 1, 1)).astype(np.float64)
        columns = tangent.responses(site, pieces)
        gram = np.swapaxes(columns, 1, 2) @ columns
        ridge = THRESHOLDS.force_ridge * np.mean(np.trace(gram, axis1=1, axis2=2)) / count * np.eye(count) + 1e-300
        inverse = np.linalg.inv(gram + ridge)
        force = (inverse @ (np.swapaxes(columns, 1, 2) @ tangent.residual[..., None]))[:, 1:-1, 0]
        noise = np.diagonal(inverse @ gram @ inverse, axis1=1, axis2=2)[:, 1:-1]
        places = np.array([int(np.mean(np.flatnonzero(member == p))) for p in range(1, count - 1)])
        z = np.concatenate([tangent.x[:, places], tangent.u[:, places]], axis=-1)
        return cls(force, float(np.mean(noise)), z, tangent.windows.t[:, None] + places * tangent.model.period)

    @property
    def seen(self) -> bool:
        """Does it vary by more than noise would make it?"""
        return self.force.size >= THRESHOLDS.force_pieces and float(np.var(self.force)) > THRESHOLDS.seen_force * self.noise

    def together(self, column: int) -> float:
        """Its correlation with a state or an input, in standard deviations."""
        return float(_together(self.force[..., None], self.z[..., column])[0])

    def memory(self) -> float | None:
        """How much of it differs between moments of nearly the same state and input; None where no state comes again.

        (½ E(f_i − f_j)² − noise) / (Var f − noise) over nearest neighbours j of i in (x, u) at other times.
        """
        f, t, z = self.force.ravel(), self.t.ravel(), self.z.reshape(self.force.size, -1)
        z = (z - z.mean(axis=0)) / (z.std(axis=0) + 1e-300)
        near: list[list[int]] = np.asarray(KDTree(z).query(z, k=min(len(f), THRESHOLDS.state_neighbours))[1]).tolist()
        nearest = ((i, next((j for j in row if abs(t[i] - t[j]) > THRESHOLDS.recurrence), None)) for i, row in enumerate(near))
        pairs = [(i, j) for i, j in nearest if j is not None]
        if len(pairs) < THRESHOLDS.force_pieces:
            return None
        first, second = (f[list(side)] for side in zip(*pairs, strict=True))
        differ = 0.5 * float(np.mean((first - second) ** 2))
        return float(np.clip((differ - self.noise) / (np.var(f) - self.noise), 0.0, 1.0))
