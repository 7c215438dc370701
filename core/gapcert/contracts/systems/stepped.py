"""What a step of a System gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from gapcert.numerics.arrays import Array


@final
@dataclass(frozen=True)
class Step:
    """Result of a step or rollout: x (n, nx) or (n, steps + 1, nx), and the hidden state (n, nh) to hand on, if any."""

    x: Array
    hidden: Array | None = None
