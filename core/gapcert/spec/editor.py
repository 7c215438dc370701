"""Where editors find the schema of specs: a file, the settings of VS Code, and a line at the top of a spec for all others."""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gapcert.numerics.errors import UsageError
from gapcert.spec.thresholds import THRESHOLDS

SCHEMA = Path(".gapcert") / "spec.schema.json"
SETTINGS = Path(".vscode") / "settings.json"
MATCH = ("specs/**/*.yaml", "**/*.gapcert.yaml")
MODELINE = "# yaml-language-server: $schema="
_SKIPPED = {"node_modules", "runs", "build", "dist", "site-packages", "__pycache__"}
_SPEC = re.compile(r"^version: *1 *(?:#.*)?$", re.MULTILINE), re.compile(r"^name: *\S", re.MULTILINE)


def install(folder: Path, schema: dict[str, Any]) -> dict[str, Any]:
    """Write the schema below a folder, and name it in its VS Code settings, which keep all else that they hold.

    Returns {"schema", "settings" (None: they have comments, and were left alone), "match", "modeline"}. UsageError where the
    folder or its settings cannot be used.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: there is no such folder; expected the one that your editor opens")
    # What cannot be used is said before anything is written.
    settings, text = _settings(folder)
    key, match = f"./{SCHEMA.as_posix()}", sorted({*MATCH, *_others(folder)})
    schemas = settings.setdefault("yaml.schemas", {})
    if not isinstance(schemas, dict):
        raise UsageError(f"{folder / SETTINGS}: yaml.schemas is {schemas!r}; expected an object; mend it, or remove it")
    given = schemas.get(key, [])
    schemas[key] = sorted({*([given] if isinstance(given, str) else given), *match})
    write(folder / SCHEMA, json.dumps(schema, indent=1) + "\n")
    if text is not None and (not text.strip() or json.loads(text) != settings):
        indent = re.search(r'\n([ \t]+)"', text)
        write(folder / SETTINGS, json.dumps(settings, indent=indent[1] if indent else 2, ensure_ascii=False) + "\n")
    return {
        "schema": str(folder / SCHEMA),
        "settings": None if text is None else str(folder / SETTINGS),
        "match": schemas[key],
        "modeline": MODELINE + SCHEMA.as_posix(),
    }


def modeline(spec: Path) -> str:
    """Name the nearest installed schema in the first line of a spec, in place of such a line; returns the line."""
    if not spec.is_file():
        raise UsageError(f"{spec}: there is no such file; expected a spec")
    here = spec.resolve().parent
    found = next((f for f in (here, *here.parents) if (f / SCHEMA).is_file()), None)
    if found is None:
        raise UsageError(f"{spec}: there is no {SCHEMA} in its folder or above; run `gapcert schema --install FOLDER` first")
    line = MODELINE + Path(os.path.relpath(found / SCHEMA, here)).as_posix()
    try:
        text = spec.read_bytes().decode("utf-8")
    except UnicodeDecodeError as error:
        raise UsageError(f"{spec}: it is not text in UTF-8 ({error}); save it as such, and run this again") from None
    end = "\r\n" if "\r\n" in text else "\n"
    kept = [part for part in text.splitlines(keepends=True) if not part.startswith(MODELINE)]
    write(spec, "".join([line + end, *kept]))
    return line


def write(path: Path, text: str) -> None:
    """All of a text or nothing of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path = path.resolve()  # a link stays one
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as file:
            file.write(text)
        os.chmod(name, path.stat().st_mode & 0o7777 if path.exists() else 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _settings(folder: Path) -> tuple[dict[str, Any], str | None]:
    """(what they say, their text); no text where Python's JSON would lose their comments, UsageError where they are broken."""
    path = folder / SETTINGS
    if not path.exists():
        return {}, ""
    text = ""
    try:
        text = path.read_text(encoding="utf-8")
        found = json.loads(text) if text.strip() else {}
    except ValueError as error:
        if re.search(r"//|/\*|,\s*[}\]]", text):
            return {}, None
        raise UsageError(f"{path}: it is not JSON ({error}); mend it, and run this again") from None
    if not isinstance(found, dict):
        raise UsageError(f"{path}: found {type(found).__name__}; expected an object; mend it, and run this again")
    return found, text


def _others(folder: Path) -> Iterator[str]:
    """Specs that lie where no pattern finds them, as deep as one is likely to look."""
    for where, folders, names in os.walk(folder):
        deep = len(Path(where).relative_to(folder).parts) >= THRESHOLDS.editor_depth
        folders[:] = [] if deep else sorted(f for f in folders if f not in _SKIPPED and not f.startswith("."))
        for path in (Path(where, name) for name in names if name.endswith(".yaml") and not name.endswith(".gapcert.yaml")):
            inside = path.relative_to(folder)
            if inside.parts[0] != "specs" and _is_spec(path):
                yield inside.as_posix()


def _is_spec(path: Path) -> bool:
    """Does it look like one? What cannot be read does not."""
    try:
        text = path.read_text(encoding="utf-8", errors="replace") if path.stat().st_size < THRESHOLDS.editor_bytes else ""
    except OSError:
        return False
    return all(pattern.search(text) for pattern in _SPEC)


def in_words(done: dict[str, Any]) -> list[str]:
    """What was done, and what is left to do."""
    words = [f"{done['schema']}: what specs may say, with all that is installed now; run this again after a new plugin"]
    if done["settings"] is None:
        entry = json.dumps({f"./{SCHEMA.as_posix()}": done["match"]})
        words.append(f'.vscode/settings.json has comments, and was left alone; add to it: "yaml.schemas": {entry}')
    else:
        words.append(f"{done['settings']}: VS Code with the extension YAML (redhat.vscode-yaml) uses it for")
        words += [f"  {pattern}" for pattern in done["match"]]
    words.append("other editors, or other files: `gapcert schema --modeline SPEC` puts a line such as this at the top")
    return [*words, f"  {done['modeline']}"]
