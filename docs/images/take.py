"""The pictures of reports in these pages: `python docs/images/take.py RUN docs/images/NAME.png [WIDTH HEIGHT]`.

The first screen of a run's report, in light, at one and a half times its size; `--point TITLE` points at a picture. Needs
Chromium and playwright.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]


def take(options: argparse.Namespace) -> None:
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        size = {"width": options.width, "height": options.height}
        page = browser.new_context(viewport=size, device_scale_factor=1.5, color_scheme="light").new_page()
        page.goto((options.run / "report.html").resolve().as_uri())
        if options.point:
            figure = page.locator("figure", has=page.get_by_role("heading", name=options.point, exact=True)).first
            figure.scroll_into_view_if_needed()
            box = figure.locator(".plot").bounding_box()
            page.mouse.move(box["x"] + 0.35 * box["width"], box["y"] + 0.55 * box["height"])
        page.screenshot(path=options.picture)
        browser.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("width", type=int, nargs="?", default=1180)
    parser.add_argument("height", type=int, nargs="?", default=770)
    parser.add_argument("--point", metavar="TITLE", help="the title of a picture to point at")
    take(parser.parse_args())
