"""The answer of a run as text, for viewers that show markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .compare import compare_markdown
from .diagnosis import diagnosis_markdown
from .words import claim_sentence, loop_sentence, markdown_table, number, plain


def markdown(summary: Mapping[str, Any]) -> str:
    """The answer of a run as text, for viewers that show markdown: the verdict and its reason, then what they rest on."""
    parts = [f"# {summary['name']}: {summary['verdict']}"] if "verdict" in summary else []
    if summary.get("verdict") in ("fails", "unknown") and summary.get("reason"):
        parts.append(f"**{plain(str(summary['reason'])).rstrip('.')}.**")
    if "certificate" in summary:
        c = summary["certificate"]
        columns = {"gap_mean": "mean gap", "gamma_mean": "mean γ", "tightness": "tightness", "constant_bound": "constant"}
        if not any("gamma_mean" in s for s in c["states"].values()):
            columns = {"gamma_max": "declared γ"}
        known = {k: title for k, title in columns.items() if any(s.get(k) is not None for s in c["states"].values())}
        named = {n: f"{n} (vacuous)" if s.get("vacuous") else n for n, s in c["states"].items()}
        rows = [(named[name], *(number(s.get(k), 3) for k in known)) for name, s in c["states"].items()]
        parts += [claim_sentence(c), loop_sentence(summary), markdown_table(("state", *known.values()), rows)]
        parts += ["## Assumptions", "\n".join(f"{i}. {plain(a)}" for i, a in enumerate(c["assumptions"], 1)) or "None."]
        if "samples" in c:
            parts += [f"Transitions spent: {', '.join(f'{k} {v:,}' for k, v in c['samples'].items())}."]
    if "pairs" in summary:
        parts.append(compare_markdown(summary))
    if "causes" in summary:
        parts += diagnosis_markdown(summary)
    return "\n\n".join(p for p in parts if p) + "\n"
