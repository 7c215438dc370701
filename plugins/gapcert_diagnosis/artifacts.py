"""What a diagnosis leaves to work with: the extended model as a spec, and the signal of the experiment."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from textwrap import wrap
from typing import Any

from gapcert.plugin import Answer, Arguments, UsageError, damage_told, read, write_atomic

from .results import Diagnosis

EXTENDED, SIGNAL = "extended.yaml", "experiment.csv"


def left_behind(name: str, found: Diagnosis, folder: Path) -> dict[str, Any]:
    """Write the extended model's spec, where something was named, and the signal of the experiment; what was written."""
    out: dict[str, Any] = {}
    if found.causes:
        text = spec_text(f"{name}-extended", found)
        write_atomic(folder / EXTENDED, text.encode())
        out |= {"extended_model": str(folder / EXTENDED), "equations": found.extended_model.equations()}
        for file, content in found.extended_model.files().items():
            write_atomic(folder / file, content.encode())
            out.setdefault("files", []).append(str(folder / file))
    if found.design is not None:
        write_atomic(folder / SIGNAL, found.design.csv().encode())
        out["experiment_file"] = str(folder / SIGNAL)
    return out


def spec_text(name: str, found: Diagnosis) -> str:
    """A spec with nothing but the model, under what was found and its equations as comments."""
    from ruamel.yaml import YAML

    text = io.StringIO()
    dump: Any = YAML(typ="safe")
    dump.default_flow_style, dump.width, dump.sort_base_mapping_type_on_output = None, 120, False
    dump.dump({"version": 1, "name": name, "model": found.extended_model.to_spec()}, text)
    said = [*wrap(found.sentence(), 116), "", *found.extended_model.equations().splitlines()]
    if found.extended_model.hidden:
        names = ", ".join(s.name for s in found.extended_model.hidden)
        said += [
            "",
            f"It remembers {names}, which nothing measures: a certificate needs `hidden:` ranges for them, or refuses.",
        ]
    return "".join(f"# {line}".rstrip() + "\n" for line in said) + text.getvalue()


def extended_spec(run: Path) -> tuple[str, Mapping[str, Any]]:
    """The extended model of a finished run: the text of its spec, and its data with the equations.

    UsageError where the folder has none.
    """
    file, told = run / EXTENDED, run / "summary.json"
    if not told.is_file():
        raise UsageError(f"{run}: there is no summary.json; expected the folder of a finished run; run the spec again")
    with damage_told(run):
        summary = json.loads(told.read_text(encoding="utf-8"))
        if not isinstance(summary, dict):
            raise TypeError("summary.json holds no object")
    if not file.is_file():
        what = f"its verdict is '{summary.get('verdict')}'" if "causes" in summary else "it is no diagnosis"
        raise UsageError(f"{run}: has no extended model ({what}); expected a diagnosis that named a cause")
    tree = read(file)
    return file.read_text(encoding="utf-8"), {"spec": tree.data, "equations": summary.get("equations", "")}


def command(options: Arguments) -> Answer:
    """`gapcert extend`."""
    text, data = extended_spec(Path(options.run))
    if options.output is None:
        return Answer(data, [text.rstrip()])
    path = Path(options.output)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror}); choose another file with -o") from None
    return Answer({"extended": str(path), **data}, [str(path)])
