"""Numbers written into a robot file: nothing else of its text changes, comments and layout included."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import final

from gapcert.plugin import UsageError


@final
@dataclass(frozen=True)
class Tag:
    """A start tag in a text: where it begins and ends, what it is, and its attributes."""

    begin: int
    end: int
    kind: str
    attributes: dict[str, str]
    depth: int


_TAG = re.compile(r"<!--.*?-->|<\?.*?\?>|<!\[CDATA\[.*?\]\]>|<(/?)([\w:.-]+)((?:[^<>\"']|\"[^\"]*\"|'[^']*')*?)(/?)>", re.S)
_ATTRIBUTE = re.compile(r"([\w:.-]+)\s*=\s*(\"[^\"]*\"|'[^']*')")


@final
@dataclass(frozen=True)
class RobotText:
    """The text of an MJCF, URDF or SDF file. What changes gives a new one; the rest of the text stays as it is."""

    text: str

    @cached_property
    def tags(self) -> tuple[Tag, ...]:
        """Every start tag, in order; what stands in comments is none."""
        out, depth = [], 0
        for m in _TAG.finditer(self.text):
            if m[2] is None:
                continue
            if m[1]:
                depth -= 1
                continue
            found = {n: v[1:-1] for n, v in _ATTRIBUTE.findall(m[3])}
            out.append(Tag(m.start(), m.end(), m[2], found, depth))
            depth += not m[4]
        return tuple(out)

    def inside(self, tag: Tag) -> list[Tag]:
        """The tags directly below one."""
        below = []
        for t in self.tags[self.tags.index(tag) + 1 :]:
            if t.depth <= tag.depth:
                break
            if t.depth == tag.depth + 1:
                below.append(t)
        return below

    def named(self, kind: str, name: str, inside: Tag | None = None) -> Tag:
        """The tag of a kind with a name, anywhere or directly below one; UsageError where the file has none."""
        for tag in self.tags if inside is None else self.inside(inside):
            if tag.kind == kind and tag.attributes.get("name") == name:
                return tag
        raise UsageError(f'the robot file has no <{kind} name="{name}">; it may be in a file that it includes')

    def put(self, tag: Tag, **values: str) -> RobotText:
        """With attributes of one tag set."""
        own = self.text[tag.begin : tag.end]
        for name, value in values.items():
            known = re.search(rf"(?<![\w:.-]){re.escape(name)}(\s*=\s*)(\"[^\"]*\"|'[^']*')", own)
            if known:
                own = own[: known.start(2)] + f'"{value}"' + own[known.end(2) :]
                continue
            end = re.search(r"\s*/?>$", own)
            assert end is not None, "a start tag ends with >"
            own = own[: end.start()] + f' {name}="{value}"' + own[end.start() :]
        return RobotText(self.text[: tag.begin] + own + self.text[tag.end :])

    def fill(self, tag: Tag, content: str) -> RobotText:
        """With the text of an element that has no other inside."""
        own, after = self.text[tag.begin : tag.end], self.text[tag.end :]
        if own.endswith("/>"):
            return RobotText(self.text[: tag.begin] + f"{own[:-2].rstrip()}>{content}</{tag.kind}>" + after)
        return RobotText(self.text[: tag.end] + content + after[after.index(f"</{tag.kind}") :])

    def content(self, tag: Tag) -> str:
        """The text of an element that has no other inside."""
        after = self.text[tag.end :]
        return "" if self.text[: tag.end].endswith("/>") else after[: after.index(f"</{tag.kind}")].strip()

    def insert(self, tag: Tag, element: str) -> RobotText:
        """With an element as the first of those inside one, indented as it would be by hand."""
        line = self.text[self.text.rfind("\n", 0, tag.begin) + 1 : tag.begin]
        indent, own, after = "" if line.strip() else line, self.text[tag.begin : tag.end], self.text[tag.end :]
        if own.endswith("/>"):
            own = own[:-2].rstrip() + ">"
            after = f"\n{indent}</{tag.kind}>" + after
        return RobotText(self.text[: tag.begin] + own + f"\n{indent}  {element}" + after)
