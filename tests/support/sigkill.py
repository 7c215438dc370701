"""A process that is killed amid its work, however fast or slow the machine is: `import sigkill` in what a test starts.

SIGKILL_AFTER is "AFTER MOMENT WHOM": once AFTER chunks are recorded the process goes on for a MOMENT (s), but not beyond
`MORE` further chunks. Then it is killed alone, or with its whole group where WHOM is `all`. A WHOM of `halt` waits for the
MOMENT, so that what is done is reported, and halts after `MORE` further chunks. Without SIGKILL_AFTER nothing happens.
"""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from gapcert.certification.samples import store as sampling

MORE = 3
ENV = os.environ | {"PYTHONPATH": os.pathsep.join([os.path.dirname(__file__), *filter(None, [os.environ.get("PYTHONPATH")])])}
"""Of a process that imports this."""


def armed(after: str, moment: str, whom: str) -> None:
    """From now on."""
    append, done = sampling._append, 0

    def die() -> None:
        if whom == "all":
            os.killpg(0, signal.SIGKILL)
        os.kill(os.getpid(), signal.SIGSTOP if whom == "halt" else signal.SIGKILL)

    def counted(*given: Any) -> None:
        nonlocal done
        append(*given)
        done += 1
        if done == int(after) and whom == "halt":
            time.sleep(float(moment))
        elif done == int(after):
            timer = threading.Timer(float(moment), die)
            timer.daemon = True  # it kills no process that has done its work
            timer.start()
        if done == int(after) + MORE:
            die()

    sampling._append = counted


def order(rng: np.random.Generator, chunks: tuple[int, int], whom: str = "all") -> str:
    """To die after low ≤ n < high chunks."""
    return f"{rng.integers(*chunks)} {0.02 * rng.random():.4f} {whom}"


def killed(command: Sequence[Any], rng: np.random.Generator, chunks: tuple[int, int], whom: str = "all") -> None:
    """A command that imports this dies after low ≤ n < high chunks."""
    done = _run(command, SIGKILL_AFTER=order(rng, chunks, whom))
    assert done.returncode == -signal.SIGKILL, f"it was to die, and ended with {done.returncode}: {done.stderr}"


def whole(command: Sequence[Any]) -> subprocess.CompletedProcess[str]:
    """What it says undisturbed."""
    done = _run(command)
    assert done.returncode == 0, done.stderr
    return done


def _run(command: Sequence[Any], **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, env=ENV | more, capture_output=True, text=True, start_new_session=True)


if given := os.environ.get("SIGKILL_AFTER"):
    armed(*given.split())
