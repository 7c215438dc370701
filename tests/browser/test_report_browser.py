"""The report in a real browser: nothing is fetched, nothing is reported, everything is seen, on a desk and on a phone."""

import pytest


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_report_opens_whole(visit, small_run, width, scheme):
    path = small_run.folder / "report.html"
    page, said, asked = visit(path, width, scheme)
    assert said == []
    assert [a for a in asked if not a.startswith("data:")] == [path.as_uri()]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
    boxes = [svg.bounding_box() for svg in page.query_selector_all("figure .plot > svg")]
    assert len(boxes) >= 8
    assert all(b["width"] > 250 and b["height"] > 120 and b["x"] >= 0 and b["x"] + b["width"] <= width for b in boxes)
    assert page.evaluate("document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_can_be_read_on_its_ground(visit, small_run, scheme):
    """WCAG contrast of text, in the page and inside pictures, is at least 4.5."""
    page, _, _ = visit(small_run.folder / "report.html", 1280, scheme)
    probe = """() => {
      const rgb = c => c.match(/[\\d.]+/g).map(Number);
      const light = c => { const l = rgb(c).slice(0, 3).map(v => v / 255)
        .map(v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
        return 0.2126 * l[0] + 0.7152 * l[1] + 0.0722 * l[2]; };
      const ground = e => { for (; e; e = e.parentElement) {
        const b = getComputedStyle(e).backgroundColor; if (rgb(b)[3] !== 0) return b; } return 'rgb(255, 255, 255)'; };
      const all = 'p, th, td, li strong, figcaption, summary, button, a, .legend span, .plot svg text';
      return [...document.querySelectorAll(all)].map(e => {
        const s = getComputedStyle(e), c = e.tagName === 'text' ? s.fill : s.color, a = light(c), b = light(ground(e));
        return [e.textContent.trim(), (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05)]; });
    }"""
    found = page.evaluate(probe)
    assert len(found) > 100
    assert [f for f in found if f[1] < 4.5] == []


def test_a_page_that_asks_for_something_is_noticed(visit, tmp_path):
    """The planted fault: the checks above can fail."""
    path = tmp_path / "bad.html"
    path.write_text("<!doctype html><img src=missing.png><script>console.error('x')</script><div style=width:900px>wide</div>")
    page, said, asked = visit(path, 400)
    assert said
    assert len(asked) == 2
    assert page.evaluate("document.documentElement.scrollWidth") > 400


@pytest.mark.parametrize("kind", ["a_certificate", "a_diagnosis", "a_recording"])
def test_what_a_table_says_of_itself_can_be_read_on_a_phone(visit, page_of, kind):
    page, _, _ = visit(page_of(kind), 390)
    page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
    page.eval_on_selector_all(".scroll", "all => all.forEach(d => d.scrollLeft = 60)")
    boxes = page.eval_on_selector_all("caption", "all => all.map(c => [c.getBoundingClientRect(), c.textContent])")
    assert boxes
    assert [text for box, text in boxes if box["left"] < 0 or box["right"] > 390] == []


def test_names_in_tables_are_not_broken_word_by_word_on_a_phone(visit, page_of_a_diagnosis):
    page, _, _ = visit(page_of_a_diagnosis, 390)
    assert min(page.eval_on_selector_all("tbody th", "all => all.map(c => c.getBoundingClientRect().width)")) >= 100


@pytest.mark.exam
def test_a_recording_s_table_has_units(page_of_a_recording):
    assert ">theta [rad]</th>" in page_of_a_recording.read_text()


def test_printed_pages_have_margins(visit, small_run):
    page, _, _ = visit(small_run.folder / "report.html", 794)
    page.emulate_media(media="print")
    rules = "[...document.styleSheets[0].cssRules].filter(r => r.type === CSSRule.PAGE_RULE).map(r => r.style.marginLeft)"
    assert page.evaluate(rules) == ["12mm"]
