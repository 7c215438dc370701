"""What the documentation takes from the code: component and option tables, command help, benchmark tables, docstrings."""

from __future__ import annotations

import importlib
import inspect
import json
import re
import sys
import tomllib
from abc import abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gallery
import messages
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import gapcert
from gapcert.cli.doctor import licences
from gapcert.contracts.plugins.component import KINDS, Component
from gapcert.spec.sections import sections
from gapcert.spec.sections.plugin_sections import contributed
from gapcert_diagnosis.results import ORDER


def table(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in line) + " |" for line in lines)


def components(*kinds: str) -> Iterator[Component]:
    registry = gapcert.registry()
    for kind in kinds or KINDS:
        for name in registry.names(kind):
            yield registry.get(kind, name)


HEADER = ["kind", "name", "what it is", "extra"]


def component_table(*kinds: str) -> str:
    rows = [[c.kind, f"`{c.name}`", c.summary, f"`gapcert[{c.extra}]`" if c.extra else ""] for c in components(*kinds)]
    header, *rows = [[cell for i, cell in enumerate(row) if i > 0 or not kinds] for row in [HEADER, *rows]]
    return table(header, rows)


def type_name(schema: dict[str, Any]) -> str:
    """A JSON Schema type in words: `number`, `list of string`, `one of a, b`."""
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return "one of " + ", ".join(f"`{v}`" for v in schema["enum"])
    if "$ref" in schema:
        return schema["$ref"].rpartition("/")[2].strip("_")
    for key in ("anyOf", "oneOf", "allOf"):
        if key in schema:
            return " or ".join(dict.fromkeys(type_name(s) for s in schema[key] if s.get("type") != "null"))
    if isinstance(schema.get("type"), list):
        return " or ".join(schema["type"])
    if schema.get("type") == "array":
        return f"list of {type_name(schema['items'])}" if schema.get("items") else "list"
    values = schema.get("additionalProperties")
    if schema.get("type") == "object" and isinstance(values, dict):
        return f"mapping to {type_name(values)}"
    kind = schema.get("format") or schema.get("type", "any")
    return {"object": "mapping", "integer": "whole number", "string": "text"}.get(kind, kind)


def option_table(schema: dict[str, Any], told: set[str] | None = None) -> str:
    """What a config model says of itself, its options, and those of the models inside it that were not `told` before."""
    told = set() if told is None else told
    new = {name: part for name, part in schema.get("$defs", {}).items() if name not in told}
    told.update(new)
    inner = [f"*{name.strip('_')}*: {_own_table(part)}" for name, part in new.items()]
    return "\n\n".join([_own_table(schema), *inner])


def _own_table(schema: dict[str, Any]) -> str:
    required = schema.get("required", [])
    rows = []
    for key, option in schema.get("properties", {}).items():
        default = "" if option.get("default") is None else f"`{json.dumps(option['default'])}`"
        rows.append([f"`{key}`", type_name(option), "required" if key in required else default, option.get("description", "")])
    rows = [row for row in rows if row[0] != "`kind`" or row[3]]
    width = 4 if any(row[3] for row in rows) else 3
    options = table(["key", "type", "default", "meaning"][:width], [row[:width] for row in rows]) if rows else "No options."
    return f"{inspect.cleandoc(schema.get('description', ''))}\n\n{options}"


def option_tables(kind: str) -> str:
    """All components of a kind, or one section of the core's own."""
    if kind not in KINDS:
        more = [sys.modules[type(s).__module__] for s in contributed(gapcert.registry()).values()]
        home = next(m for m in (sections, *more) if hasattr(m, kind))
        return option_table(getattr(home, kind).model_json_schema())
    parts, told = [], set[str]()
    for c in components(kind):
        config = gapcert.registry().config(c.kind, c.name)
        options = option_table(config.model_json_schema(), told) if config else "No options."
        parts.append(f"**`kind: {c.name}`**. {c.summary[:1].upper()}{c.summary[1:]}.\n\n{options}")
    return "\n\n".join(parts)


def effect_table(kind: str) -> str:
    """All effects at one kind of site: name and law, what data show, what looks like it, and what brings it out."""
    built = {c.name: gapcert.registry().build("effect", c.name) for c in components("effect")}

    def alike(e: gapcert.plugin.Effect) -> str:
        same = [f"the same as `{other}` {where}" for other, where in e.equivalent.items()]
        held = [f"contains `{other}`" for other in e.contains]
        rest = [f"`{other}`" for other in e.rivals if other not in e.equivalent and other not in e.contains]
        return "; ".join([*same, *held, *([", ".join(rest)] if rest else [])])

    rows = [
        [f"**{e.name}**<br>{e.sentence}<br>*{e.equation.replace('*', chr(92) + '*')}*", e.signature, alike(e), e.experiment]
        for e in sorted(built.values(), key=lambda e: ORDER.index(e.name))
        if e.site == kind
    ]
    return table(["effect and law", "what data show", "what looks like it", "what brings it out"], rows)


class Generated(SphinxDirective):
    """A directive whose content is Markdown that Python writes."""

    optional_arguments = 1

    @abstractmethod
    def markdown(self) -> str: ...

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes(self.markdown(), allow_section_headings=True)


class Gallery(Generated):
    """Pictures that specs made, each with its command."""

    def markdown(self) -> str:
        self.env.note_reread()  # pictures are found, not named
        return gallery.markdown()


class Messages(Generated):
    """The index of error messages, from the code of core and plugins."""

    def markdown(self) -> str:
        self.env.note_reread()  # the code is no dependency that Sphinx knows of
        return messages.markdown()


class Components(Generated):
    def markdown(self) -> str:
        return component_table(*self.arguments)


class Options(Generated):
    def markdown(self) -> str:
        return option_tables(self.arguments[0])


class Effects(Generated):
    def markdown(self) -> str:
        return effect_table(self.arguments[0])


class Classes(Generated):
    """The public classes of one module, in the order in which it defines them."""

    def markdown(self) -> str:
        package = importlib.import_module(self.arguments[0].partition(".")[0])
        found = [getattr(package, n) for n, module in package._HOME.items() if module == self.arguments[0] and n[0].isupper()]
        found = sorted(filter(inspect.isclass, found), key=lambda c: inspect.getsourcelines(c)[1])
        lines = [f".. autoclass:: {package.__name__}.{c.__name__}" for c in found]
        return "\n".join(["```{eval-rst}", *lines, "```"])


class Offered(Generated):
    """What a package offers besides what the page tells of, each with its first sentence, by the folders that it is from."""

    def markdown(self) -> str:
        package = importlib.import_module(self.arguments[0])
        page = Path(self.env.doc2path(self.env.docname)).read_text()
        groups: dict[str, list[list[str]]] = {}
        for name in sorted(package._HOME, key=str.lower):
            if not re.search(rf"^\.\. \w+:: (\w+\.)*{name}$", page, re.MULTILINE):
                home = importlib.import_module(package._HOME[name])
                rows = groups.setdefault(home.__name__ if hasattr(home, "__path__") else home.__package__ or "", [])
                rows.append([f"`{name}`", first_sentence(getattr(package, name))])
        told = [(first_sentence(importlib.import_module(g)), table(["name", "what it is"], groups[g])) for g in sorted(groups)]
        return "\n\n".join(f"{said}\n\n{rows}" for said, rows in told)


def first_sentence(value: Any) -> str:
    """Of its docstring; nothing for a value, whose class has one."""
    named = inspect.isclass(value) or inspect.isroutine(value) or inspect.ismodule(value)
    return " ".join((inspect.getdoc(value) or "").partition("\n\n")[0].split()) if named else ""


class Benchmarks(Generated):
    """The tables that benchmarks/*.py have written, one section each."""

    def markdown(self) -> str:
        written = sorted((Path(__file__).parent / "benchmarks").glob("*.md"))
        self.env.note_reread()  # a table that is new is no dependency of the last build
        return "\n\n".join(path.read_text() for path in written) or "No table has been written yet."


class Rooms(Generated):
    """The rooms of tests/rooms.toml, highest first: what stands in one line imports nothing of its neighbours."""

    def markdown(self) -> str:
        order = tomllib.loads((Path(__file__).parents[1] / "tests" / "rooms.toml").read_text())["order"]
        core = [line[0].removeprefix("core.") for line in order if line[0].startswith("core.")]
        rows = [line for line in order if not line[0].startswith("core.")]
        boxes = "".join(f"<p>{''.join(f'<span>{room}</span>' for room in line)}</p>" for line in reversed(rows))
        own = "".join(f"<span>{room}</span>" for room in reversed(core))
        return f'```{{raw}} html\n<div class="rooms">{boxes}<p class="core"><b>gapcert</b>{own}</p></div>\n```'


class Licences(Generated):
    """What Gapcert and its extras need, with licences; what only tests need stands last."""

    def markdown(self) -> str:
        rows = sorted(licences(development=True), key=lambda r: r.needed_by == ("dev",))
        cells = [[f"`{r.package}`", r.version or "", r.licence or "not stated", ", ".join(r.needed_by)] for r in rows]
        return table(["package", "version", "licence", "needed by"], cells)


class Notebook(Generated):
    """An executed notebook of this folder: its texts, its code, and its outputs as they are stored."""

    def markdown(self) -> str:
        path = Path(__file__).parent / self.arguments[0]
        self.env.note_dependency(str(path))
        return "\n\n".join(part for cell in json.loads(path.read_text())["cells"] for part in self.shown(cell))

    @staticmethod
    def shown(cell: dict[str, Any]) -> Iterator[str]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            yield source
            return
        # Another mark than Python's: the notebook's own test runs it.
        yield f"```ipython3\n{source}\n```"
        for output in cell["outputs"]:
            data = output.get("data", {})
            if html := "".join(data.get("text/html", ())):
                yield "````{raw} html\n" + html + "\n````"
            elif text := "".join(data.get("text/plain", output.get("text", ()))):
                yield f"```text\n{text}\n```"


def plain_docstring(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Docstrings are prose with formulas, not reStructuredText: |r| is no substitution and x* no emphasis."""
    spans = re.split(r"(`[^`\n]+`)", "\n".join(lines))
    text = "".join(f"`{s}`" if s.startswith("`") else re.sub(r"([\\*|_`])", r"\\\1", s) for s in spans)
    lines[:] = re.sub(r"^(\s*)([-+]\s)", r"\1\\\2", text, flags=re.MULTILINE).split("\n")


def render_math(writer: Any, node: nodes.math | nodes.math_block) -> None:
    """Formulas as MathML, which browsers draw themselves: the pages need no script and no network."""
    block = isinstance(node, nodes.math_block)
    writer.body.append(tex2mathml(node.astext(), as_block=block))
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("gallery", Gallery)
    app.add_directive("messages", Messages)
    app.add_directive("components", Components)
    app.add_directive("options", Options)
    app.add_directive("effects", Effects)
    app.add_directive("classes", Classes)
    app.add_directive("benchmarks", Benchmarks)
    app.add_directive("licences", Licences)
    app.add_directive("offered", Offered)
    app.add_directive("rooms", Rooms)
    app.add_directive("notebook", Notebook)
    app.add_html_math_renderer("mathml", (render_math, None), (render_math, None))
    app.connect("autodoc-process-docstring", plain_docstring)
    return {"parallel_read_safe": True}
