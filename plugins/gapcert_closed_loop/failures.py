"""What closed loops refute, in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def loop_failures(summary: Mapping[str, Any], claim: str = "") -> list[str]:
    """The policies under which runs with γ fail, or steps refute a claim about all of Z that the controller rests on."""
    rows = [p for p in summary["policies"] if p["controller"] == "with_gamma"]
    bad = [p for p in rows if p["violations"]]
    out = [f"closed loop with γ: {p['violations']} of {p['starts']} runs fail under policy '{p['policy']}'" for p in bad]
    return out + [broken_sentence(p) for p in rows if p.get("broken_promises") and claim in ("deterministic", "assumed")]


def broken_sentence(row: Mapping[str, Any]) -> str:
    """What the broken promises of a row refute."""
    text = f"closed loop with γ: {row['broken_promises']} steps under policy '{row['policy']}' break the controller's promise"
    parts = {"gap": "γ, the residual being outside [l, u]", "bound": "the bound of the model's successors"}
    found = [f"{n} refute {parts[cause]}" for cause, n in row.get("refuted", {}).items() if n]
    return f"{text}: {' and '.join(found)}" if found else text
