"""One Chromium for all tests of this folder, and a page of each kind of run."""

import json
import shutil
from dataclasses import replace

import pytest
from outside import BROWSERS

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"]
ARGUMENTS += ["--disable-component-update", "--disable-sync"]
MODEL = {
    "kind": "equations",
    "states": {"theta": {"unit": "rad", "kind": "angle"}, "omega": "rad/s"},
    "inputs": {"torque": "N*m"},
    "derivative": {"theta": "omega", "omega": "-a*sin(theta) + b*torque"},
    "parameters": {"a": "14.715 1/s^2", "b": "3 1/(kg*m^2)"},
    "period": "5 ms",
}
LONG = "asymmetric-coulomb-friction"
CAUSE = {
    "effect": LONG, "site": "joint2", "explained": 0.9, "flags": ["inadequate: a residual of 2 % of the effort is left"],
    "parameters": {n: {"value": 0.5, "unit": "N*m", "low": 0.4, "high": 0.6} for n in ("plus", "minus")},
    "runner_up": {"effect": "viscous-friction", "site": "joint2", "explained": 0.4, "margin": 30.0},
}  # fmt: skip
DIAGNOSED = {
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


@pytest.fixture(scope="session")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=next(filter(None, map(shutil.which, BROWSERS))), args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def visit(browser):
    """Opens a page: (page, console messages and page errors, addresses that it asked for)."""
    contexts = []

    def go(path, width=1280, scheme="light", **how):
        contexts.append(browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme, **how))
        page = contexts[-1].new_page()
        said, asked = [], []
        page.on("console", lambda m: said.append(m.text))
        page.on("pageerror", lambda e: said.append(str(e)))
        page.on("request", lambda r: asked.append(r.url))
        page.goto(path.as_uri())
        return page, said, asked

    yield go
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
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


@pytest.fixture
def page_of(request, small_run):
    """The page of a kind of run, by name."""

    def find(kind):
        if kind == "a_certificate":
            return small_run.folder / "report.html"
        made = request.getfixturevalue(f"page_of_{kind}")
        return made() if kind == "a_failure" else made

    return find


@pytest.fixture
def page_of_a_diagnosis(tmp_path, every_picture):
    from gapcert_figures.data import Figures
    from gapcert_report.pages.page import write_report

    Figures(diagnosis=every_picture).save(tmp_path)
    (tmp_path / "extended.yaml").write_text("model: extended\n")
    summary = DIAGNOSED | {"extended_model": str(tmp_path / "extended.yaml")}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    return write_report(tmp_path)


@pytest.fixture
def page_of_a_failure(small_run, tmp_path):
    """The small run as if its audit had refuted it, one of a matrix, under a name that no run would have."""
    from gapcert_figures.data import Figures
    from gapcert_report.pages.page import write_report

    def change(name="small", figures=None):
        (figures or Figures.load(small_run.folder)).save(tmp_path)
        summary = json.loads((small_run.folder / "summary.json").read_text()) | {"name": name, "verdict": "fails"}
        summary["reason"] = f"refuted: {name}"
        summary["expectations"] = [{"text": f"verdict == holds {name}", "value": "fails", "met": False}]
        summary["certificate"]["audit"] = {"points": 1000, "violations": 3, "witness": {"theta": 0.1}}
        summary["certificate"]["states"]["theta"] |= {"vacuous": True, "resolved": False}
        (tmp_path / "summary.json").write_text(json.dumps(summary))
        beside = [{"folder": f, "values": {"gap.kind": name}} for f in (tmp_path.name, "other run")]
        (tmp_path / "matrix.json").write_text(json.dumps(beside))
        return write_report(tmp_path)

    return change


@pytest.fixture
def page_of_a_declaration(small_run, tmp_path):
    """As if γ had been declared: only what it buys is there to be seen."""

    def change(summary):
        c = summary["certificate"]
        c["claim"] = {"kind": "assumed"}
        for part in ("audit", "samples"):
            c.pop(part, None)
        c["states"] = {n: {"gamma_max": s["gamma_max"]} for n, s in c["states"].items()}

    return _changed(small_run, tmp_path, change, gap=None, loop=None)


@pytest.fixture
def page_of_a_recording(small_run, tmp_path):
    """As if a recording had set the band."""
    import numpy as np

    from gapcert_figures.data import RecordedFigure, Stretch

    t = np.linspace(0, 1, 20)
    stretches = tuple(Stretch(n, "rad", t, 0.1 * np.sin(t), -0.2 + 0 * t, 0.2 + 0 * t) for n in ("theta", "omega"))

    def change(summary):
        windows = {"fit": 100, "calibration": 50}
        rows = {"all": 9000, "no_transition": 3, "outside": 20}
        summary["certificate"] |= {"claim": {"kind": "statistical", "epsilon": 0.05, "beta": 0.01}}
        summary["certificate"] |= {"recording": {"windows": windows, "rank": 49, "rows": rows}, "samples": {"bound": 100}}

    figure = RecordedFigure(np.linspace(-1, 1, 50), 49, 12.0, stretches)
    return _changed(small_run, tmp_path, change, gap=None, loop=None, winning=None, recorded=figure)


@pytest.fixture
def page_of_an_undecided_run(small_run, tmp_path):
    def change(summary):
        for part in ("certificate", "controller", "closed_loop", "expectations"):
            summary.pop(part)
        summary |= {"verdict": "unknown", "reason": "the budget ended"}

    return _changed(small_run, tmp_path, change, gap=None, loop=None, winning=None)


def _changed(run, folder, change, **figures):
    from gapcert_figures.data import Figures
    from gapcert_report.pages.page import write_report

    replace(Figures.load(run.folder), **figures).save(folder)
    summary = json.loads((run.folder / "summary.json").read_text())
    change(summary)
    (folder / "summary.json").write_text(json.dumps(summary))
    return write_report(folder)


@pytest.fixture
def page_of_a_log(tmp_path):
    import numpy as np

    from gapcert_recordings.inspect import inspect
    from gapcert_report.pages.log import write_log_page

    t = np.arange(0, 4, 0.01)
    rows = "\n".join(f"{a:.2f},{np.sin(3 * a):.4f},{np.cos(a):.4f}" for a in t)
    (tmp_path / "log.csv").write_text(f"t,q,F\n{rows}\n")
    return write_log_page(tmp_path / "log" / "report.html", "log.csv", inspect(tmp_path / "log.csv"))


@pytest.fixture
def hostile(small_run):
    """Figures of the small run with markup in every name."""
    from gapcert_figures.data import Figures

    def with_name(name):
        figures = Figures.load(small_run.folder)
        gap, loop = figures.gap, figures.loop
        bands = tuple(replace(b, state=name, axis=replace(b.axis, name=name, unit=name)) for b in gap.bands[:2])
        axes = tuple(replace(a, name=name) for a in loop.axes)
        return replace(figures, gap=replace(gap, bands=bands, fixed=name), loop=replace(loop, axes=axes), winning=None)

    return with_name
