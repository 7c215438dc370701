"""Separated text as Arrow tables: which mark stands between the values, and which in the numbers, is seen in the text."""

from __future__ import annotations

import csv
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gapcert as gc
from gapcert_readers.thresholds import THRESHOLDS

MARKS = ",;\t "
LARGEST = 2**31 - 1  # bytes of a block: what decides on the type of a column
_COMMA = r"^\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*$"
_GROUPED = r"^\s*[+-]?[1-9]\d{0,2}(,\d{3})+\s*$"


def separated(path: Path) -> Any:
    """The file as a pyarrow.Table."""
    data: Any = path
    with path.open("rb") as file:
        if file.read(2) in (b"\xff\xfe", b"\xfe\xff"):
            raise gc.UsageError(f"recording: {path.name} is in UTF-16; expected text in UTF-8; save it as `CSV UTF-8`")
    lines, above = _lines(path), remarks(path)
    mark = mark_of(lines)
    _headed(path, lines, mark)
    if above:
        # Arrow would count the columns by what is said there, or skip rows, of which empty lines are none.
        data = io.BytesIO(path.read_bytes().split(b"\n", above)[-1])
    if mark == " ":
        # Several blanks are one: columns of numbers are often lined up.
        text = data.getvalue() if above else path.read_bytes()
        data = io.BytesIO(re.sub(rb"(?m)^ +| +(?=\r?$)", b"", re.sub(rb" +", b" ", text)))
    table = _parsed(data, path, mark, ".")
    commas = [n for n in table.column_names if mark != "," and _any(table[n], _COMMA)]
    if commas:
        table = _with_commas(data, path, mark, table, commas)
    names = [n.strip() for n in table.column_names]
    return table.rename_columns(names) if len(set(names)) == len(names) else table


def mark_of(lines: Sequence[str]) -> str:
    """What stands between the values: the mark that splits the header and the first row into equally many, and most."""
    head = lines[:2]
    counts = {mark: {len(_split(line, mark)) for line in head} for mark in MARKS}
    fitting = {mark: max(n) for mark, n in counts.items() if len(n) == 1 and max(n) > 1}
    # Blanks stand beside other marks too.
    if len(fitting) > 1:
        fitting.pop(" ", None)
    return max(fitting, key=lambda mark: fitting[mark], default=",")


def _headed(path: Path, lines: Sequence[str], mark: str) -> None:
    """UsageError where the first line has values in place of names, or the second has units in place of values."""
    names, *rows = ([_kind(cell) for cell in _split(line, mark)] for line in lines)
    where = f"recording: {path.name}"
    if names and set(names) <= {"number", "whole"} and "number" in names:
        what = f"the first line has numbers ('{lines[0][:60]}')"
        raise gc.UsageError(f"{where}: {what}; expected a header; put a line with the names of the columns above")
    if len(rows) > 1 and "text" in rows[0] and set(rows[0]) <= {"text", "none"}:
        under = {below for cell, below in zip(rows[0], rows[1], strict=False) if cell == "text"}
        if "text" not in under and under & {"number", "whole"}:
            unit = f"'{_split(lines[0], mark)[0].strip()} [{_split(lines[1], mark)[0].strip()}]'"
            what = f"line {line_of(path, 0)} has no numbers ('{lines[1][:60]}')"
            raise gc.UsageError(f"{where}: {what}; expected values; if these are units, write them into the header, {unit}")


def _kind(cell: str) -> str:
    """`number`, `whole`, `text`, or `none` where nothing is said."""
    text = cell.strip().replace(",", ".")
    if text.lower() in ("", "na", "n/a", "nan", "null", "-"):
        return "none"
    try:
        float(text)
    except ValueError:
        return "text"
    return "whole" if re.fullmatch(r"\d+", text) else "number"


def line_of(path: Path, row: int) -> int:
    """The number of the line, from 1, where a row, from 0, stands below the header; lines that are empty hold none."""
    above = remarks(path)
    with open(path, encoding="utf-8", errors="replace", newline=None) as file:
        full = (n for n, line in enumerate(file, 1) if n > above and line.strip("\r\n"))
        return next(itertools.islice(full, row + 1, None), row + 2)


def remarks(path: Path) -> int:
    """How many lines that begin with # or % stand above the header, which is the first without, and holds names."""
    for n, line in enumerate(itertools.islice(_text(path), THRESHOLDS.preamble_lines)):
        if line.strip() and not line.lstrip().startswith(("#", "%")):
            # Where numbers follow, the last remark is the header.
            return 0 if re.match(r"\s*[-+.\d]", line) else n
    return 0


def _lines(path: Path) -> list[str]:
    """The header and the first two rows."""
    below = itertools.islice(_text(path), remarks(path), None)
    return list(itertools.islice((line.rstrip("\r\n") for line in below if line.strip("\r\n")), 3))


def _text(path: Path) -> Iterator[str]:
    """Lines of a file that may be anything."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        while line := file.readline(1 << 20):
            yield line


def _split(line: str, mark: str) -> list[str]:
    return line.split() if mark == " " else next(csv.reader([line], delimiter=mark), [])


def _parsed(data: Any, path: Path, mark: str, decimal: str) -> Any:
    """Read by Arrow, which sees the type of a column in its first block: the whole file where a later one disagrees."""
    from pyarrow import ArrowInvalid
    from pyarrow import csv as arrow

    parse = arrow.ParseOptions(delimiter=mark)
    convert = arrow.ConvertOptions(decimal_point=decimal)

    def read(**options: Any) -> Any:
        if data is not path:
            data.seek(0)
        return arrow.read_csv(data, arrow.ReadOptions(**options), parse, convert)

    def whole(**options: Any) -> Any:
        try:
            return read(**options)
        except ArrowInvalid as error:
            if "conversion error" not in str(error):
                raise
            return read(block_size=min(max(path.stat().st_size, 1) + 1, LARGEST), **options)

    try:
        table = whole()
        # Loggers and spreadsheets that do not know UTF-8 write ° and µ as single bytes.
        return whole(encoding="latin-1") if _undecoded(table) else table
    except ArrowInvalid as error:
        if re.search(r"Expected \d+ columns, got \d+", str(error)):
            raise _uneven(path, mark) or error from None
        raise


def _undecoded(table: Any) -> bool:
    """Has it text that is not UTF-8?"""
    import pyarrow

    try:
        return any(pyarrow.types.is_binary(table[i].type) for i in range(len(table.column_names)))
    except UnicodeDecodeError:
        return True


def _uneven(path: Path, mark: str) -> gc.UsageError | None:
    """The first line that has another number of values than the header."""
    above, names = remarks(path), 0
    for n, line in enumerate(_text(path), 1):
        if n > above and (text := line.rstrip("\r\n")):
            count = len(_split(text, mark))
            names = names or count
            if count != names:
                what = f"line {n} has {count} value{'s' * (count != 1)} ('{text[:60]}')"
                todo = "mend it, or remove it if the log was cut off there"
                said = f"recording: {path.name} cannot be read: {what}; expected {names}, as the header has; {todo}"
                return gc.UsageError(said)
    return None


def _any(column: Any, pattern: str) -> bool:
    """Does a column of text have values of this form?"""
    import pyarrow
    from pyarrow import compute

    text = pyarrow.types.is_string(column.type)
    return text and bool(compute.any(compute.match_substring_regex(column, pattern)).as_py())


def _with_commas(data: Any, path: Path, mark: str, points: Any, names: Sequence[str]) -> Any:
    """Read again with the comma as the decimal sign; UsageError where it need not be one."""
    import pyarrow
    from pyarrow import compute

    where, todo = f"recording: {path.name}", "write all numbers with a point"
    table = _parsed(data, path, mark, ",")
    lost = [n for n in table.column_names if pyarrow.types.is_string(table[n].type) and n not in names]
    if lost := [n for n in lost if pyarrow.types.is_floating(points[n].type)]:
        what = f"'{names[0].strip()}' has numbers with a decimal comma, '{lost[0].strip()}' with a point"
        raise gc.UsageError(f"{where}: {what}; expected one decimal sign; {todo}")
    commas = [points[n].filter(compute.match_substring_regex(points[n], _COMMA)) for n in names]
    grouped = [compute.all(compute.match_substring_regex(c, _GROUPED)).as_py() for c in commas]
    if all(grouped):
        value = commas[0][0].as_py().strip()
        what = f"'{value}' in '{names[0].strip()}' is {value.replace(',', '.')} or {value.replace(',', '')}"
        raise gc.UsageError(f"{where}: {what}; expected a decimal sign that cannot be mistaken; {todo}")
    for i, name in enumerate(table.column_names):
        # Where other text keeps a column from being numbers, its numbers are still to be told from that text.
        if pyarrow.types.is_string(table[name].type):
            number = compute.match_substring_regex(table[name], _COMMA)
            point = compute.if_else(number, compute.replace_substring(table[name], ",", "."), table[name])
            table = table.set_column(i, name, point)
    return table
