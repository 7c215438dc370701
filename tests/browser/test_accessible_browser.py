"""axe-core finds nothing in the page of any kind of run, light or dark, on a desk or a phone; and it would find faults."""

import pytest

KINDS = (
    "a_certificate",
    "a_failure",
    "an_undecided_run",
    "a_declaration",
    "a_recording",
    "a_comparison",
    "a_diagnosis",
    "a_log",
)


@pytest.fixture(scope="session")
def axe():
    return pytest.importorskip("axe_playwright_python.base", reason="axe-playwright-python is not installed").AXE_SCRIPT


def violations(visit, axe, path, width, scheme):
    page, _, _ = visit(path, width, scheme, bypass_csp=True)
    page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
    page.evaluate(axe)
    # Of text inside a picture axe cannot tell the ground; the contrast of it has a test of its own.
    asked = "axe.run({include: document, exclude: '.plot > svg > g'}, {resultTypes: ['violations']})"
    found = page.evaluate(asked)["violations"]
    return [(v["id"], v["impact"], [n["html"][:200] for n in v["nodes"]]) for v in found]


@pytest.mark.exam
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_page_is_accessible(visit, axe, page_of, kind):
    path = page_of(kind)
    for width, scheme in ((1280, "dark"), (390, "light")):
        assert violations(visit, axe, path, width, scheme) == []


FAULTS = {
    "color-contrast": ("--faint: #5f6673", "--faint: #b5b9c0"),
    "button-name": ('<main id="main"', '<button></button><main id="main"'),
    "heading-order": ('<h2 class="unseen">', '<h4 class="unseen">'),
    "scrollable-region-focusable": ('tabindex="0" role="region" aria-label="Commands"', ""),
}


@pytest.mark.exam
def test_planted_faults_are_found(visit, axe, small_run, tmp_path):
    text = (small_run.folder / "report.html").read_text(encoding="utf-8")
    for sound, fault in FAULTS.values():
        assert sound in text
        text = text.replace(sound, fault)
    text = text.replace(">From the folder above the run:", " hidden>", 1).replace(
        "gapcert report", "gapcert report " + "x" * 999
    )
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    assert set(FAULTS) <= {v[0] for v in violations(visit, axe, path, 390, "light")}
