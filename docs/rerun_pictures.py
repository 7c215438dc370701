"""Pictures of recordings for the gallery: runs a spec of each kind, opens its recording in a headless viewer, keeps the window.

python docs/rerun_pictures.py [KIND ...] [--recordings DIR]   (all of them take about 20 minutes on two cores)
Needs gapcert[all], pillow, and a Vulkan driver: apt-get install mesa-vulkan-drivers libvulkan1.
"""

from __future__ import annotations

import argparse
import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
# Kind → its spec, and the second at which the robot is seen.
KINDS: dict[str, tuple[str, float | None]] = {
    "symbolic": ("pendulum.yaml", 1.4),
    "mpc": ("cartpole.yaml", 0.6),
    "adaptive": ("pendulum_adaptive.yaml", 0.3),
    "goal": ("mecanum.yaml", 6.0),
    "diagnosis": ("diagnose/pendulum.yaml", 1.2),
    "contact": ("diagnose/cube_toss.yaml", 0.4),
    "compare": ("compare.yaml", None),
    "recording": ("free_fall.yaml", None),
    "declared": ("benchmarks/pendulum_gap.yaml", None),
}
WIDTH, MOST = 1400, 250_000  # pixels; bytes
BAR = 36  # points of the viewer's own bar above the views
SETTLED = 14.0  # s until plots have their ranges, and what the viewer says of itself is gone


@contextmanager
def viewer(recording: Path) -> Iterator[Any]:
    """A headless native viewer on loopback that shows a recording."""
    from rerun.experimental import ViewerClient

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    options = ["--headless", "--hide-welcome-screen", "--bind", "127.0.0.1", "--port", str(port), "--window-size", "1600x1000"]
    command = [sys.executable, "-m", "rerun", *options, str(recording)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": os.environ | {"RERUN_ANALYTICS": "0"}}
    process = subprocess.Popen(command, start_new_session=True, **quiet)  # type: ignore[call-overload]
    try:
        for _ in range(200):
            time.sleep(0.2)
            try:
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                if client.get_state().views:
                    break
            except Exception:  # it is not up yet, whatever the client calls that
                continue
        else:
            raise SystemExit(f"{recording}: the viewer did not show it within 40 s; is there a Vulkan driver?")
        yield client
    finally:
        # The command is a shim: its child must go too.
        os.killpg(process.pid, signal.SIGTERM)
        process.wait()


def picture(recording: Path, seconds: float | None) -> bytes:
    """The window at that time of the recording as a PNG with a palette, without the viewer's own bar."""
    from PIL import Image

    with viewer(recording) as client:
        time.sleep(SETTLED)
        if seconds is not None:
            client.set_time("time", duration=seconds, play_state="paused")
            time.sleep(2.0)
        if broken := [v.name for v in client.get_state().views if v.reports]:
            raise SystemExit(f"{recording}: {broken[0]} cannot be drawn")
        window = Image.open(io.BytesIO(client.take_screenshot())).convert("RGB")
    bar = round(BAR * window.width / 1600)
    window = window.crop((0, bar, window.width, window.height))
    small = window.resize((WIDTH, round(WIDTH * window.height / window.width)), Image.Resampling.LANCZOS)
    for colours in (256, 128, 64):
        out = io.BytesIO()
        small.quantize(colours, Image.Quantize.MAXCOVERAGE, 5, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
        if len(out.getvalue()) <= MOST:
            break
    return out.getvalue()


def recorded(kind: str, folder: Path | None) -> Path:
    """`KIND.rrd` of the folder, else the recording of a run of its spec."""
    if folder is not None and (folder / f"{kind}.rrd").exists():
        return folder / f"{kind}.rrd"
    import gapcert

    run = gapcert.run(ROOT / "specs" / KINDS[kind][0], out=tempfile.mkdtemp())
    return run.folder / "run.rrd"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("--recordings", type=Path, help="a folder with KIND.rrd, for those that need not be made again")
    asked = parser.parse_args()
    if unknown := [k for k in asked.kinds if k not in KINDS]:
        parser.error(f"there is no kind {unknown[0]!r}; there are {', '.join(KINDS)}")
    for kind in asked.kinds or KINDS:
        path = ROOT / "docs" / "images" / f"rerun-{kind}.png"
        path.write_bytes(picture(recorded(kind, asked.recordings), KINDS[kind][1]))
        print(f"{path.relative_to(ROOT)}  {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
