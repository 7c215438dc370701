"""The report of a diagnosis in a real browser: everything fits and can be read, on a desk and on a phone."""

import json
import shutil

import pytest

from gapcert.figures import Figures
from gapcert.report import write_report

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed (apt-get install chromium)")
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
LONG = "asymmetric-coulomb-friction"
CAUSE = {
    "effect": LONG, "site": "joint2", "explained": 0.9, "flags": ["inadequate: a residual of 2 % of the effort is left"],
    "parameters": {n: {"value": 0.5, "unit": "N*m", "low": 0.4, "high": 0.6} for n in ("plus", "minus")},
    "runner_up": {"effect": "viscous-friction", "site": "joint2", "explained": 0.4, "margin": 30.0},
}  # fmt: skip
SUMMARY = {
    "name": "d", "verdict": "ambiguous", "causes": [CAUSE, CAUSE | {"effect": "load-dependent-friction"}], "timings": {},
    "ambiguous_with": [[{"effect": LONG, "site": "joint2"}, {"effect": "stribeck-friction", "site": "joint2"}]],
    "units": {"joint2": "rad"}, "residual": {"joint2": {"before": 1.0, "after": 0.1, "noise_floor": 0.1}},
    "gain": {"0.5": {"joint2": {"before": 0.2, "after": 0.01, "low": 0.009, "high": 0.012}}},
    "design": {
        "rivals": [{"effect": LONG, "site": "joint2"}] * 2, "name": "a slow multisine", "sentence": "", "seconds": 12.0,
        "separation": 3.0, "others": {"steps": 1.0},
    },
    "equations": "q = " + "+ a_very_long_name " * 20, "evidence": {"mean square, short windows": {"joint2": 1.0}},
}  # fmt: skip


@pytest.mark.parametrize(("width", "scheme"), [(1280, "dark"), (400, "light")])
def test_it_fits(width, scheme, tmp_path, every_picture):
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    Figures(diagnosis=every_picture).save(tmp_path)
    (tmp_path / "extended.yaml").write_text("model: extended\n")
    summary = SUMMARY | {"extended_model": str(tmp_path / "extended.yaml")}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    path = write_report(tmp_path)
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
        said = []
        page.on("console", lambda m: said.append(m.text))
        page.goto(path.as_uri())
        page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
        boxes = [svg.bounding_box() for svg in page.query_selector_all("figure svg")]
        wide = page.evaluate("document.documentElement.scrollWidth")
        browser.close()
    assert said == []
    assert wide <= width
    assert len(boxes) == 10
    assert all(b["width"] > 250 and b["height"] > 100 and b["x"] >= 0 and b["x"] + b["width"] <= width for b in boxes)
