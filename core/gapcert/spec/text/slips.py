"""What to do about text that is not YAML: the slips that are often made, by what the parser says and where."""

from __future__ import annotations

import re
from collections.abc import Sequence

_QUOTES = "put quotes around it"
_SAID = (
    (r"found character '\\t'", "indent with spaces, not with tabs"),
    (r"that cannot start any token|alphabetic or numeric character", _QUOTES),
    (r"undefined alias", f"{_QUOTES} if it is text"),
    (r"unknown escape", "use single quotes, or write \\\\ for a backslash"),
    (r"a comment or a line break", "begin the text in the next line, or put quotes around it"),
    (r"another document", "a file holds one spec; remove the line ---"),
    (r"but found '<scalar>'", "a quote within quotes is written twice, or the quotes are of the other kind"),
    (r"but found '<block mapping start>'|but found '(-|\?)'", "indent it as the keys beside it"),
    (r"but found '[\]}]'", "it closes what was not opened; remove it"),
    (r"sequence entries are not allowed", "begin a list in the next line, or write [a, b]"),
)
_TIGHT = re.compile(r"^[^#'\"]*?[\w\])]:[^\s:/\\]")  # `kind:csv`, but neither a path nor an address


def advice(said: str, context: str, lines: Sequence[str], at: tuple[int, int], since: int | None) -> str:
    """What to do: `said` by the parser at (line, column) of the text, about something that began in line `since`, from 0."""
    above = "" if since is None else f" in line {since + 1}"
    here = lines[at[0]] if at[0] < len(lines) else ""
    if "quoted scalar" in context and "end of stream" in said:
        return f"close the quote that was opened{above}"
    if said.startswith("expected ',' or"):
        if re.search(r"but got '\['", said) and re.match(r".*\w[^,:]*$", here[: at[1]]):
            return "put quotes around a name that has brackets in it"
        mark = "]" if "]" in said.partition("but got")[0] else "}"
        return f"put a comma before it, or close with {mark} what was opened{above}"
    if "mapping values" in said:
        return _second_colon(lines, here[: at[1]], at[0])
    if "expected ':'" in said and since is not None:
        tight = since < len(lines) and _TIGHT.match(lines[since])
        return f"write a blank after the colon{above}" if tight else f"write key: value{above}"
    return next((hint for pattern, hint in _SAID if re.search(pattern, said)), context)


def _second_colon(lines: Sequence[str], before: str, line: int) -> str:
    """A colon where none may be: in a text, or since the line above is no key or is indented otherwise."""
    if re.match(r"\s*(- +)?[^\s:][^:]*:\s+\S", before):
        return "put quotes around a text that has a colon and a blank in it"
    above = next((n for n in range(line - 1, -1, -1) if lines[n].strip() and not lines[n].lstrip().startswith("#")), None)
    if above is not None and _TIGHT.match(lines[above]):
        return f"write a blank after the colon in line {above + 1}"
    return "indent it as the keys beside it"
