"""What an effect adds to a model, as text: parameters, forces, friction, inputs, outputs, delays and memories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import final

import numpy as np


@final
@dataclass(frozen=True)
class Parameter:
    """A named number of a System: stated value, unit, absolute tolerance (0: exact), and bounds that make physical sense."""

    name: str
    value: float
    unit: str = "1"
    tolerance: float = 0.0
    low: float = -np.inf
    high: float = np.inf


@final
@dataclass(frozen=True)
class Memory:
    """A hidden state that an effect adds: its unit, and its value at the end of a sub-step as text.

    `next` may use the names and placeholders of an Extension and `{h}`, the sub-step in s; names inside it stand for values at
    the beginning of the sub-step. `start` is the value by default.
    """

    name: str
    unit: str
    next: str
    start: float = 0.0


@final
@dataclass(frozen=True)
class Extension:
    """One effect written as equations at a site: what `Model.extend` adds.

    Expressions may use the model's names, the effect's parameter names, its memories' names, and placeholders: `{q}` (the
    coordinate), `{v}` (its velocity), `{u}` (the input), `{f}` (what already acts at the coordinate: the applied force, or the
    right-hand side of a state equation), `{t}` (time in s, a hidden state named `time`) and `{h}` (the sub-step in s).

    force: added to the generalised force at the coordinate (or to the state equation); forces: the same at other coordinates;
    dry_friction: a bound F ≥ 0 on a set-valued friction force |f| ≤ F, solved inside the step; input: replaces the input;
    delay: a time in s by which the input comes late; output: replaces the output `{y}`; output_delay: a time in s by which the
    output comes late; memory: hidden states; tilt: an angle in rad by which gravity is turned along the coordinate; payload: a
    point mass in kg carried at the coordinate's point; implicit: a damping D that is solved with the sub-step,
    (M + h D) Δv = h f; frees: a parameter of the model whose tolerance is lifted; substeps: of a period, at least.
    """

    effect: str
    site: str
    parameters: tuple[Parameter, ...]
    force: str | None = None
    dry_friction: str | None = None
    input: str | None = None
    output: str | None = None
    delay: str | None = None
    forces: Mapping[str, str] = field(default_factory=dict)
    output_delay: str | None = None
    memory: tuple[Memory, ...] = ()
    tilt: str | None = None
    payload: str | None = None
    implicit: str | None = None
    frees: str | None = None
    substeps: int = 1
