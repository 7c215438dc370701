"""A predictor that interpolates a few values on a lattice."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import numpy.typing as npt

from gapcert import Array, Domain, Interval, UsageError
from gapcert.plugin import Predictor, Samples, cells, cut, interpolate, ranges, rounding, slopes
from gapcert_bounds.thresholds import THRESHOLDS


@final
@dataclass(frozen=True, eq=False)
class MultilinearPredictor(Predictor):
    """p(z) = tensor product of linear interpolation between `values` (n_0, …, n_{nz−1}, nx) at the nodes `axes`.

    Along an axis with a single node p is constant; beyond the outer nodes it stays what it is there.
    """

    axes: tuple[Array, ...]
    values: Array
    kind: str = "multilinear"

    def __post_init__(self) -> None:
        if self.values.shape[:-1] != tuple(len(a) for a in self.axes) or any((np.diff(a) <= 0).any() for a in self.axes):
            raise UsageError(
                f"multilinear: values of shape {self.values.shape} for nodes {[len(a) for a in self.axes]}; give increasing "
                f"nodes for each axis, and one value per node and state"
            )

    @classmethod
    def fit(cls, samples: Samples, domain: Domain) -> MultilinearPredictor:
        """Least squares on the samples: up to three nodes per axis, the outer two at the ends of the domain's box; no more
        than an axis has different samples.
        """
        distinct = [len(np.unique(column)) for column in samples.z.T]
        for most in (3, 2):
            counts = [min(most, n) for n in distinct]
            if np.prod(counts) <= min(len(samples), THRESHOLDS.predictor_nodes):
                break
        else:
            raise UsageError(
                f"gap.predictor: multilinear needs {int(np.prod(counts))} nodes, and there are {len(samples)} samples when it "
                f"is fitted; use affine"
            )
        ends = zip(domain.low, domain.high, counts, samples.z.T, strict=True)
        axes = tuple(np.linspace(low, high, n) if n > 1 else z[:1].copy() for low, high, n, z in ends)
        size = int(np.prod(counts))
        pick = np.linspace(0, len(samples) - 1, min(len(samples), THRESHOLDS.predictor_samples)).astype(int)
        design = interpolate(axes, np.eye(size).reshape(*counts, size), samples.z[pick])
        values = np.linalg.lstsq(design, samples.r[pick], rcond=None)[0]
        return cls(axes, np.ascontiguousarray(values.reshape(*counts, -1)))

    def __call__(self, z: Array) -> Array:
        return interpolate(self.axes, self.values, z)

    def over(self, boxes: Interval) -> Interval:
        low, high = ranges(self.axes, self.values, boxes.lo, boxes.hi)
        return Interval(low - self._error, high + self._error)

    def jacobian_over(self, boxes: Interval) -> Interval:
        low, high = slopes(self.axes, self.values, boxes.lo, boxes.hi)
        sizes = np.array([np.diff(a).min(initial=np.inf) for a in self.axes])
        pad = 4 * self._error[:, None] / sizes
        return Interval(low - pad, high + pad)

    def curvature_over(self, boxes: Interval, axis: int) -> Interval:
        """0 where a closed box meets no node of the axis: along it p is straight between nodes."""
        a, z = self.axes[axis], boxes[:, axis]
        kinks = np.searchsorted(a, z.lo, "left") < np.searchsorted(a, z.hi, "right")
        most = np.broadcast_to(np.where(kinks & (len(a) > 1), np.inf, 0.0)[:, None], (len(boxes), self.values.shape[-1]))
        return Interval(-most, most)

    def cut(self, boxes: Interval) -> tuple[npt.NDArray[np.intp], Interval]:
        """(starts, parts): boxes (n, nz) cut at the nodes, at most into eight parts each, and where those of each box begin."""
        return cut(self.axes, boxes, *cells(self.axes, boxes.lo, boxes.hi))[:2]

    def resolution(self, domain: Domain) -> Array:
        return self._error

    @property
    def _error(self) -> Array:
        largest = np.abs(self.values).max(axis=tuple(range(len(self.axes))))
        return np.asarray(rounding(len(self.axes)) * largest + np.finfo(float).tiny)

    def arrays(self) -> dict[str, Array]:
        return {**{f"axis{j}": a for j, a in enumerate(self.axes)}, "values": self.values}


def made(predictor: Any) -> Any:
    """What a family asks to be subtracted: for `multilinear`, what makes one of samples."""
    return MultilinearPredictor.fit if predictor == "multilinear" else predictor
