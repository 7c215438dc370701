"""A native viewer of ours on this machine."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import final

WINDOW = 0.5  # seconds that a viewer which takes data may need to find out that it gets no window
PATIENCE = 10.0  # seconds for a viewer to appear, and for it to take the last data


@final
@dataclass(frozen=True)
class Viewer:
    """A native viewer of ours, and where it takes data."""

    process: subprocess.Popen[bytes]
    url: str

    def end(self) -> None:
        # The command is a shim: its child must go too.
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)


def open_viewer() -> Viewer | str:
    """Start the native viewer on a free loopback port; or why it does not come up."""
    if sys.platform == "linux" and not any(os.environ.get(d) for d in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")):
        return "there is no display"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    viewer, end = Viewer(process, f"rerun+http://127.0.0.1:{port}/proxy"), time.monotonic() + PATIENCE
    while not _listens(port) and process.poll() is None:
        if time.monotonic() > end:
            viewer.end()
            return f"it did not start within {PATIENCE:g} s"
        time.sleep(0.1)
    # It takes data before it has a window, and goes away again where it gets none.
    with suppress(subprocess.TimeoutExpired):
        process.wait(WINDOW)
        return "it did not start; is there a display?"
    return viewer


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex(("127.0.0.1", port)) == 0
