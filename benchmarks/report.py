"""What a report weighs and how soon it is seen, against what a reader is promised: 5 MB and 2 s in headless Chromium.

The largest report below a folder of runs (`--runs`), else that of specs/pendulum.yaml. The time is from asking for the page to
the second frame after it has loaded: scripts have run, and all of it is laid out and painted. Each turn has a fresh browser
context. Needs Chromium and playwright.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"

import harness

SPEC = Path(__file__).resolve().parent.parent / "specs" / "pendulum.yaml"
MEGABYTES, SECONDS = 5.0, 2.0
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
FRAMES = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(document.body.scrollHeight))))"


def opened(browser: Any, page: Path, width: int) -> float:
    """Seconds until a page has been painted, in a context of its own."""
    context = browser.new_context(viewport={"width": width, "height": 800})
    tab = context.new_page()
    begin = time.perf_counter()
    tab.goto(page.resolve().as_uri(), wait_until="load")
    tab.evaluate(FRAMES)
    seconds = time.perf_counter() - begin
    context.close()
    return seconds


def rows_of(page: Path, repeats: int) -> list[harness.Row]:
    from playwright.sync_api import sync_playwright

    case, chromium = page.parent.name, shutil.which("chromium") or shutil.which("google-chrome")
    found = [harness.row(case, "weight", "MB", page.stat().st_size / 1e6, MEGABYTES, "the limit")]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        for width, what in ((1280, "desk"), (390, "phone")):
            seconds = statistics.median(opened(browser, page, width) for _ in range(repeats))
            found.append(harness.row(f"{case}, {what}", "time", "s", seconds, SECONDS, "the limit"))
        browser.close()
    return found


def measure(options: argparse.Namespace) -> list[harness.Row]:
    import gapcert as gc

    if options.runs:
        page = max(options.runs.glob("**/report.html"), key=lambda p: p.stat().st_size)
        return rows_of(page, 5 if options.quick else 15)
    with tempfile.TemporaryDirectory() as folder:
        run = gc.run(SPEC, overrides=("report.rerun=false", "certificate.attack=0", "expect=null"), out=folder)
        return rows_of(run.folder / "report.html", 5 if options.quick else 15)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, help="a folder of runs, of which the largest report is opened")
    harness.main(measure, parser)
