"""The archive of an FMU, which a stranger may have written: unpacked into a folder, and no further."""

from __future__ import annotations

import re
import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from gapcert import UsageError
from gapcert_fmu.thresholds import THRESHOLDS

DESCRIPTION = "modelDescription.xml"
_CHUNK = 1 << 20
_DECLARES = re.compile(rb"<!\s*(DOCTYPE|ENTITY)", re.I)
"""Of an XML: entities that a parser would expand or fetch. No model description has any."""


def unpack(path: Path, folder: Path, megabytes: int) -> None:
    """Everything but sources and documentation; UsageError where an entry would leave the folder, or there is too much.

    Sizes are counted while they are unpacked: what an archive says of itself is not believed.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            if len(entries) > THRESHOLDS.archive_entries:
                raise UsageError(f"file: {path} has {len(entries)} entries; expected at most {THRESHOLDS.archive_entries}")
            names = set[str]()
            for entry in entries:
                _check(path, entry, names)
            if DESCRIPTION not in names:
                raise UsageError(f"file: {path} has no {DESCRIPTION}; expected a Functional Mock-up Unit")
            left = megabytes << 20
            for entry in entries:
                top = PurePosixPath(entry.filename).parts[0]
                if not entry.is_dir() and top not in ("sources", "documentation", "terminalsAndIcons"):
                    left = _write(path, archive, entry, folder, left, megabytes)
    except (zipfile.BadZipFile, EOFError, zlib.error, RuntimeError, OSError) as error:
        raise UsageError(f"file: {path} cannot be unpacked: {error}; expected a whole FMU, a zip archive") from None
    text = (folder / DESCRIPTION).read_bytes()
    if len(text) > THRESHOLDS.description_bytes or _DECLARES.search(text) or b"\0" in text:
        raise UsageError(
            f"file: {path}: its {DESCRIPTION} declares entities, or is no plain UTF-8; expected XML without a DOCTYPE"
        )


def _check(path: Path, entry: zipfile.ZipInfo, names: set[str]) -> None:
    """Refuses names that point elsewhere, links, encryption and two entries of one name."""
    name, kind = entry.filename, stat.S_IFMT(entry.external_attr >> 16)
    parts = PurePosixPath(name).parts
    if not parts or name.startswith("/") or ".." in parts or "\\" in name or ":" in parts[0] or "\0" in name:
        raise UsageError(
            f"file: {path}: entry '{name}' points out of the archive; expected names below its root; do not use it"
        )
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise UsageError(
            f"file: {path}: entry '{name}' is no plain file (a link, say); expected files and folders; do not use it"
        )
    if entry.flag_bits & 1:
        raise UsageError(f"file: {path}: entry '{name}' is encrypted; expected an open archive")
    if name in names:
        raise UsageError(f"file: {path}: entry '{name}' is there twice; expected one of each name")
    names.add(name)


def _write(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path, left: int, megabytes: int) -> int:
    """Bytes that may still come after one entry."""
    target = folder.joinpath(*PurePosixPath(entry.filename).parts)
    target.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(entry) as source, target.open("wb") as out:
        while chunk := source.read(_CHUNK):
            if (left := left - len(chunk)) < 0:
                raise UsageError(f"file: {path} unpacks to more than {megabytes} MB; raise backend.megabytes if that is meant")
            out.write(chunk)
    return left
