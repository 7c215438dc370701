"""Every fenced block of the documentation, and what its tests do with it: run it, check it, or only show it.

`python docs/blocks.py` prints the counts per page; `tests/docs` holds each block to its kind.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = sorted([*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"], key=lambda p: p.name)
# Languages by what becomes of a block. A language that is not here is refused.
HOW = {
    **dict.fromkeys(("python", "console"), "executed"),
    **dict.fromkeys(("yaml", "toml", "json", "xml", "sh", "c", "diff", "ipython3"), "checked"),
    **dict.fromkeys(("text", "lua"), "shown"),
    **dict.fromkeys(
        (
            "components",
            "options",
            "effects",
            "classes",
            "benchmarks",
            "messages",
            "gallery",
            "notebook",
            "licences",
            "offered",
            "rooms",
            "survived",
        ),
        "generated",
    ),
    **dict.fromkeys(("literalinclude", "include", "eval-rst"), "generated"),
    **dict.fromkeys(("toctree",), "layout"),
}
# The shapes of JSON, to which tests/docs/test_shapes.py holds what the commands print.
SHAPES = ("cli.md", "text")
_FENCE = re.compile(
    r"^(?P<fence>```+|:::+)(?P<info>[^\n]*)\n(?P<options>(?::[\w-]+:[^\n]*\n)*\n*)(?P<body>.*?)^(?P=fence) *$",
    re.MULTILINE | re.DOTALL,
)
_FRAGMENT = re.compile(r"^% fragment of (\S+)\n+\Z", re.MULTILINE)
_WHERE = re.compile(r"^% where (\w+) (\S+) is (there|missing)\n+\Z", re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """One fence: its page, line, language or directive, text, the file that its caption names, and the machines it is of."""

    page: str
    line: int
    language: str
    text: str
    caption: str = ""
    fragment_of: str = ""
    where: tuple[str, ...] = ()

    @property
    def how(self) -> str:
        return "checked" if (self.page, self.language) == SHAPES else HOW.get(self.language, "unknown")

    @property
    def suits(self) -> bool:
        """Is it of a machine such as this one? (kind, name, state): what is printed depends on a component."""
        if not self.where:
            return True
        import gapcert

        kind, name, state = self.where
        return (gapcert.registry().get(kind, name).missing() is None) == (state == "there")

    @property
    def commands(self) -> int:
        """How many commands it holds, each with what it prints."""
        return len(re.findall(r"^\$ ", self.text, re.MULTILINE)) if self.language == "console" else 0


def blocks(path: Path) -> Iterator[Block]:
    """The blocks of a page. A line before one says more: `% fragment of SPEC` which spec a part of a spec is merged into,

    `% where KIND NAME is there` (or `is missing`) on which machines a command prints this.
    """
    text = path.read_text(encoding="utf-8")
    for hit in _FENCE.finditer(text):
        words = hit["info"].split()
        language = words[0].strip("{}") if words else ""
        if language == "code-block":
            language = words[1]
        caption = re.search(r"^:caption: (\S+)", hit["options"], re.MULTILINE)
        part, where = (p.search(text[: hit.start()]) for p in (_FRAGMENT, _WHERE))
        at, of = text.count("\n", 0, hit.start()) + 1, where.groups() if where else ()
        yield Block(path.name, at, language, hit["body"], caption[1] if caption else "", part[1] if part else "", of)


def main() -> None:
    total: Counter[str] = Counter()
    for path in PAGES:
        found = list(blocks(path))
        counts = Counter(b.how for b in found)
        commands = sum(b.commands for b in found)
        total += counts + Counter(commands=commands, blocks=len(found))
        print(f"{path.name:24} {len(found):3} blocks  {dict(sorted(counts.items()))}  {commands} commands")
    rest = ", ".join(f"{n} {how}" for how, n in sorted(total.items()) if how not in ("blocks", "commands"))
    print(f"{total['blocks']} blocks on {len(PAGES)} pages: {rest}; {total['commands']} commands")


if __name__ == "__main__":
    main()
