"""What is asked of the synthesizer `mpc`."""

from __future__ import annotations

from collections.abc import Mapping
from inspect import signature
from typing import Any, Literal

from gapcert.plugin import Synthesizer

from .config import Soft, Terminal
from .planning.tracking import stated
from .program.solver import Choice

Linearisation = Literal["once", "successive"]
STARTS: dict[Linearisation, int] = {"once": 400, "successive": 64}


class MpcOptions(Synthesizer):
    """As `MpcConfig` has them; `starts` is how many states are asked for what the controller wins."""

    name = "mpc"

    def __init__(
        self,
        horizon: int = 20,
        reference: Mapping[str, Any] | None = None,
        weights: Mapping[str, float] | None = None,
        solver: Choice = "auto",
        tolerance: float = 1e-5,
        majorant: Literal["auto", "affine", "constant"] = "auto",
        linearisation: Linearisation = "once",
        adapt: Mapping[str, Any] | None = None,
        levels: int = 4,
        searches: int = 30,
        rates: Mapping[str, float | str] | None = None,
        soft: Mapping[str, Any] | None = None,
        terminal: Any = None,
        feedback: Literal["fixed", "disturbance"] = "fixed",
    ) -> None:
        self.rates, self.soft = dict(rates or {}), {n: Soft.model_validate(v) for n, v in (soft or {}).items()}
        self.horizon, self.reference, self.weights = horizon, stated(reference or {}), dict(weights or {})
        self.solver: Choice = solver
        self.tolerance, self.majorant, self.linearisation = tolerance, majorant, linearisation
        self.searches, self.terminal = searches, None if terminal is None else Terminal.model_validate(terminal)
        self.feedback = feedback
        self.adapt, self.levels, self.starts = dict(adapt or {}), levels, STARTS[linearisation]

    @property
    def of_boxes(self) -> dict[str, Any]:
        """Those of the controllers for boxes of parameters, JSON-able."""
        names = signature(MpcOptions).parameters.keys() - {"adapt", "levels", "terminal"}
        return {name: getattr(self, name) for name in sorted(names)}
