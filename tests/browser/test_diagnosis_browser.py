"""The report of a diagnosis in a real browser: everything fits and can be read, on a desk and on a phone."""

import pytest


@pytest.mark.exam
@pytest.mark.parametrize(("width", "scheme"), [(1280, "dark"), (390, "light")])
def test_it_fits(visit, page_of_a_diagnosis, width, scheme):
    page, said, _ = visit(page_of_a_diagnosis, width, scheme)
    page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
    boxes = [svg.bounding_box() for svg in page.query_selector_all("figure .plot > svg")]
    assert said == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert len(boxes) == 10
    assert all(b["width"] > 250 and b["height"] > 100 and b["x"] >= 0 and b["x"] + b["width"] <= width for b in boxes)
