"""What the closed loops of two controllers tell while they run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from gapcert.plugin import Pulse


@dataclass
class LoopProgress:
    """The progress of all policies' runs, and how many of these have failed."""

    pulse: Pulse
    steps: int
    policies: int
    failed: dict[str, int] = field(default_factory=lambda: {"with_gamma": 0, "without_gamma": 0})
    done: tuple[str, ...] = ()

    def during(self, name: str, policy: str) -> Callable[[int, int], None]:
        """What is called with the step and the failed runs while controller `name` runs under a policy."""
        text = f"{name.replace('_gamma', ' γ')}, policy {policy}"

        def progress(k: int, now: int) -> None:
            failed, begun = self.failed | {name: self.failed[name] + now}, (*self.done, name)
            self.pulse(len(self.done) * self.steps + k, _so_far(failed, begun), text=text)

        return progress

    def after(self, name: str, failed: int) -> None:
        self.failed[name] += failed
        self.done += (name,)
        text = f"{len(self.done)} of {self.policies} policies done"
        self.pulse(len(self.done) * self.steps, _so_far(self.failed, self.done), text=text)


def _so_far(failed: Mapping[str, int], begun: Sequence[str]) -> dict[str, Any]:
    """The runs that failed, and over how many policies; `begun`: the controller of each policy that counts in these sums."""
    counts = {"runs failed with γ": failed["with_gamma"], "without": failed["without_gamma"]}
    own, other = (begun.count(name) for name in ("with_gamma", "without_gamma"))
    if max(own, other) < 2:
        return counts
    return counts | {"over": f"{own} policies" if own == other or not other else f"{own} and {other} policies"}
