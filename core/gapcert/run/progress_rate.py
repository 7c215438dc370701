"""How fast a stage goes and how long it will take, and both in words."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any, final

from gapcert.run.thresholds import THRESHOLDS


@final
class Pace:
    """Rate = (done now − done then) / time between, over the last `rate_window` seconds; unknown at first and after a new
    start."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float]] = deque()
        self.total: float | None = None

    def saw(self, at: float, done: float, total: float | None) -> None:
        """`done` of `total` at time `at`, in seconds. What was done when the first report came has no part in the rate."""
        if total != self.total or (self._seen and done < self._seen[-1][1]):
            self._seen.clear()
        self.total = total
        if len(self._seen) > THRESHOLDS.rate_reports and at - self._seen[-2][0] < THRESHOLDS.rate_window / 100:
            self._seen.pop()
        self._seen.append((at, done))
        while len(self._seen) > THRESHOLDS.rate_reports and at - self._seen[0][0] > THRESHOLDS.rate_window:
            self._seen.popleft()

    @property
    def done(self) -> float:
        return self._seen[-1][1] if self._seen else 0.0

    @property
    def rate(self) -> float | None:
        """Per second."""
        if len(self._seen) < 2:
            return None
        (begin, first), (end, last) = self._seen[0], self._seen[-1]
        return (last - first) / (end - begin) if end - begin >= THRESHOLDS.rate_known and last > first else None

    def remaining(self, now: float) -> float | None:
        """Seconds from `now`, not below 0; None where the rate or the total is not known."""
        return self.remaining_after(now - self._seen[-1][0]) if self._seen else None

    def remaining_after(self, since: float) -> float | None:
        """The same, `since` seconds after the last report."""
        if (rate := self.rate) is None or self.total is None:
            return None
        return max(0.0, (self.total - self.done) / rate - since)


def duration(seconds: float | None) -> str:
    """`51 s`, `4 min 10 s`, `2 h 05 min`, `3 d 04 h`; `–` where it is not known."""
    if seconds is None:
        return "–"
    whole = round(seconds)
    for size, unit, smaller, name in ((86400, "d", 3600, "h"), (3600, "h", 60, "min"), (60, "min", 1, "s")):
        if whole >= size:
            return f"{whole // size} {unit} {whole % size // smaller:0{1 if unit == 'min' else 2}d} {name}"
    return f"{whole} s"


def speed(rate: float | None, unit: str = "") -> str:
    """`98,000 points/s`, or `12 s per design` where one takes longer than a second; empty where it is not known."""
    if rate is None:
        return ""
    if rate < 1:
        return f"{duration(1 / rate)} per {_one(unit) or 'step'}"
    digits = 10 ** max(0, len(str(int(rate))) - 2)
    return f"{round(rate / digits) * digits:,}{f' {unit}' if unit else ''}/s"


def best_so_far(best: Mapping[str, Any] | None) -> str:
    """`tightness 1.02, violations 0`."""
    return ", ".join(f"{name} {figure(value)}" for name, value in (best or {}).items())


def figure(value: Any) -> str:
    """A number as progress shows it: 4 digits, thousands apart."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def counted(data: Mapping[str, Any]) -> str:
    """`1,200 of 6,250 points`, of a progress."""
    done, total, unit = data.get("done", 0), data.get("total"), data.get("unit", "")
    unit = _one(unit) if (total or done) == 1 else unit
    return f"{done:,}" + (f" of {total:,}" if total else "") + (f" {unit}" if unit else "")


def _one(unit: str) -> str:
    """`hypotheses` → `hypothesis`, `boxes` → `box`, `points` → `point`."""
    for many, one in (("theses", "thesis"), ("xes", "x"), ("s", "")):
        if unit.endswith(many):
            return unit.removesuffix(many) + one
    return unit
