"""Tables of single answers: who is taken for whom, and every miss."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from exams import score
from exams.score import Record


def said(r: Record) -> str:
    """An answer in a few words."""
    if "error" in r:
        return f"error: {r['error']}"
    names = " + ".join(f"{e}@{s}" for e, s in score.named(r)) or "–"
    ties = " | ".join(" + ".join(f"{k[0]}@{k[1]}" for k in g) for g in r.get("ambiguous_with", []))
    return f"{r['verdict']}: {names}" + (f" (or {ties})" if ties else "")


def confusion(records: Sequence[Record]) -> str:
    """Effects by effects: what was hidden (rows), what was named first (columns with any entry)."""
    pairs: Counter[tuple[str, str]] = Counter()
    for r in records:
        hidden = " + ".join(h["effect"] for h in r["hidden"]) or "nothing"
        first = score.first(r)
        pairs[hidden, first[0] if first else r.get("verdict", "error")] += 1
    lines = ["| hidden | cases | named first |", "| --- | ---: | --- |"]
    for hidden in sorted({h for h, _ in pairs}):
        named = sorted(((n, k) for (h, k), n in pairs.items() if h == hidden), reverse=True)
        lines.append(f"| {hidden} | {sum(n for n, _ in named)} | {', '.join(f'{k} {n}' for n, k in named)} |")
    return "\n".join(lines)


def misses(records: Sequence[Record]) -> str:
    """One line per answer that is not right."""
    lines = []
    for r in sorted(records, key=lambda r: (r["part"], r["index"])):
        hidden = " + ".join(f"{h['effect']}@{h['site']}" for h in r["hidden"]) or "nothing"
        right = score.silent(r) if not r["hidden"] else score.both(r) if len(r["hidden"]) > 1 else score.in_class(r)
        if not right:
            what = f"{r['part']} {r['index']}: {r['plant']}, {r['excitation']}, {r['period']:g} s, {r['strength']:g} σ"
            lines.append(f"- {what}: {hidden} → {said(r)} [{r['cpu']:g} s]")
    return "\n".join(lines) or "- none"
