"""The page of a comparison in a real browser: seen whole on a desk and on a phone, and it asks for nothing."""

import shutil

import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed (apt-get install chromium)")
MODEL = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "derivative": {"theta": "omega", "omega": "-a*sin(theta) + b*torque"},
    "parameters": {"a": "14.715 1/s^2", "b": "3 1/(kg*m^2)"},
    "period": "5 ms",
}


@pytest.fixture(scope="module")
def page_of_a_comparison(tmp_path_factory):
    import gapcert as gc

    backends = {n: MODEL | {"integrator": n.replace("-", "_")} for n in ("euler", "semi-implicit", "rk4")}
    spec = {
        "version": 1,
        "name": "three-integrators",
        "model": MODEL | {"integrator": "euler"},
        "domain": {"theta": [-0.2, 0.2], "omega": [-0.25, 0.25], "torque": [-1, 1]},
        "sampling": {"kind": "adaptive", "budget": 40, "executor": "threads"},
        "compare": {"backends": backends, "lipschitz": ["interval"], "pairs": {"points": 200}},
        "report": {"rerun": False},
    }
    return gc.run(spec, out=tmp_path_factory.mktemp("runs")).folder / "report.html"


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "dark")])
def test_the_page_of_a_comparison_opens_whole(page_of_a_comparison, width, scheme):
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    arguments = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
        said, asked = [], []
        page.on("console", lambda m: said.append(m.text))
        page.on("request", lambda r: asked.append(r.url))
        page.goto(page_of_a_comparison.as_uri())
        assert said == []
        assert [a for a in asked if not a.startswith("data:")] == [page_of_a_comparison.as_uri()]
        page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        boxes = [svg.bounding_box() for svg in page.query_selector_all("figure svg")]
        assert len(boxes) == 3 + 2 * 3
        assert all(b["width"] > 250 and b["height"] > 100 and b["x"] + b["width"] <= width for b in boxes)
        answer = page.inner_text(".answer")
        assert "Changing integrator" in answer
        browser.close()
