"""A report can run nothing but its own script, whatever its names contain."""

import pytest

HOSTILE = """"'><script>window.got = 1</script><img src=x onerror="window.got = 1"><svg onload=window.got=1>"""
HOSTILE += """</script><style>*{display:none}</style> style="color:red" <a href="javascript:window.got=1">"""


def test_hostile_names_are_text(visit, page_of_a_failure, hostile):
    path = page_of_a_failure(HOSTILE, hostile(HOSTILE))
    page, said, asked = visit(path)
    assert said == []
    assert asked == [path.as_uri()] + [a for a in asked if a.startswith("data:")]
    assert page.evaluate("window.got") is None
    assert page.locator("h1").inner_text() == HOSTILE
    assert HOSTILE in page.locator("figure h3").nth(0).inner_text()
    assert page.locator("img, [onerror], [onload], a[href^=javascript]").count() == 0
    title = page.locator("figure").nth(0)
    title.locator(".plot").focus()
    page.keyboard.press("ArrowRight")
    assert HOSTILE in title.locator(".tip").inner_text()
    assert page.evaluate("window.got") is None
    assert page.evaluate("document.documentElement.scrollWidth") <= 1280


@pytest.mark.exam
@pytest.mark.parametrize(
    "planted",
    [
        "<script>window.got = 1</script>",
        "<img src=data:, onerror='window.got = 1'>",
        "<a id=x href='javascript:window.got = 1'>x</a><style>main {display: none}</style>",
        "<iframe srcdoc='<script>parent.got = 1</script>'></iframe>",
    ],
)
def test_what_is_planted_in_the_file_does_not_run(visit, small_run, tmp_path, planted):
    """Were a name not escaped, the policy would still stop it; the planted fault shows that it is in force."""
    text = (small_run.folder / "report.html").read_text(encoding="utf-8")
    path = tmp_path / "report.html"
    path.write_text(text.replace("<main", f"{planted}<main", 1), encoding="utf-8")
    page, said, _ = visit(path)
    if page.locator("#x").count():
        page.locator("#x").click()
    page.wait_for_timeout(50)
    assert any("Content Security Policy" in s for s in said)
    assert page.evaluate("window.got") is None
    assert page.locator("main").is_visible()
    bare, _, _ = visit(tmp_path / "report.html", bypass_csp=True)
    if bare.locator("#x").count():
        bare.locator("#x").click()
    bare.wait_for_function("window.got === 1")  # a link runs when the browser comes to it
