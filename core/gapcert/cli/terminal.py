"""A run as the terminal shows it: bars where there is a terminal, lines in a log, and the answer in words."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, TextIO, final

from gapcert.contracts.plugins.events import Event, Heart
from gapcert.numerics.errors import harmless
from gapcert.numerics.kernels import LISTENERS
from gapcert.run.progress_rate import Pace, best_so_far, counted, duration, speed

if TYPE_CHECKING:
    from gapcert.cli.progress_bars import Bars

PAUSE = 10.0  # seconds between two lines of progress in a log


@final
class Terminal:
    """An observer that writes to `stream`: bars if it is a terminal, else a line per stage and per PAUSE. Use as a context.

    Both show what is done of what, the rate, the remaining time (`–` until it is known) and the best result so far; lines begin
    with the time since the start.
    """

    def __init__(self, stream: TextIO, quiet: bool = False) -> None:
        self.stream, self.quiet = stream, quiet
        self.begin = time.monotonic()
        self.now, self.last, self.wait, self.best = 0.0, 0.0, PAUSE, ""
        self.bars: Bars | None = None
        self.paces: dict[str, Pace] = {}
        self.stages: dict[str, float] = {}
        self.recent: tuple[str, Mapping[str, Any]] | None = None
        self._lock = threading.RLock()
        self._heart = Heart(PAUSE / 5, self.beat)

    def __enter__(self) -> Terminal:
        if self.stream.isatty() and not self.quiet:
            from gapcert.cli.progress_bars import Bars

            self.bars = Bars(self.stream)
        self._heart.__enter__()
        LISTENERS.append(self.told)
        return self

    def __exit__(self, *error: object) -> None:
        self._heart.__exit__()
        LISTENERS[:] = [one for one in LISTENERS if one != self.told]
        if self.bars is not None:
            self.bars.stop()
            self.bars = None

    def __call__(self, event: Event) -> None:
        self.at(time.monotonic() - self.begin, event)

    def at(self, now: float, event: Event) -> None:
        """Show an event of `now` seconds after the start."""
        with self._lock:
            self.now = now
            self._shown(event)

    def told(self, text: str) -> None:
        """A line of now."""
        with self._lock:
            self.now = time.monotonic() - self.begin
            self.line(text)

    def beat(self) -> None:
        """Where nothing was told for long, what goes on, and since when."""
        with self._lock:
            now = time.monotonic() - self.begin
            if self.stages and self.bars is None and not self.quiet and now - self.last > (PAUSE if self.recent else self.wait):
                stage, since = next(reversed(self.stages.items()))
                self.now, self.wait = now, 2 * self.wait
                self.line(self._reported(*self.recent) if self.recent else f"{stage}: still at it, for {duration(now - since)}")

    def _shown(self, event: Event) -> None:
        if event.name == "warning":
            self.line(f"warning: {event.stage}: {event.data.get('message', event.data)}", always=True)
        elif event.name == "progress":
            self._progress(event.stage, event.data)
        elif event.name == "stage-started":
            self.stages[event.stage], self.recent, self.wait, self.best = self.now, None, PAUSE, ""
            self.line(f"{event.stage} ...")
            if self.bars is not None:
                self.bars.at(event.stage)
        elif event.name == "stage-finished":
            self.over()
            self.stages.clear()
            seconds = event.data.get("seconds")
            self.line(f"{event.stage} done" + (f" in {seconds:.1f} s" if seconds is not None else ""))
        elif event.name == "run-finished":
            self.over()
            self.stages.clear()

    def _progress(self, stage: str, data: Mapping[str, Any]) -> None:
        name = f"{stage}: {data['part']}" if data.get("part") else stage
        pace = self.paces.setdefault(name, Pace())
        pace.saw(self.now, data.get("done", 0), data.get("total"))
        self.recent = name, data
        if self.bars is not None:
            self.bars.show(name, data, pace)
        elif self.now - self.last > PAUSE:
            self.line(self._reported(name, data))

    def _reported(self, name: str, data: Mapping[str, Any]) -> str:
        best, self.recent, self.wait = best_so_far(data.get("best")), None, PAUSE
        data, self.best = data if best != self.best else {**data, "best": None}, best
        return f"{name}: {', '.join(reported(data, self.paces.setdefault(name, Pace()), self.now))}"

    def over(self) -> None:
        """What went on has ended."""
        self.recent = None
        self.paces.clear()
        if self.bars is not None:
            self.bars.clear()

    def reset(self) -> None:
        """A run begins anew: its time, too."""
        self.over()
        self.stages.clear()
        self.now = self.last = 0.0
        self.begin = time.monotonic()

    def line(self, text: str, always: bool = False) -> None:
        """A line that stays."""
        self.last, text = self.now, harmless(text)
        if self.quiet and not always:
            return
        if not self.quiet:
            text = f"[{clock(self.now)}] {text}"
        if self.bars is not None:
            self.bars.line(text)
        else:
            print(text, file=self.stream, flush=True)


def reported(data: Mapping[str, Any], pace: Pace, now: float) -> Iterator[str]:
    """A progress in a log's words: done of total, rate, remaining time, what is tried, best so far."""
    share = f" ({data.get('done', 0) / data['total']:.0%})" if data.get("total") else ""
    yield counted(data) + share
    if rate := speed(pace.rate, data.get("unit", "")):
        yield rate
    if data.get("total") and data.get("done", 0) < data["total"]:
        yield f"{duration(pace.remaining(now))} left"
    if data.get("text"):
        yield str(data["text"])
    if told := best_so_far(data.get("best")):
        yield f"so far {told}"


def clock(seconds: float) -> str:
    """Time since the start, as lines of a log begin: `  0:07`, ` 12:31`, `2:05:00`."""
    whole = int(seconds)
    hours, rest = divmod(whole, 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60:3d}:{rest % 60:02d}"
