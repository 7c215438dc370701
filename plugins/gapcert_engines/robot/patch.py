"""Numbers written into robot files, native parameters into URDF and SDF: nothing else changes, comments and layout included."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

from gapcert.plugin import UsageError

from .links import largest_moment

_TAG = re.compile(r"<!--.*?-->|<\?.*?\?>|<!\[CDATA\[.*?\]\]>|<(/?)([\w:.-]+)((?:[^<>\"']|\"[^\"]*\"|'[^']*')*?)(/?)>", re.S)
_ATTRIBUTE = re.compile(r"([\w:.-]+)\s*=\s*(\"[^\"]*\"|'[^']*')")
_PLACE = ("com_x", "com_y", "com_z")
_MOMENTS = {"ixx": 1.0, "iyy": 1.0, "izz": 1.0, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
"""Of an inertia in SDF, with what it is where a file does not say it."""


@final
@dataclass(frozen=True)
class Tag:
    """A start tag in a text: where it begins and ends, what it is, and its attributes."""

    begin: int
    end: int
    kind: str
    attributes: dict[str, str]
    depth: int


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


def patched_file(
    text: str,
    values: Mapping[str, float],
    stated: Mapping[str, float],
    words: Mapping[str, str],
    given: Mapping[str, float | None],
    model: str | None = None,
) -> tuple[dict[str, str], dict[str, float]]:
    """The text of a URDF or SDF file with `values` as `extended.urdf` or `.sdf`, and the values that it cannot say.

    values: native parameters that differ from the `stated` ones, of which all are there; a moment of inertia that the file
    cannot say is told as the multiple of the one that it states. given: kind → what the spec gives all joints in place of the
    file's, which the file then says. words: see `patched_urdf`; model: see `patched_sdf`.
    """
    instead = tuple(f"{kind}." for kind, value in given.items() if value is not None)
    values = {n: v for n, v in stated.items() if n.startswith(instead)} | dict(values)
    if RobotText(text).tags[0].kind == "robot":
        name, (text, unsaid) = "extended.urdf", patched_urdf(text, values, words)
    else:
        down = [stated[f"gravity_{a}"] for a in "xyz"]
        name, (text, unsaid) = "extended.sdf", patched_sdf(text, values, down, model)
    return {name: text}, {n: v / stated[n] if n.startswith("inertia.") else v for n, v in unsaid.items()}


def setting_code(templates: Mapping[str, str], values: Mapping[str, float]) -> list[str]:
    """Lines of code that set native parameters `KIND.ELEMENT`: the template of each KIND with its {element} and {number}."""
    lines = list[str]()
    for name, value in values.items():
        what, _, element = name.partition(".")
        lines += templates.get(what, "").format(element=element, number=repr(float(value))).splitlines()
    return lines


def patched_urdf(text: str, values: Mapping[str, float], words: Mapping[str, str]) -> tuple[str, dict[str, float]]:
    """The text, and the values that it cannot say.

    values: `mass.LINK`, with the inertia in proportion, `inertia.LINK`, the largest principal moment at the stated mass,
    `com_x.LINK`, `_y`, `_z`, and `WORD.JOINT`; words: what the <dynamics> of a joint calls a WORD.
    """
    file, unsaid = RobotText(text), dict[str, float]()
    # A mass takes along the moments that were found at the stated one.
    for name, value in sorted(values.items(), key=lambda v: not v[0].startswith("inertia.")):
        what, _, element = name.partition(".")
        try:
            if what in ("mass", "inertia"):
                file = _urdf_mass(file, element, what, float(value))
            elif what in _PLACE:
                file = _urdf_com(file, element, _PLACE.index(what), float(value))
            elif what in words:
                file = _dynamics(file, element, words[what], float(value))
            else:
                unsaid[name] = value
        except UsageError:
            unsaid[name] = value
    return file.text, unsaid


def patched_sdf(
    text: str, values: Mapping[str, float], gravity: Sequence[float], model: str | None = None
) -> tuple[str, dict[str, float]]:
    """The text, and the values that it cannot say; of the first model, or of the one that is named.

    values: `mass.LINK`, with the inertia in proportion, `damping.JOINT`, `coulomb_friction.JOINT`, and `gravity_x`, `_y`, `_z`,
    beside which the rest of `gravity` stands.
    """
    file, unsaid = RobotText(text), dict[str, float]()
    values = dict(sorted(values.items(), key=lambda v: not v[0].startswith("inertia.")))
    words = {"damping": "damping", "coulomb_friction": "friction"}
    for name, value in values.items():
        what, _, element = name.partition(".")
        try:
            if what == "mass":
                file = _sdf_mass(file, _model(file, model), element, float(value))
            elif what in words:
                axis = _below(file, file.named("joint", element, _model(file, model)), "axis")
                file = _filled(file, axis, ("dynamics", words[what]), repr(float(value)))
            elif not name.startswith("gravity_"):
                unsaid[name] = value
        except UsageError:
            unsaid[name] = value
    down = {n: v for n, v in values.items() if n.startswith("gravity_")}
    world = next((t for t in file.tags if t.kind == "world"), None)
    if down and world is not None:
        numbers = (float(down.get(f"gravity_{a}", g)) for a, g in zip("xyz", gravity, strict=True))
        return _filled(file, world, ("gravity",), " ".join(map(repr, numbers))).text, unsaid
    return file.text, unsaid | down


def _dynamics(file: RobotText, joint: str, word: str, value: float) -> RobotText:
    tag = file.named("joint", joint, file.tags[0])
    for below in file.inside(tag):
        if below.kind == "dynamics":
            return file.put(below, **{word: repr(value)})
    return file.insert(tag, f'<dynamics {word}="{value!r}"/>')


def _urdf_mass(file: RobotText, link: str, what: str, value: float) -> RobotText:
    inertial = _below(file, file.named("link", link, file.tags[0]), "inertial")
    below = {t.kind: t for t in file.inside(inertial)}
    stated = {k: float(v) for k, v in below["inertia"].attributes.items()} if "inertia" in below else {}
    if what == "mass":
        own, changes = float(below["mass"].attributes["value"]), [(below["mass"], {"value": repr(value)})]
    else:
        own, changes = largest_moment(*(stated.get(name, usual) for name, usual in _MOMENTS.items())), []
    if stated:
        changes.append((below["inertia"], {k: repr(v * (value / own)) for k, v in stated.items()}))
    # From the end on, so that what stands before keeps its place.
    for tag, values in sorted(changes, key=lambda c: -c[0].begin):
        file = file.put(tag, **values)
    return file


def _urdf_com(file: RobotText, link: str, k: int, value: float) -> RobotText:
    inertial = _below(file, file.named("link", link, file.tags[0]), "inertial")
    origin = next((t for t in file.inside(inertial) if t.kind == "origin"), None)
    place = ("0 0 0" if origin is None else origin.attributes.get("xyz", "0 0 0")).split()
    place[k] = repr(value)
    xyz = " ".join(place)
    return file.insert(inertial, f'<origin xyz="{xyz}"/>') if origin is None else file.put(origin, xyz=xyz)


def _sdf_mass(file: RobotText, model: Tag, link: str, mass: float) -> RobotText:
    def inertial() -> Tag:
        return _below(file, file.named("link", link, _model(file, model.attributes.get("name"))), "inertial")

    known = {t.kind: t for t in file.inside(inertial())}
    ratio = mass / (float(file.content(known["mass"])) if "mass" in known else 1.0)
    stated = {t.kind: float(file.content(t)) for t in file.inside(known["inertia"])} if "inertia" in known else {}
    for name, usual in _MOMENTS.items():
        if (moment := stated.get(name, usual)) or name in stated:
            file = _filled(file, inertial(), ("inertia", name), repr(moment * ratio))
    return _filled(file, inertial(), ("mass",), repr(mass))


def _model(file: RobotText, name: str | None) -> Tag:
    for tag in file.tags:
        if tag.kind == "model" and name in (None, tag.attributes.get("name")):
            return tag
    raise UsageError(f"the robot file has no model '{name}'")


def _below(file: RobotText, tag: Tag, kind: str) -> Tag:
    for below in file.inside(tag):
        if below.kind == kind:
            return below
    raise UsageError(f'<{tag.kind} name="{tag.attributes.get("name")}"> has no <{kind}>; give it one, or set it in code')


def _filled(file: RobotText, tag: Tag, path: tuple[str, ...], content: str) -> RobotText:
    """With the text of an element below a tag, which is made where there is none."""
    for k, kind in enumerate(path):
        found = next((t for t in file.inside(tag) if t.kind == kind), None)
        if found is None:
            inner = content
            for missing in reversed(path[k:]):
                inner = f"<{missing}>{inner}</{missing}>"
            return file.insert(tag, inner)
        tag = found
    return file.fill(tag, content)
