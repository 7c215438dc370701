"""The answer of a run as text, for viewers that show markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .compare import compare_markdown
from .diagnosis import diagnosis_markdown
from .words import claim_sentence, loop_sentence, number, plain


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))


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
        rows = [(_doubtful(name, s), *(number(s.get(k), 3) for k in known)) for name, s in c["states"].items()]
        parts += [claim_sentence(c), loop_sentence(summary), _markdown_table(("state", *known.values()), rows)]
        parts += ["## Assumptions", "\n".join(f"{i}. {plain(a)}" for i, a in enumerate(c["assumptions"], 1)) or "None."]
        if "samples" in c:
            parts += [f"Transitions spent: {', '.join(f'{k} {v:,}' for k, v in c['samples'].items())}."]
    if "pairs" in summary:
        parts.append(compare_markdown(summary))
    if "causes" in summary:
        parts += diagnosis_markdown(summary)
    return "\n\n".join(p for p in parts if p) + "\n"


def _doubtful(name: str, state: Mapping[str, Any]) -> str:
    return f"{name} (vacuous)" if state.get("vacuous") else name
