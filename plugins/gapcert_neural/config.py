"""Options of the family `neural`; imports nothing heavier than pydantic."""

from __future__ import annotations

from typing import Annotated, Literal, final

from pydantic import BaseModel, ConfigDict, Field

_Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=1)]


@final
class NeuralConfig(BaseModel):
    """`hidden`: neurons per hidden layer; `activation`: elementwise, with slopes in [0, 1]; `steps`: of training at most, which
    ends earlier when nothing improves; `cells`: of the table of shifts, per axis (default: 8, fewer in many dimensions);
    `tolerance`: of each shift, relative to the mean gap; `boxes`: for each proof at most; `device`: `auto` takes a GPU where
    there is one. `training`: `paper` is the published recipe, on route theorem1, with the constant `lipschitz` of the networks
    (one, or one per state) and the weight `barrier` of its log-determinant. `shape`, on route theorem1: `lbdn` and `sll` are
    networks that keep to a Lipschitz constant by construction, with any number of layers. `sides`, on route dominate: `two`
    networks for l and u, trained on the integral of u − l, or `one` for γ ≥ |r − p|, trained on the integral of γ.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["neural"]
    hidden: Annotated[list[_Count], Field(min_length=1)] = Field([64], description="neurons per hidden layer")
    activation: Literal["relu", "leaky-relu", "tanh", "softplus", "sigmoid", "arctan"] = Field(
        "relu", description="between layers, elementwise"
    )
    steps: _Count = Field(2000, description="of training, at most")
    cells: list[_Count] | None = Field(
        None, description="cells of the table of shifts, per axis; default: 8, fewer in many dimensions"
    )
    tolerance: Annotated[float, Field(gt=0, lt=1)] = Field(0.01, description="of each shift, relative to the mean gap")
    boxes: _Count = Field(200_000, description="boxes per proof, at most")
    device: Literal["auto", "cpu", "cuda"] = Field("auto", description="where to train; auto: a GPU where there is one")
    predictor: Literal["none", "affine"] = Field("none", description="what is subtracted before the remainder is bounded")
    training: Literal["certified", "paper"] = Field(
        "certified", description="minimise what is certified, or the published recipe (route theorem1)"
    )
    lipschitz: _Positive | Annotated[list[_Positive], Field(min_length=1)] = Field(
        1.0, description="with training: paper, the constant of the networks, one or one per state"
    )
    barrier: _Positive = Field(1e-4, description="with training: paper, the weight of the log-determinant")
    shape: Literal["free", "lbdn", "sll"] = Field(
        "free", description="free weights, or networks that keep to a constant by construction"
    )
    sides: Literal["two", "one"] = Field("two", description="on route dominate: l and u, or γ alone")
