"""Bars on a terminal: one per part of a stage that is under way."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, TextIO, final

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.table import Column
from rich.text import Text

from gapcert.run.progress_rate import Pace, best_so_far, counted, duration, speed

MOST = 4  # bars at once: more would push the lines above them off the screen
NARROW = 110  # columns of a terminal that has no room for counts and rates beside what was found


@final
class Bars:
    """Name, bar, done of total, rate, remaining time and best so far, each on one line; lines that stay are printed above."""

    def __init__(self, stream: TextIO) -> None:
        console = Console(file=stream)
        fit = Column(no_wrap=True, overflow="ellipsis")
        self.narrow = console.width < NARROW
        columns = (
            TextColumn("{task.description}", table_column=fit, markup=False),
            BarColumn(bar_width=8 if self.narrow else 16),
            TextColumn("{task.fields[counted]}", table_column=Column(no_wrap=True), markup=False),
            *([] if self.narrow else [_Rate()]),
            _Left(),
            TextColumn("{task.fields[best]}", table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1), markup=False),
        )
        self.progress = Progress(*columns, console=console, transient=True, expand=True)
        self.tasks: dict[str, TaskID] = {}
        self.progress.start()

    def show(self, name: str, data: Mapping[str, Any], pace: Pace) -> None:
        """A bar, new or moved."""
        if name not in self.tasks:
            self._make_room()
            self.tasks[name] = self.progress.add_task(name, total=None, pace=pace, counted="", best="", at=0.0, unit="")
        best = "; ".join(t for t in (best_so_far(data.get("best")), str(data.get("text", ""))) if t)
        done, total = data.get("done", 0), data.get("total")
        share = f"{done / total:.0%}" if total else counted({"done": done})
        shown = {
            "counted": "" if not data else share if self.narrow else counted(data),
            "best": best,
            "pace": pace,
            "unit": data.get("unit", ""),
            "at": time.monotonic(),
        }
        self.progress.update(self.tasks[name], completed=done, total=total, **shown)

    def at(self, stage: str) -> None:
        """A stage that has begun and has not told how far it is: a bar without an end, and the time."""
        self.show(stage, {}, Pace())

    def _make_room(self) -> None:
        """Bars that are full go first, then the oldest."""
        over = {t.id for t in self.progress.tasks if t.finished}
        full = [name for name, task in self.tasks.items() if task in over]
        for name in [*full, *(n for n in self.tasks if n not in full)][: max(len(full), len(self.tasks) - MOST + 1)]:
            self.progress.remove_task(self.tasks.pop(name))

    def clear(self) -> None:
        """All bars go."""
        for name in list(self.tasks):
            self.progress.remove_task(self.tasks.pop(name))

    def line(self, text: str) -> None:
        """Print above the bars."""
        self.progress.console.print(text, markup=False, highlight=False)

    def stop(self) -> None:
        """Leave the terminal as it was."""
        self.progress.stop()


@final
class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(speed(task.fields["pace"].rate, task.fields["unit"]), style="dim", no_wrap=True)


@final
class _Left(ProgressColumn):
    """Counts down between reports."""

    def render(self, task: Task) -> Text:
        if task.total is None:
            return Text(f"for {duration(task.elapsed)}", style="dim", no_wrap=True)
        if task.completed >= task.total:
            return Text("")
        pace: Pace = task.fields["pace"]
        left = pace.remaining_after(time.monotonic() - task.fields["at"])
        return Text(f"{duration(left)} left", style="cyan", no_wrap=True)
