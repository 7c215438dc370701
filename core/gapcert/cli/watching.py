"""`gapcert watch`: follows a run from its folder; nothing is locked, and the run does not notice."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import final

from gapcert.cli.terminal import Terminal
from gapcert.contracts.plugins.events import Event
from gapcert.run import journal
from gapcert.run.journal import Line
from gapcert.run.progress_rate import duration
from gapcert.run.status import RunFolder, Standing, standing

LOOK = 0.5  # seconds between two looks: a person sees no difference from less
EVENTS = ("stage-started", "progress", "stage-finished", "warning")


@final
class Follower:
    """Hands out lines of a journal as they come: each once, though the file is thinned or begun anew meanwhile."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / journal.NAME
        self._seen = -1
        self._place: tuple[int, int] | None = None
        self._read = 0

    def new(self) -> Iterator[Line]:
        """What was appended since the last call."""
        try:
            with open(self.path, "rb") as file:
                found = os.fstat(file.fileno())
                place = found.st_dev, found.st_ino
                if place != self._place or found.st_size < self._read:
                    self._place, self._read = place, 0
                file.seek(self._read)
                text = file.read()
        except FileNotFoundError:
            return
        whole = text.rfind(b"\n") + 1  # what follows is still being written
        self._read += whole
        for line in journal.parsed(text[:whole]):
            if line["n"] > self._seen:
                self._seen = line["n"]
                yield line


def follow(folder: RunFolder, keep: bool = False, pause: float = LOOK) -> Iterator[Line | Standing]:
    """Lines as they come, and a Standing whenever the run is found not to run; ends with that unless `keep` waits for more."""
    follower = Follower(folder.path)
    told: str | None = None
    while True:
        yield from follower.new()
        found = standing(folder.path)
        if found.state != "running":
            # What was written between the look at the file and that at the process.
            yield from follower.new()
            if told != found.state:
                yield found
            told = found.state
            if found.state in ("finished", "failed") or not keep:
                return
        else:
            told = None
        time.sleep(pause)


def show(terminal: Terminal, line: Line) -> None:
    """A line of a journal on a terminal, at the time at which it was written."""
    now = float(line["s"])
    if line["event"] == "run-started":
        terminal.reset()
        terminal.begin -= max(0.0, time.time() - line["t"])
        again = ", which goes on" if line.get("again") else ""
        terminal.line(f"process {line.get('pid')} began the run{again}")
    elif line["event"] in EVENTS:
        terminal.at(now, Event(line["event"], line["stage"], line))


def sentence(folder: Path, found: Standing) -> str:
    """What one is told of a run that does not run."""
    if found.state == "finished":
        return f"finished: {found.verdict}"
    if found.state == "failed":
        return f"failed: {found.reason or 'without a reason'}"
    share = f" at {found.share:.0%}" if found.share is not None else ""
    at = f" in {found.stage}{share}" if found.stage else ""
    last = f", last sign {duration(time.time() - found.lines[-1]['t'])} ago" if found.lines else ""
    return f"interrupted{at}{last}; go on with: gapcert runs resume {folder}"
