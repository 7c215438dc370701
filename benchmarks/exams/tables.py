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


def ties(records: Sequence[Record]) -> str:
    """Effects by what their answers left open: how often, and which effects stood beside the one that was named."""
    lines = ["| hidden | answers | certain | open | beside the named one |", "| --- | ---: | ---: | ---: | --- |"]
    by = {h: [r for r in records if " + ".join(k["effect"] for k in r["hidden"]) == h] for h in _hidden(records)}
    for hidden, some in by.items():
        given = [r for r in some if score.named(r)]
        left = [r for r in given if r["ambiguous_with"]]
        beside = Counter(
            e for r in left for e in {k[0] for g in r["ambiguous_with"] for k in g} - {e for e, _ in score.named(r)}
        )
        texts = ", ".join(f"{e} {n}" for e, n in beside.most_common())
        lines.append(f"| {hidden} | {len(given)} | {len(given) - len(left)} | {len(left)} | {texts} |")
    return "\n".join(lines)


def alarms(records: Sequence[Record]) -> str:
    """Cases without anything hidden, by where they come from and the colour of their noise."""
    count: dict[tuple[str, str], Counter[str]] = {}
    for r in records:
        key = r["engine"] or "our generator", "coloured" if r["colour"] > 0 else "white"
        count.setdefault(key, Counter())["named" if score.named(r) else r.get("verdict", "error")] += 1
    kinds = ("nothing", "named", "unexplained", "error")
    lines = ["| data from | noise | " + " | ".join(kinds) + " |", "| --- | --- |" + " ---: |" * len(kinds)]
    lines += [f"| {a} | {b} | " + " | ".join(str(c[k]) for k in kinds) + " |" for (a, b), c in sorted(count.items())]
    return "\n".join(lines)


def page(part: str, records: Sequence[Record]) -> str:
    """All tables of a part, as Markdown."""
    if part.endswith("nothing"):
        shown = [("What was said where nothing is hidden", alarms(records))]
    else:
        shown = [("What was named first", confusion(records)), ("What was left open", ties(records))]
    shown.append(("Answers that are not right", misses(records)))
    return "\n\n".join([f"### {part}", *(f"{title}:\n\n{text}" for title, text in shown)]) + "\n"


def _beside(r: Record) -> set[str]:
    """Effects that an answer leaves open; one that is named may be among them at another site."""
    named = set(score.named(r))
    return {e for e, site in ((k[0], k[1]) for g in r["ambiguous_with"] for k in g) if (e, site) not in named}


def _hidden(records: Sequence[Record]) -> list[str]:
    return sorted({" + ".join(h["effect"] for h in r["hidden"]) for r in records})


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
