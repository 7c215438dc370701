"""The page of a comparison in a real browser: seen whole on a desk and on a phone, and it asks for nothing."""

import pytest


@pytest.mark.exam
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_the_page_of_a_comparison_opens_whole(visit, page_of_a_comparison, width, scheme):
    page, said, asked = visit(page_of_a_comparison, width, scheme)
    assert said == []
    assert [a for a in asked if not a.startswith("data:")] == [page_of_a_comparison.as_uri()]
    page.eval_on_selector_all("details", "all => all.forEach(d => d.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    boxes = [svg.bounding_box() for svg in page.query_selector_all("figure .plot > svg")]
    assert len(boxes) == 3 + 2 * 3
    assert all(b["width"] > 250 and b["height"] > 100 and b["x"] + b["width"] <= width for b in boxes)
    assert "Changing integrator" in page.inner_text(".answer")
