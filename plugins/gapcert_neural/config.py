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
    hidden: Annotated[list[_Count], Field(min_length=1)] = [64]
    activation: Literal["relu", "leaky-relu", "tanh", "softplus", "sigmoid", "arctan"] = "relu"
    steps: _Count = 2000
    cells: list[_Count] | None = None
    tolerance: Annotated[float, Field(gt=0, lt=1)] = 0.01
    boxes: _Count = 200_000
    device: Literal["auto", "cpu", "cuda"] = "auto"
    predictor: Literal["none", "affine"] = "none"
    training: Literal["certified", "paper"] = "certified"
    lipschitz: _Positive | Annotated[list[_Positive], Field(min_length=1)] = 1.0
    barrier: _Positive = 1e-4
    shape: Literal["free", "lbdn", "sll"] = "free"
    sides: Literal["two", "one"] = "two"
