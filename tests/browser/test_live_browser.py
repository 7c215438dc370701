"""The script of a report in a real browser: what is read off a picture is what was drawn, by pointer, keyboard and touch."""

import csv
import re

import numpy as np
import pytest

from gapcert_figures.data import Figures


@pytest.fixture
def opened(visit, small_run):
    page, said, _ = visit(small_run.folder / "report.html")
    yield page
    assert said == []


def plot(page, title):
    return page.locator("figure", has=page.get_by_role("heading", name=title, exact=True)).locator(".plot")


def at(page, title, x, y):
    """Client coordinates of a place given as shares of the axes, from the lower left."""
    place = plot(page, title)
    place.scroll_into_view_if_needed()
    return place.evaluate(
        """(e, [x, y]) => { const [l, t, r, b] = JSON.parse(e.parentElement.querySelector('script').textContent).box;
          const s = e.querySelector('svg'), c = s.getBoundingClientRect(), k = c.width / s.viewBox.baseVal.width;
          return [c.left + k * (l + x * (r - l)), c.top + k * (b - y * (b - t))]; }""",
        [x, y],
    )


def tip(page, title):
    shown = plot(page, title).locator(".tip")
    return shown.inner_text().splitlines() if shown.is_visible() else []


def quantity(text):
    """`theta: −1.2 × 10⁻⁵ rad` as numbers, each times its power of ten."""
    plain = text.translate(str.maketrans("−\u00a0", "- "))
    powers = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
    unit = re.search(r"× 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)", plain)
    values = [float(v) for v in re.findall(r"(?<![\w.])-?\d+\.?\d*", plain.split(": ")[-1].split("×")[0])]
    return np.array(values) * 10.0 ** int(unit[1].translate(powers)) if unit else np.array(values)


def first_band(run):
    bands = Figures.load(run.folder).gap.bands
    b = max((b for b in bands if b.state == "theta"), key=lambda b: np.ptp(b.residual))
    return b, f"Gap of theta along {b.axis.name}"


@pytest.mark.exam
def test_the_pointer_reads_what_was_drawn(opened, small_run):
    b, title = first_band(small_run)
    opened.mouse.move(*at(opened, title, 0.8, 0.5))
    head, *lines = tip(opened, title)
    told = dict(line.split(": ", 1) for line in lines)
    assert set(told) == {"±γ", "[l, u]", "f̂ − f", "constant bound"}
    k = int(np.argmin(np.abs(b.at - quantity(head.split(" ", 1)[1])[0])))
    assert abs(b.at[k] - (b.axis.low + 0.8 * (b.axis.high - b.axis.low))) < 1.1 * np.diff(b.at).max()
    assert quantity(told["f̂ − f"]) == pytest.approx([b.residual[k]], rel=2e-3)
    assert told["±γ"].startswith("± ")
    assert quantity(told["±γ"]) == pytest.approx([b.gamma[k]], rel=2e-3)
    assert quantity(told["[l, u]"]) == pytest.approx([b.low[k], b.high[k]], rel=2e-3)
    opened.mouse.move(0, 0)
    assert tip(opened, title) == []


def test_the_keyboard_steps_from_value_to_value_and_says_so(opened, small_run):
    b, title = first_band(small_run)
    place = plot(opened, title)
    place.focus()
    assert place.evaluate("e => e.matches(':focus-visible') && getComputedStyle(e).outlineStyle !== 'none'")
    steps = len(b.at) // 2
    for key in ("ArrowRight", "ArrowRight", "Shift+ArrowRight", "ArrowLeft"):
        opened.keyboard.press(key)
    head = tip(opened, title)[0]
    assert quantity(head.split(" ", 1)[1])[0] == pytest.approx(b.at[steps + 10], rel=2e-3, abs=1e-9)
    opened.locator("[role=status]:not(:empty)").wait_for(state="attached")
    assert "f̂ − f" in opened.text_content("[role=status]")
    opened.keyboard.press("Escape")
    assert tip(opened, title) == []


def test_zoom_shows_less_and_tells_the_same(opened, small_run):
    _, title = first_band(small_run)
    place, middle = plot(opened, title), at(opened, title, 0.5, 0.5)
    ends = place.locator("svg")
    opened.mouse.move(*middle)
    before = tip(opened, title)
    place.focus()
    for _ in range(4):
        opened.keyboard.press("+")
    assert place.evaluate("e => e.classList.contains('zoomed')")
    ticks = [float(t.replace("−", "-")) for t in ends.locator(".scale text[text-anchor=middle]").all_text_contents()]
    assert len(ticks) >= 3
    assert max(ticks) - min(ticks) < 0.3 * 2
    opened.mouse.move(middle[0] + 1, middle[1])
    assert quantity(tip(opened, title)[0].split(" ", 1)[1]) == pytest.approx(quantity(before[0].split(" ", 1)[1]), abs=0.02)
    opened.mouse.down()
    opened.mouse.move(middle[0] + 60, middle[1], steps=3)
    opened.mouse.up()
    moved = [float(t.replace("−", "-")) for t in ends.locator(".scale text[text-anchor=middle]").all_text_contents()]
    assert min(moved) < min(ticks)
    opened.mouse.dblclick(*middle)
    assert not place.evaluate("e => e.classList.contains('zoomed')")
    assert ends.locator(".scale text").count() == 0


@pytest.mark.exam
def test_a_wheel_scrolls_the_page_and_zooms_with_control(opened, small_run):
    _, title = first_band(small_run)
    opened.mouse.move(*at(opened, title, 0.3, 0.5))
    opened.mouse.wheel(0, 120)
    assert not plot(opened, title).evaluate("e => e.classList.contains('zoomed')")
    opened.mouse.move(*at(opened, title, 0.3, 0.5))
    opened.keyboard.down("Control")
    opened.mouse.wheel(0, -120)
    opened.keyboard.up("Control")
    assert plot(opened, title).evaluate("e => e.classList.contains('zoomed')")


@pytest.mark.exam
def test_a_drawn_line_lies_where_its_values_say_when_zoomed(opened, small_run):
    """The picture that was drawn, moved, against the cursor, which is placed by values."""
    _, title = first_band(small_run)
    place = plot(opened, title)
    place.focus()
    for key in ("ArrowRight", "+", "+", "+", "Shift+ArrowRight"):
        opened.keyboard.press(key)
    off = place.evaluate("""e => {
      const s = e.querySelector('svg'), i = JSON.parse(e.parentElement.querySelector('script').textContent)
        .series.findIndex(x => x.kind === 'line'), line = s.querySelector(`[data-s=s${i}] path`), m = line.getCTM();
      const c = s.querySelector('.cursor circle'), to = s.getScreenCTM(), at = line.getScreenCTM();
      const want = new DOMPoint(+c.getAttribute('cx'), +c.getAttribute('cy')).matrixTransform(to);
      let least = 1e9;
      for (let k = 0; k <= 4000; k++) {
        const p = line.getPointAtLength(k / 4000 * line.getTotalLength()).matrixTransform(at);
        least = Math.min(least, Math.hypot(p.x - want.x, p.y - want.y));
      }
      return least; }""")
    assert off < 1.5


def test_an_entry_of_the_legend_hides_its_series(opened, small_run):
    _, title = first_band(small_run)
    figure = opened.locator("figure", has=opened.get_by_role("heading", name=title, exact=True))
    entry = figure.get_by_role("button", name="f̂ − f")
    entry.focus()
    opened.keyboard.press("Enter")
    assert entry.get_attribute("aria-pressed") == "false"
    opened.mouse.move(*at(opened, title, 0.6, 0.5))
    assert not any(line.startswith("f̂ − f") for line in tip(opened, title))
    assert figure.locator(".off").count() == 1
    entry.click()
    assert figure.locator(".off").count() == 0


def test_pictures_of_one_axis_have_one_cursor(opened):
    opened.mouse.move(*at(opened, "Runs that keep the specification", 0.5, 0.5))
    there = tip(opened, "Runs that keep the specification")
    other = tip(opened, "theta in closed loop") or tip(opened, "omega in closed loop")
    assert there[0] == other[0]
    assert there[0].startswith("time ")
    opened.mouse.move(0, 0)
    assert tip(opened, "theta in closed loop") == tip(opened, "omega in closed loop") == []


def test_a_map_tells_the_value_of_a_cell(opened, small_run):
    gap = Figures.load(small_run.folder).gap
    title = "Certified bound γ of omega"
    s = next(s for s in gap.slices if s.state == "omega")
    opened.mouse.move(*at(opened, title, 0.305, 0.805))
    rows, columns = s.gamma.shape
    value = s.gamma[int(0.805 * rows), int(0.305 * columns)]
    assert quantity(tip(opened, title)[1]) == pytest.approx([value], rel=2e-3)
    assert quantity(tip(opened, "True gap of omega")[1]) == pytest.approx(
        [s.gap[int(0.805 * rows), int(0.305 * columns)]], rel=2e-3
    )
    plot(opened, title).focus()
    opened.keyboard.press("ArrowUp")
    opened.keyboard.press("ArrowUp")
    assert tip(opened, title)


@pytest.mark.exam
def test_values_are_saved_as_they_were_drawn(opened, small_run):
    b, title = first_band(small_run)
    figure = opened.locator("figure", has=opened.get_by_role("heading", name=title, exact=True))
    figure.hover()
    with opened.expect_download() as found:
        figure.get_by_role("button", name="as CSV").click()
    with open(found.value.path(), newline="", encoding="utf-8") as file:
        head, *rows = list(csv.reader(file))
    unit = 10.0 ** int(re.search("10([⁻⁰-⁹¹²³]+)", head[1])[1].translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")))
    column = head.index(next(h for h in head if h.startswith("f̂ − f")))
    assert np.array([float(r[0]) for r in rows]) == pytest.approx(b.at, rel=1e-5, abs=1e-9)
    assert unit * np.array([float(r[column]) for r in rows]) == pytest.approx(
        b.residual, rel=1e-5, abs=1e-6 * np.abs(b.residual).max()
    )
    assert found.value.suggested_filename.endswith(".csv")


def test_what_was_read_is_copied(opened, small_run):
    _, title = first_band(small_run)
    opened.context.grant_permissions(["clipboard-read", "clipboard-write"])
    opened.mouse.move(*at(opened, title, 0.7, 0.5))
    read = tip(opened, title)
    figure = opened.locator("figure", has=opened.get_by_role("heading", name=title, exact=True))
    figure.get_by_role("button", name="Copy").click()
    opened.get_by_text("Copied").wait_for(state="attached")
    assert opened.evaluate("navigator.clipboard.readText()").splitlines() == read
    assert len(read) == 5


@pytest.mark.exam
def test_two_fingers_zoom_and_one_reads(visit, small_run):
    page, said, _ = visit(small_run.folder / "report.html", 390, has_touch=True, is_mobile=True)
    _, title = first_band(small_run)
    x, y = at(page, title, 0.5, 0.5)
    client = page.context.new_cdp_session(page)

    def touch(kind, *points):
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": a, "y": b} for a, b in points]})

    touch("touchStart", (x, y))
    touch("touchEnd")
    assert tip(page, title)
    touch("touchStart", (x - 20, y), (x + 20, y))
    for k in range(1, 6):
        touch("touchMove", (x - 20 - 8 * k, y), (x + 20 + 8 * k, y))
    touch("touchEnd")
    assert plot(page, title).evaluate("e => e.classList.contains('zoomed')")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert said == []


@pytest.mark.exam
def test_headings_sort_a_table(opened):
    box = opened.get_by_role("region", name="Closed loop on the simulator")
    numbers = lambda: [int(t.replace(",", "")) for t in box.locator("tbody tr td:nth-child(4)").all_inner_texts()]  # noqa: E731
    first = numbers()
    head = box.get_by_role("button", name="violations")
    for order, want in (("ascending", sorted(first)), ("descending", sorted(first, reverse=True)), (None, first)):
        head.press("Enter")
        assert numbers() == want
        assert box.locator("th").nth(3).get_attribute("aria-sort") == order


@pytest.mark.exam
def test_powers_of_ten_are_sorted_by_their_value(opened):
    opened.evaluate("""() => { const t = document.createElement('table'); t.id = 'made';
      t.innerHTML = '<thead><tr><th>v</th></tr></thead><tbody>' + ['3 × 10⁻⁵', '–', '10⁻⁶', '1,200', '−2', '0.5 %']
        .map(v => `<tr><td>${v}</td></tr>`).join('') + '</tbody>'; document.body.append(t); }""")
    script = opened.evaluate("document.querySelector('body > script').textContent")
    opened.evaluate(f"() => {{ for (const e of document.querySelectorAll('table:not(#made), figure')) e.remove(); {script} }}")
    opened.locator("#made button").click()
    assert opened.locator("#made td").all_inner_texts() == ["−2", "10⁻⁶", "3 × 10⁻⁵", "0.5 %", "1,200", "–"]


def test_light_and_dark_are_chosen_and_nothing_is_kept(opened):
    ground = "getComputedStyle(document.body).backgroundColor"
    light, button = opened.evaluate(ground), opened.get_by_role("button", name="Theme")
    button.click()
    assert opened.evaluate(ground) == light
    button.click()
    assert opened.evaluate(ground) != light
    assert opened.evaluate("[localStorage.length, sessionStorage.length, document.cookie]") == [0, 0, ""]
    opened.emulate_media(media="print")
    assert opened.evaluate(ground) == "rgb(255, 255, 255)"
    opened.emulate_media(media="screen")
    opened.reload()
    assert opened.evaluate(ground) == light


def test_print_shows_everything(opened):
    """In print the folded parts are open, and no box scrolls."""
    folded = opened.locator("details .pictures, details table")
    assert folded.count() > 1
    opened.emulate_media(media="print")
    hidden = "all => all.filter(e => e.getBoundingClientRect().height < 20).length"
    assert folded.evaluate_all(hidden) == 0
    assert (
        opened.locator(".scroll, pre").evaluate_all(
            "all => all.filter(e => getComputedStyle(e).overflowX !== 'visible').length"
        )
        == 0
    )
    assert not opened.locator(".tools").first.is_visible()
    assert not opened.get_by_role("button", name="Theme").is_visible()


@pytest.mark.exam
def test_without_script_the_page_is_whole(visit, small_run):
    page, said, _ = visit(small_run.folder / "report.html", java_script_enabled=False)
    assert said == []
    assert page.locator("figure .plot > svg").count() >= 8
    assert page.locator("button").count() == 0
    assert page.locator(".legend li").count() > 10


@pytest.mark.exam
def test_the_keyboard_reaches_everything_in_order(opened):
    opened.keyboard.press("Tab")
    assert opened.evaluate("document.activeElement.textContent") == "Skip to the answer"
    opened.keyboard.press("Enter")
    assert opened.evaluate("document.activeElement.id || location.hash") in ("main", "#main")
    seen = set()
    for _ in range(60):
        opened.keyboard.press("Tab")
        kind = "e => e.className.split(' ')[0] || e.tagName"
        seen.add(opened.evaluate(f"({kind})(document.activeElement)"))
    assert {"plot", "BUTTON", "SUMMARY"} <= seen
