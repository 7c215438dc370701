"""Where runs of the closed loop start: drawn from the domains of controllers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapcert.plugin import Array, Controller, NoStart


def draw_starts(controllers: Sequence[Controller], n: int, seed: int) -> Array:
    """n states, uniform on the intersection of the controllers' domains but for the target; NoStart where there are too few."""
    rng = np.random.default_rng(seed)
    found: list[Array] = []
    missing = n
    for _ in range(200):
        # Where an answer is dear, not many more are asked for than are needed.
        x = controllers[0].draw(max(4 * n, 5 * controllers[0].resolution), rng)
        for controller in controllers:
            x = x[controller.contains(x)]
            x = x[~controller.over(x, controller.start(x))]
        found.append(x[:missing])
        missing -= len(found[-1])
        if not missing:
            return np.concatenate(found)
    reasons = [str(c.evidence["reason"]) for c in controllers if "reason" in c.evidence]
    why = f" ({reasons[0]})" if reasons else ""
    finer = "smaller cells, " if any("winning_cells" in c.evidence for c in controllers) else ""
    raise NoStart(
        f"closed loop: {n - missing} of {n} starts found where all controllers win{why}, the target left out; enlarge "
        f"their domains ({finer}a longer period, a wider goal)"
    )


def taken_first(with_gamma: Controller, without_gamma: Controller, n: int, seed: int) -> tuple[Array, int]:
    """n starts drawn where the controller without γ wins, those first that the one with γ takes, and how many these are."""
    x = draw_starts((without_gamma,), n, seed)
    takes = with_gamma.contains(x)
    if not takes.any():
        raise NoStart(
            f"closed loop: the controller with γ starts from none of {n} states drawn where the one without γ wins; enlarge "
            f"its domain, or leave out `starts_from`"
        )
    return np.concatenate([x[takes], x[~takes]]), int(takes.sum())
