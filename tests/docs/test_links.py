"""What the documentation points to is there: pages, anchors, pictures, files; and no page is words alone."""

import re
import sys
import urllib.parse
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import blocks  # noqa: E402
import gallery  # noqa: E402

TEXTS = [*blocks.PAGES, ROOT / "CHANGELOG.md"]
HOSTS = {"adl.github.io"}  # of external links; `sphinx -b linkcheck` asks them
BARE = {"choose.md", "CONTRIBUTING.md"}  # a decision in tables, and a list of rules: nothing to run, nothing to draw
PICTURES = 3_000_000  # bytes, all together


def prose(text):
    """A page without its blocks, formulas and `code`, in which brackets are no links."""
    return re.sub(
        r"`[^`\n]*`|\$\$[^$]*\$\$|\$[^$]*\$", "", re.sub(r"^(```+|:::+).*?^\1 *$", "", text, flags=re.MULTILINE | re.DOTALL)
    )


def anchors(page):
    """The anchors of a page: its headings, as MyST and GitHub name them, and its labels."""
    text = page.read_text()
    heads = [re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in re.findall(r"^#+ (.*)$", prose(text), re.M)]
    return {*heads, *re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE)}


def links(page):
    """All links and pictures of a page, in Markdown and in roles."""
    text = page.read_text()
    yield from re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", prose(text))
    for name in re.findall(r"{doc}`(?:[^`<]*<)?([^`>]+)>?`", text):
        yield f"{name}.md"


def lost(page):
    """The links of a page that lead nowhere."""
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = urllib.parse.unquote(target).partition("#")
        there = (page.parent / name) if name else page
        if not there.exists() or (anchor and there.suffix == ".md" and anchor not in anchors(there)):
            yield target


def test_links_lead_somewhere():
    assert [(page.name, target) for page in TEXTS for target in lost(page)] == []


def test_a_broken_link_is_noticed(tmp_path):
    (tmp_path / "there.md").write_text("# A heading\n\n(label)=\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[a](there.md) [b](there.md#a-heading) [c](there.md#label) `[no](link.md)` {doc}`there` {doc}`so <there>`\n"
        "[d](gone.md) [e](there.md#gone) ![f](gone.png) {doc}`nowhere`\n"
    )
    assert list(lost(page)) == ["gone.md", "there.md#gone", "gone.png", "nowhere.md"]


def test_references_have_labels():
    labels = {label for page in blocks.PAGES for label in anchors(page)}
    asked = {r for page in blocks.PAGES for r in re.findall(r"{ref}`(?:[^`<]*<)?([^`>]+)>?`", page.read_text())}
    assert {r for r in asked if r not in labels} == set()


def test_external_links_are_few_and_known():
    found = {urllib.parse.urlsplit(t).netloc for page in TEXTS for t in links(page) if t.startswith("http")}
    assert found <= HOSTS


def test_every_page_is_in_the_contents():
    listed = " ".join(b.text for b in blocks.blocks(ROOT / "docs" / "index.md") if b.language == "toctree").split()
    assert {p.stem for p in (ROOT / "docs").glob("*.md")} - {"index"} <= set(listed)


def test_no_page_is_words_alone():
    words = [p for p in blocks.PAGES if "![" not in p.read_text()]
    assert {p.name for p in words if not any(b.how in ("executed", "generated") for b in blocks.blocks(p))} == BARE


def test_pictures_have_words_for_those_who_do_not_see_them():
    for page in blocks.PAGES:
        assert "![](" not in page.read_text()


def test_pictures_are_small_and_all_of_them_are_used():
    pictures = [p for p in (ROOT / "docs" / "images").rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in pictures) < PICTURES
    said = "".join(p.read_text() for p in blocks.PAGES) + gallery.markdown()
    assert [p.name for p in pictures if p.name not in said] == []


def test_the_gallery_has_its_pictures_and_its_specs():
    for entry in gallery.ENTRIES:
        assert (ROOT / "docs" / "images" / "gallery" / f"{entry.name}.svg").exists(), f"python docs/gallery.py {entry.name}"
        assert (ROOT / entry.source).exists()
    for name in gallery.DRAWN:
        assert (ROOT / "docs" / "images" / "gallery" / f"{name}.svg").exists()
