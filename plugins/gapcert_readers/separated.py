"""Separated text as Arrow tables: which mark stands between the values, and which in the numbers, is seen in the text."""

from __future__ import annotations

import csv
import io
import itertools
import re
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from gapcert_readers.thresholds import THRESHOLDS

MARKS = ",;\t "
LARGEST = 2**31 - 1  # bytes of a block: what decides on the type of a column
_COMMA = r"^\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*$"
_GROUPED = r"^\s*[+-]?[1-9]\d{0,2}(,\d{3})+\s*$"
_CLOCK = r"^\s*\d{1,2}:\d\d:\d\d([.,]\d+)?\s*$"
_DAY = 86400.0  # s


def separated(path: Path) -> Any:
    """The file as a pyarrow.Table."""
    data: Any = path
    with path.open("rb") as file:
        if file.read(2) in (b"\xff\xfe", b"\xfe\xff"):
            raise gc.UsageError(f"recording: {path.name} is in UTF-16; expected text in UTF-8; save it as `CSV UTF-8`")
    above, mark = layout(path)
    _headed(path, _lines(path, above), mark)
    if above:
        # Arrow would count the columns by what is said there, or skip rows, of which empty lines are none.
        data = io.BytesIO(path.read_bytes().split(b"\n", above)[-1])
    if mark == " ":
        # Several blanks are one: columns of numbers are often lined up.
        text = data.getvalue() if above else path.read_bytes()
        text = re.sub(rb"^[#%] *", b"", text)
        data = io.BytesIO(re.sub(rb"(?m)^ +| +(?=\r?$)", b"", re.sub(rb" +", b" ", text)))
    table = _parsed(data, path, mark, ".")
    commas = [n for n in table.column_names if mark != "," and _any(table[n], _COMMA)]
    if commas:
        table = _with_commas(data, path, mark, table, commas)
    return _with_clocks(table)


def layout(path: Path) -> tuple[int, str]:
    """(how many lines stand above the header, what stands between the values).

    The header and the lines below it have as many values as most lines have, and below other lines it has no numbers;
    where there is no such line, it is the first. The mark is the one that finds it first, or else makes the most values; blanks
    stand beside other marks too. Lines that begin with # or % are remarks; the last one is the header where numbers follow it.
    """
    lines = [(n, line.strip("\r\n")) for n, line in enumerate(_text(path, THRESHOLDS.preamble_lines)) if line.strip()]
    first = next((i for i, (_, line) in enumerate(lines) if not _remark(line)), len(lines))
    headed = first > 0 and first < len(lines) and re.match(r"\s*[-+.\d]", lines[first][1])
    lines = lines[first - 1 if headed else first :]
    found = []
    for mark in MARKS:
        rows = [_split(_bare(line), mark) for _, line in lines]
        counts = [len(row) for row in rows]
        if counts and (usual := statistics.mode(counts)) > 1:
            starts = (i for i in range(len(counts) - 1) if set(counts[i : i + 3]) == {usual})
            start = next((i for i in starts if not i or set(map(_kind, rows[i])) <= {"text", "none"}), None)
            found.append((mark == " ", start is None, start or 0, -usual, mark))
    if not found:
        return lines[0][0] if lines else 0, ","
    *_, start, _, mark = min(found)
    return lines[start][0], mark


def _headed(path: Path, lines: Sequence[str], mark: str) -> None:
    """UsageError where the first line has values in place of names, or the second has units in place of values."""
    cells = [cell.strip() for cell in _split(lines[0], mark)] if lines else []
    names, *rows = ([_kind(cell) for cell in _split(line, mark)] for line in lines)
    where = f"recording: {path.name}"
    if names and set(names) <= {"number", "whole"} and ("number" in names or len(set(cells)) < len(cells)):
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
    above = layout(path)[0]
    with open(path, encoding="utf-8", errors="replace", newline=None) as file:
        full = (n for n, line in enumerate(file, 1) if n > above and line.strip("\r\n"))
        return next(itertools.islice(full, row + 1, None), row + 2)


def _lines(path: Path, above: int) -> list[str]:
    """The header and the first two rows."""
    below = itertools.islice(_text(path), above, None)
    return [_bare(line) for line in itertools.islice((line.rstrip("\r\n") for line in below if line.strip("\r\n")), 3)]


def _text(path: Path, most: int | None = None) -> Iterator[str]:
    """Lines of a file that may be anything, at most so many."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for _ in itertools.count() if most is None else range(most):
            if not (line := file.readline(1 << 20)):
                return
            yield line


def _remark(line: str) -> bool:
    return line.lstrip().startswith(("#", "%"))


def _bare(line: str) -> str:
    """Without the sign of a remark, as headers have it that NumPy writes."""
    return re.sub(r"^\s*[#%]+\s*", "", line)


def _split(line: str, mark: str) -> list[str]:
    return line.split() if mark == " " else next(csv.reader([line], delimiter=mark), [])


def _parsed(data: Any, path: Path, mark: str, decimal: str) -> Any:
    """Read by Arrow, which sees the type of a column in its first block: the whole file where a later one disagrees."""
    import pyarrow
    from pyarrow import ArrowInvalid
    from pyarrow import csv as arrow

    parse = arrow.ParseOptions(delimiter=mark)
    convert = arrow.ConvertOptions(decimal_point=decimal)

    def read(**options: Any) -> Any:
        if data is not path:
            data.seek(0)
        table = arrow.read_csv(data, arrow.ReadOptions(**options), parse, convert)
        if _undecoded(table) and "encoding" not in options:
            # Loggers and spreadsheets that do not know UTF-8 write ° and µ as single bytes.
            return read(encoding="latin-1", **options)
        named = [_bare(n).strip() for n in table.column_names]
        # A mark at the end of each line makes a column of nothing.
        kept = [i for i, n in enumerate(named) if n or not pyarrow.types.is_null(table.column(i).type)]
        return table.select(kept).rename_columns(_distinct([named[i] or f"column {i + 1}" for i in kept]))

    def whole() -> Any:
        try:
            return read()
        except ArrowInvalid as error:
            if "conversion error" not in str(error):
                raise
            return read(block_size=min(max(path.stat().st_size, 1) + 1, LARGEST))

    try:
        return whole()
    except ArrowInvalid as error:
        if re.search(r"Expected \d+ columns, got \d+", str(error)):
            raise _uneven(path, mark) or error from None
        raise


def _distinct(names: Sequence[str]) -> list[str]:
    """Names that several columns have are numbered: `y (1)`, `y (2)`."""
    return [f"{n} ({names[: i + 1].count(n)})" if names.count(n) > 1 else n for i, n in enumerate(names)]


def _with_clocks(table: Any) -> Any:
    """With times of day, such as 10:11:12.5, in seconds, which go on past midnight."""
    import pyarrow

    for i, name in enumerate(table.column_names):
        column = table.column(i)
        if pyarrow.types.is_time(column.type) or _all(column, _CLOCK):
            parts = [None if v is None else str(v).strip().replace(",", ".").split(":") for v in column.to_pylist()]
            t = np.array([np.nan if not p or p == [""] else float(p[0]) * 3600 + float(p[1]) * 60 + float(p[2]) for p in parts])
            days = np.cumsum(np.diff(t, prepend=t[:1]) < -_DAY / 2)
            table = table.set_column(i, name, pyarrow.array(t + _DAY * days))
    return table


def _undecoded(table: Any) -> bool:
    """Has it text that is not UTF-8?"""
    import pyarrow

    try:
        return any(pyarrow.types.is_binary(table[i].type) for i in range(len(table.column_names)))
    except UnicodeDecodeError:
        return True


def _uneven(path: Path, mark: str) -> gc.UsageError | None:
    """The first line that has another number of values than the header."""
    above, names = layout(path)[0], 0
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


def _all(column: Any, pattern: str) -> bool:
    """Does a column of text have values of this form alone, and empty ones?"""
    from pyarrow import compute

    return _any(column, pattern) and bool(compute.all(compute.match_substring_regex(column, rf"{pattern}|^\s*$")).as_py())


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
