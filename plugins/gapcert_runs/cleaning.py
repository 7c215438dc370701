"""`gapcert runs clean`: which run folders go, and how; the rest of a folder, and its audit ledger above all, stays.

A ledger counts the audits of a question: without it the next one would spend confidence that is spent.
"""

from __future__ import annotations

import os
import re
import shutil
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from gapcert.plugin import LOCK, MARK, Answer, Arguments, GapcertError, RunFolder, UsageError, is_run, owned, times, walk

from . import listing

LEDGER = "ledger.json"
_AGES = {"s": 1, "min": 60, "h": 3600, "d": 86400, "w": 604800}
_SIZES = {"B": 1, "kB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12}


@final
@dataclass(frozen=True)
class Choice:
    """Which of the listed folders go: older than so many seconds, larger than so many bytes, not among the newest of a name."""

    older: float | None = None
    larger: float | None = None
    keep_last: int = 0

    def of(self, runs: Sequence[RunFolder]) -> tuple[list[RunFolder], list[tuple[RunFolder, str]]]:
        """(those that go, those that were asked for and must stay, with the reason)."""
        now, newest = time.time(), defaultdict[str, list[RunFolder]](list)
        for run in sorted(runs, key=lambda r: -r.changed):
            newest[run.name].append(run)
        kept = {run.path for of_name in newest.values() for run in of_name[: self.keep_last]}
        goes, stays = list[RunFolder](), list[tuple[RunFolder, str]]()
        for run in runs:
            young = self.older is not None and now - run.changed <= self.older
            small = self.larger is not None and run.size <= self.larger
            if young or small or run.path in kept:
                continue
            if why := protected(run):
                stays.append((run, why))
            else:
                goes.append(run)
        return goes, stays


def protected(run: RunFolder) -> str:
    """Why a folder may not go; empty where it may."""
    if not is_run(run.path):
        return "it is no run folder"
    if run.standing.state == "running":
        return f"process {(run.standing.owner or {}).get('pid')} runs in it"
    return _precious(run.path)


def _precious(folder: Path) -> str:
    for entry in walk(folder):
        if entry.name == LEDGER:
            return f"it holds an audit ledger, {entry.path}"
        if entry.name == MARK and Path(entry.path).parent != folder:
            return f"it holds another run, {Path(entry.path).parent}"
    return ""


def remove(run: RunFolder) -> None:
    """Remove a run folder under its lock; UsageError where that is taken, or something is in it that may not go.

    The mark goes last, so that what a kill leaves behind is a run folder still. Links are removed, never followed.
    """
    with owned(run.path):
        # Whoever held the lock a moment ago may have changed what was planned.
        if why := _precious(run.path):
            raise UsageError(f"{run.path}: stays, since {why}")
        try:
            with os.scandir(run.path) as entries:
                found = [e for e in entries if e.name not in (MARK, LOCK)]
            for entry in found:
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path)
                else:
                    os.unlink(entry.path)
            for name in (MARK, LOCK):
                (run.path / name).unlink()
            run.path.rmdir()
        except OSError as error:
            what = (error.strerror or str(error)).lower()
            raise UsageError(
                f"{error.filename or run.path}: cannot be removed ({what}); set its rights, and clean again"
            ) from None


def seconds(text: str) -> float:
    """`90s`, `30min`, `12h`, `7d`, `2w`."""
    return _amount(text, _AGES, "--older-than", "7d")


def size(text: str) -> float:
    """`800kB`, `100MB`, `2GB`."""
    return _amount(text, _SIZES, "--larger-than", "100MB")


def _amount(text: str, units: dict[str, float] | dict[str, int], option: str, example: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([A-Za-z]+)", text)
    if match is None or match[2] not in units:
        raise UsageError(f"{option}: found '{text}'; expected a number and one of {', '.join(units)}, such as {example}")
    return float(match[1]) * units[match[2]]


def command(options: Arguments) -> Answer:
    asked = (options.name, options.state, options.older_than, options.larger_than, options.keep_last, options.all)
    if not any(asked):
        raise UsageError(
            "gapcert runs clean: nothing says which folders; give --state, --name, --older-than, --larger-than, --keep-last "
            "or --all"
        )
    if options.keep_last < 0:
        raise UsageError(f"--keep-last: found {options.keep_last}; expected a number from 0 on")
    older = None if options.older_than is None else seconds(options.older_than)
    larger = None if options.larger_than is None else size(options.larger_than)
    choice = Choice(older, larger, options.keep_last)
    goes, stays = choice.of(listing.chosen(options.out, options.name, options.state, options.sort))
    rows, failed = [listing.entry(r) for r in goes], list[dict[str, str]]()
    if options.yes:
        for run in goes:
            try:
                remove(run)
            except GapcertError as error:
                failed.append({"run_dir": str(run.path), "reason": str(error)})
    lost = {f["run_dir"] for f in failed}
    gone = [r for r in rows if r["run_dir"] not in lost]
    total = sum(r["size_bytes"] for r in gone)
    kept = [{"run_dir": str(r.path), "reason": why} for r, why in stays] + failed
    data = {"removed": options.yes, "folders": gone, "size_bytes": total, "kept": kept}
    verb = "removed" if options.yes else "would go"
    words = [f"{verb}: {r['run_dir']} ({listing.condition(r)}, {listing.sized(r['size_bytes'])})" for r in gone]
    words += [f"stays: {k['run_dir']}: {k['reason']}" for k in kept]
    words += [
        f"{times(len(gone), 'folder')}, {listing.sized(total)}" + ("" if options.yes or not gone else "; --yes removes them")
    ]
    return Answer(data, words, UsageError.exit_code if failed else 0)
