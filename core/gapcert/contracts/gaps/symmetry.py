"""Declared symmetries of a residual: checked on pairs of points before they save any."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from gapcert.contracts.gaps.lipschitz import LipschitzBound, LipschitzProblem
from gapcert.contracts.gaps.predictor import Predictor
from gapcert.contracts.systems.domain import Domain
from gapcert.contracts.thresholds import THRESHOLDS
from gapcert.numerics.arrays import Array
from gapcert.numerics.errors import UsageError


@final
@dataclass(frozen=True)
class Symmetry:
    """r(z) = r(z′) for all z, z′ in Z that differ along `axes` (by number) alone: declared, and checked on `pairs` pairs.

    deviation (nx): the largest |r_i(z) − r_i(z′)| that was seen, at most 4 e.
    """

    names: tuple[str, ...]
    axes: tuple[int, ...]
    pairs: int
    deviation: tuple[float, ...]

    def applied(self, bound: LipschitzBound, predictor: Predictor, domain: Domain) -> LipschitzBound:
        """The constants of g = r − p with those along the axes set to what p alone changes, which is mostly nothing."""
        axes, slope = list(self.axes), predictor.jacobian_over(domain.interval).mag[0]
        value, lower, cells = bound.value.copy(), bound.lower.copy(), bound.cells
        slabs = None if bound.slabs is None else tuple(None if j in axes else s for j, s in enumerate(bound.slabs))
        value[:, axes], lower[:, axes] = slope[:, axes], 0.0
        if cells is not None:
            constants = cells.constants.copy()
            constants[:, :, axes] = slope[:, axes]
            cells = replace(cells, constants=constants)
        return replace(bound, value=value, lower=lower, cells=cells, curvature=_curvature(bound, slope, axes), slabs=slabs)

    def sentence(self) -> str:
        """What a certificate assumes because of it."""
        what = f"{' and '.join(self.names)} {'are' if len(self.names) > 1 else 'is'} shifted"
        return (
            f"The residual does not change when {what}: declared by the user, and checked on "
            f"{self.pairs} pairs of points of Z, which differed by up to {max(self.deviation):.3g}; the audit does not use it."
        )

    def to_data(self) -> dict[str, Any]:
        """JSON-able."""
        return {"axes": list(self.axes), "names": list(self.names), "pairs": self.pairs, "deviation": list(self.deviation)}


def checked(names: Sequence[str], problem: LipschitzProblem, pairs: int = THRESHOLDS.symmetry_pairs) -> Symmetry:
    """The symmetry under shifts along named axes; UsageError with the worst pair where r changes by more than 4 e.

    Points are drawn from Z, their partners differ along the axes, uniformly. Each computed residual errs by at most e, and r
    itself may change by 2 e, as between any two samples.
    """
    domain, axes = problem.domain, _numbers(names, problem.domain)
    rng = np.random.default_rng([problem.seed, 0x5E77])
    start = domain.draw(pairs, rng)
    end = start.copy()
    end[:, axes] = (domain.low + domain.width * rng.random(start.shape))[:, axes]
    change, e = problem.change("symmetry", start, end)
    deviation = np.abs(change)
    over = deviation / (4 * e)
    if (over > 1).any():
        k, i = np.unravel_index(int(np.argmax(over)), over.shape)
        raise UsageError(
            f"symmetries.translation: the residual of {domain.axes[i].name} changes by {deviation[k, i]:.3g} from (x, u) = "
            f"{start[k].tolist()} to {end[k].tolist()}, which differ along {', '.join(names)} alone, and in "
            f"{int((over > 1).any(axis=1).sum())} of {pairs} pairs by more than the resolution allows (4 e = {4 * e[i]:.3g}); "
            f"leave out the symmetry, or mend the system"
        )
    return Symmetry(tuple(names), tuple(axes), pairs, tuple(deviation.max(axis=0).tolist()))


def _numbers(names: Sequence[str], domain: Domain) -> list[int]:
    known = [a.name for a in domain.axes]
    for name in names:
        if name not in known:
            raise UsageError(f"symmetries.translation: '{name}' is no state or input; there are {', '.join(known)}")
        # Along an axis that relations involve, a shift may leave Z, where nothing is known of r.
        for relation in domain.relations:
            if relation.coefficients[known.index(name)]:
                raise UsageError(
                    f"symmetries.translation: '{name}' stands in the relation '{relation.text}', so that Z is not the same for "
                    f"all its values; leave it out of one of them"
                )
    return [known.index(name) for name in names]


def _curvature(bound: LipschitzBound, slope: Array, axes: Sequence[int]) -> Array | None:
    """The curvature where g is declared not to change along some axes but for what p does, with these slopes (nx, nz)."""
    if bound.curvature is None:
        return None
    out = bound.curvature.copy()
    out[:, list(axes)] = np.where(slope[:, list(axes)] > 0, np.inf, 0.0)
    return out
