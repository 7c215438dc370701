"""What a comparison leaves in the run folder for spreadsheets: rows.csv, pairs.csv and settings.csv."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gapcert.plugin import write_atomic

ROW = ("backend", "family", "lipschitz", "seed", "tightness", "samples", "cpu_s", "claim", "violations")
PAIR = ("a", "b", "mean", "max", "state", "relative", "relative_max", "resolved")
SETTING = ("setting", "value", "was", "on", "reduction", "closes", "made", "effect", "site", "native", "parameters")


def write_tables(summary: Mapping[str, Any], folder: Path) -> None:
    """One line per row of the matrix, per pair, and per setting that was named; a pair also has its states and worst point."""
    rows = [{**{k: r[k] for k in ROW}, **_states(r, ("tightness", "resolved")), **_said(r)} for r in summary["rows"]]
    rows += [{**dict.fromkeys(ROW), "backend": u["backend"], "unavailable": u["reason"]} for u in summary["unavailable"]]
    pairs = []
    for p in summary["pairs"]:
        where = {f"where {k}": v for k, v in (p["where"] or {}).items()}
        step = {f"first step by {k}": v for k, v in p.get("first_differing_step", {}).items() if k in ("bits", "resolved")}
        head = {k: p.get(k) for k in PAIR}
        pairs.append({**head, **where, **step, **_states(p, ("mean", "max", "resolved")), **_said(p)})
    settings = [
        {"a": p["a"], "b": p["b"], "rank": rank, **{k: e.get(k) for k in SETTING}}
        for p in summary["pairs"]
        for rank, e in enumerate(p["explained_by"], 1)
    ]
    heads = {"rows": ROW, "pairs": PAIR, "settings": ("a", "b", "rank", *SETTING)}
    for (name, columns), table in zip(heads.items(), (rows, pairs, settings), strict=True):
        write_atomic(folder / f"{name}.csv", _csv(table, columns).encode())


def _states(entry: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {f"{k} {name}": s[k] for name, s in entry.get("states", {}).items() for k in keys}


def _said(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {"refused": entry["refused"]} if "refused" in entry else {}


def _csv(table: Sequence[Mapping[str, Any]], head: Sequence[str]) -> str:
    """RFC 4180; numbers with all their digits, mappings and lists as JSON, nothing for None."""
    columns = list(dict.fromkeys([*head, *(k for line in table for k in line)]))
    out = io.StringIO()
    writer = csv.DictWriter(out, columns)
    writer.writeheader()
    for line in table:
        writer.writerow({k: json.dumps(v) if isinstance(v, dict | list) else v for k, v in line.items()})
    return out.getvalue()
