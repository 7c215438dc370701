"""Options of the components in this package; imports nothing heavier than pydantic."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field

from gapcert.plugin import Keyed

if TYPE_CHECKING:
    from gapcert.plugin import Context, Model

from .families.grammar import MalformedError, read

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


_Parts = Annotated[list[tuple[float, float, _NonNegative]], Field(min_length=1)]


class _Options(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


@final
class DeclaredConfig(_Options):
    """Per state, the constant along every state and input: {theta: {theta: 1e-3, omega: 1e-6, torque: 1e-4}, ...}. `curvature`,
    written alike, bounds the second derivatives along single axes (family `multilinear`); [[low, high, bound], ...] does so in
    parts of an axis."""

    kind: Literal["declared"]
    values: dict[str, dict[str, _NonNegative]] = Field(
        description="state → axis → constant, in the state's unit per the axis' unit"
    )
    curvature: dict[str, dict[str, _NonNegative | _Parts]] | None = Field(
        None, description="state → axis → bound of the second derivative, or [[low, high, bound], …]"
    )


@final
class IntervalJacobianConfig(_Options):
    """`boxes`: how many boxes the domain may be cut into for the proof; `cells`: at most so many cells with constants of their
    own, cut where slopes differ most (1: the same constants everywhere); `curvature`: second derivatives along each axis are
    bounded as well, in up to `slabs` parts of the axis, cut where they differ most (family `multilinear`)."""

    kind: Literal["interval"]
    boxes: Annotated[int, Field(ge=1)] = Field(4096, description="boxes that the domain may be cut into for the proof")
    cells: Annotated[int, Field(ge=1, le=20_000)] = Field(
        1, description="cells with constants of their own, at most (1: the same everywhere)"
    )
    curvature: bool = Field(False, description="are second derivatives along each axis bounded, too? (family `multilinear`)")
    slabs: Annotated[int, Field(ge=1, le=100)] = Field(
        8, description="parts of an axis with curvature bounds of their own, at most"
    )


@final
class WoodZhangConfig(_Options):
    """`safety` multiplies the estimate (the published method has 1; below 1 it claims less); `pairs` per
    axis in `batches`; `distance` of a pair, relative to the width of the axis; `curvature`: second differences as well,
    as many as pairs."""

    kind: Literal["wood-zhang"]
    safety: _Positive = Field(1.2, description="factor on the estimate; the published method has 1")
    pairs: Annotated[int, Field(ge=20)] = Field(2500, description="pairs of points per axis")
    batches: Annotated[int, Field(ge=10)] = Field(50, description="batches of pairs; the steepest of each is kept")
    distance: Annotated[float, Field(gt=0, le=1)] = Field(1e-2, description="of a pair, relative to the width of the axis")
    curvature: bool = Field(False, description="second differences as well, as many as pairs")


@final
class GradientEliteConfig(_Options):
    """`safety` multiplies the largest slope seen; `budget` of transitions, for all axes together; `distance` of a pair
    at random, relative to the width of the axis; `curvature`: half of the budget goes to second differences."""

    kind: Literal["gradient-elite"]
    safety: _Positive = Field(1.2, description="factor on the largest slope seen")
    budget: Annotated[int, Field(ge=100)] = Field(15_000, description="transitions, for all axes together")
    distance: Annotated[float, Field(gt=0, le=1)] = Field(
        1e-2, description="of a pair at random, relative to the width of the axis"
    )
    curvature: bool = Field(False, description="does half of the budget go to second differences?")


@final
class PiecewiseConfig(_Options):
    """For residuals that jump (contact, sticking): constants per cell. `safety` multiplies slopes and jumps; `budget` of
    transitions; at most `cells` cells, none thinner than `thinnest`; `distance` of close pairs; both relative to the width of
    the axis."""

    kind: Literal["piecewise"]
    safety: _Positive = Field(1.2, description="factor on slopes and jumps")
    budget: Annotated[int, Field(ge=100)] = Field(30_000, description="transitions, for all cells together")
    cells: Annotated[int, Field(ge=1, le=20_000)] = Field(256, description="cells with constants of their own, at most")
    distance: Annotated[float, Field(gt=0, le=1)] = Field(1e-2, description="of close pairs, relative to the width of the axis")
    thinnest: Annotated[float, Field(gt=1e-9, le=0.5)] = Field(1e-3, description="cell, relative to the width of the axis")


@final
class PredictorModel(_Options):
    """An extended model as a spec file: its difference from the nominal model is the predictor."""

    model: str = Field(description="a spec whose `model:` is the extended one, relative to this spec")

    def made(self, context: Context) -> Model:
        return context.other(self.model)


Smooth = Literal["none", "affine"] | PredictorModel
Predictor = Literal["multilinear"] | Smooth


@final
class ConstantConfig(_Options):
    """`predictor`: what is subtracted before the envelope behind the constant is built (route dominate)."""

    kind: Literal["constant"]
    predictor: Predictor = Field("none", description="what is subtracted before the envelope behind the constant is built")


@final
class DeclaredGapConfig(_Options):
    """`gamma`: γ of each state by its name, in the model's units: {theta: 5e-4, omega: 3e-3}. It is taken on trust (claim
    `assumed`); without a `backend:` nothing is asked of a simulator, with one its samples and its audit may refute it."""

    kind: Literal["declared"]
    gamma: dict[str, _NonNegative] = Field(description="state → γ, in the state's unit")

    def keyed(self) -> tuple[Keyed, ...]:
        return (Keyed("gamma", "states"),)


@final
class EnvelopeConfig(_Options):
    """`predictor`: what is subtracted before the remainder is bounded."""

    kind: Literal["envelope"]
    predictor: Predictor = Field("affine", description="what is subtracted before the remainder is bounded")


@final
class MultilinearConfig(_Options):
    """Needs `sampling: {kind: lattice}` and constants with `curvature`; `predictor`: what is subtracted before."""

    kind: Literal["multilinear"]
    predictor: Smooth = Field("affine", description="what is subtracted before the remainder is bounded")


@final
class BasisConfig(_Options):
    """`functions`: sums, products and whole powers of axes, numbers and abs, atan, cos, exp, log, sin, sqrt, tanh, such as "1",
    "theta^2", "abs(theta)*sin(omega)", "tanh(20*omega)", "exp(-theta^2)"; bounded, with bounded slopes, on the domain. On
    route `dominate` there are `cells` of the table of shifts, per axis (default: 8, fewer in many dimensions), a `tolerance` of
    each shift, relative to the mean gap, at most `boxes` for each proof, and a `predictor` that is subtracted before.
    """

    kind: Literal["basis"]
    functions: Annotated[list[str], Field(min_length=1)] = Field(
        description='texts such as "1" and "abs(theta)*sin(omega)", whose weights are fitted'
    )
    cells: list[Annotated[int, Field(ge=1)]] | None = Field(
        None, description="cells of the table of shifts, per axis; default: 8, fewer in many dimensions"
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(0.01, description="of each shift, relative to the mean gap")
    boxes: Annotated[int, Field(ge=1)] = Field(200_000, description="boxes per proof, at most")
    predictor: Literal["none", "affine"] = Field("none", description="what is subtracted before the remainder is bounded")

    def check(self) -> Iterator[tuple[tuple[str | int, ...], str, int]]:
        """(path, message, offset in the text) of every function outside the grammar."""
        for k, text in enumerate(self.functions):
            try:
                read(text)
            except MalformedError as error:
                yield ("functions", k), str(error), error.offset
