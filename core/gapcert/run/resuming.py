"""`gapcert runs resume`: a run goes on from its folder alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gapcert.contracts.plugins.events import Emit
from gapcert.numerics.errors import UsageError
from gapcert.run.manifest import spec_of
from gapcert.run.run import Run, run
from gapcert.run.status import RunFolder


def resume(
    folder: Path | str,
    *,
    executor: str | None = None,
    allow_code: bool = False,
    observers: Sequence[Emit] = (),
    view: bool = False,
) -> Run:
    """Go on with an interrupted or failed run, to the same digests as without interruption; a finished one is returned.

    executor: another one than the run was begun with. UsageError where the folder is none of a run, where a process runs in it,
    or where the files of its spec have changed.
    """
    found = RunFolder.at(folder)
    if found.standing.state == "running":
        pid = (found.standing.owner or {}).get("pid")
        raise UsageError(f"{folder}: process {pid} runs it already; follow it with: gapcert watch {folder}")
    if found.standing.state == "finished" and "verdict" in found.summary:
        return Run(found.path, found.summary)
    chosen = executor if executor is not None else found.mark.get("executor")
    home = found.path if found.path.name else found.path.resolve()
    return run(spec_of(found.path), out=home.parent, executor=chosen, allow_code=allow_code, observers=observers, view=view)
