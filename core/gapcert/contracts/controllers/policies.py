"""Policies: which of the allowed inputs a controller applies. Configs of specs name them: nothing heavy is imported."""

from __future__ import annotations

from typing import Literal, get_args

from gapcert.numerics.errors import UsageError

Policy = Literal["first", "middle", "last", "random", "least-effort", "adversarial"]
"""Which of the allowed inputs is applied.

`first`, `middle`, `last`: by the order of the inputs. `random`: any, a pure function of (seed, step, row). `least-effort`: the
smallest ‖u / s‖₂ with s the range of each input among all inputs, the first of equals. `adversarial`: the one that leads
closest to losing. Of each allowed input the corners of its promised box of successor cells are looked at, and the largest
height among them counts: the value on the way to a target, and in a set that is kept for ever minus the depth, the distance in
cells to the nearest cell outside it, along the axis where it is farthest. Ties go to the larger mean over the corners, then to
the first input. It looks one step ahead.
"""
POLICIES: tuple[Policy, ...] = get_args(Policy)
ANYWHERE: tuple[Policy, ...] = ("first", "middle", "last", "random")


def known(policy: str) -> None:
    if policy not in POLICIES:
        raise UsageError(f"controller: policy '{policy}' is unknown; use one of {', '.join(POLICIES)}")
