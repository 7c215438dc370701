"""A comparison in sentences: who agrees, who does not, and which setting separates them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from gapcert.plugin import times
from gapcert_figures import called

from .diagnosis import cause_name, measured
from .words import Summary, listed, markdown_table, number


def apart(summary: Summary) -> list[Summary]:
    """The pairs that differ by more than their resolution, the largest difference first."""
    found = [p for p in summary["pairs"] if p.get("resolved")]
    return sorted(found, key=lambda p: -float(p["relative"]))


def groups(summary: Summary) -> list[list[str]]:
    """Simulators all of which agree with one another; the largest group first. Each coarse one is a group by itself."""
    alone = coarse(summary)
    return sorted([*_connected(summary, alone), *([n] for n in alone)], key=lambda g: -len(g))


def coarse(summary: Summary) -> list[str]:
    """Simulators that agree with some that differ from each other: their own resolution is what does not tell these apart."""
    out: list[str] = []
    while mixed := [g for g in _connected(summary, out) if any(_friends(summary, n, out) < set(g) - {n} for n in g)]:
        out.append(max(mixed[0], key=lambda n: len(_friends(summary, n, out))))
    return [n for n in summary["backends"] if n in out]


def _friends(summary: Summary, name: str, without: Sequence[str]) -> set[str]:
    return set(summary["backends"][name]["agrees_with"]) - set(without)


def _connected(summary: Summary, without: Sequence[str]) -> list[list[str]]:
    """Simulators that agree with one another, directly or through others."""
    left, out = dict.fromkeys(n for n in summary["backends"] if n not in without), []
    while left:
        group, todo = list[str](), [next(iter(left))]
        while todo:
            name = todo.pop()
            if name in left:
                del left[name]
                group.append(name)
                todo += _friends(summary, name, without)
        out.append([n for n in summary["backends"] if n in group])
    return out


def share(value: float) -> str:
    """A share as percent: `0.15 %`."""
    return f"{number(100 * value, 3)} %"


def setting_name(entry: Summary) -> str:
    """`damping 0.04 → 0 of pybullet`; several are joined by `and`."""
    return " and ".join(map(_change, entry.get("changes", [entry])))


def _change(part: Summary) -> str:
    """A setting, with what it does to the motion where a diagnosis says so; or an effect with its numbers."""
    numbers = part.get("parameters", {})
    if "effect" in part and not part["options"] and part["was"] is None:
        shown = (f"{n.replace('_', ' ')} {measured(_value(p['value']), p['unit'])}" for n, p in numbers.items())
        return f"{cause_name(part)} ({', '.join(shown)}) in {part['on']}"
    unit = next(iter(numbers.values()))["unit"] if len(numbers) == 1 else ""
    text = f"{part['setting']} {_value(part['was'])} → {measured(_value(part['value']), unit)} of {part['on']}"
    if part.get("effect", "parameter") != "parameter":
        return f"{text} ({cause_name(part)})"
    native = part.get("native", part["setting"])
    return text if native == part["setting"] else f"{text} ({native})"


def made(entry: Summary) -> bool:
    """Whether the simulator was told a change, or else the equations of its bodies."""
    return bool(entry.get("made", True))


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "(" + ", ".join(f"{k} {_value(v)}" for k, v in value.items()) + ")"
    if isinstance(value, list):
        return "(" + ", ".join(map(_value, value)) + ")"
    return f"{value:g}" if isinstance(value, float) else "the file's" if value is None else number(value)


def sentences(summary: Summary) -> Iterator[str]:
    """The answer: first who agrees, then one sentence for each cause of a difference."""
    for group in groups(summary):
        if len(group) > 1:
            worst = max(p["max"] for p in summary["pairs"] if p.get("resolved") is False and {p["a"], p["b"]} <= set(group))
            less = "to the last bit" if worst == 0 else f"to {number(worst, 2)}, below the resolution of their arithmetic"
            yield f"{listed(group)} give one answer, {less}."
    from gapcert_compare import closed

    causes: dict[str, list[Summary]] = {}
    for p in apart(summary):
        causes.setdefault(setting_name(p["explained_by"][0]) if closed(p) else "", []).append(p)
    for name, pairs in causes.items():
        who, most = _who(pairs, summary["backends"]), share(pairs[0]["relative"])
        if name:
            yield f"{who}, on average by {most} of what one step moves. {_closed(name, pairs[0]['explained_by'][0])}"
        else:
            yield f"{who}, on average by up to {most} of what one step moves, and no setting that was tried closes it."
    for name in coarse(summary):
        friends = summary["backends"][name]["agrees_with"]
        own = (p["states"].values() for p in summary["pairs"] if name in (p["a"], p["b"]) and p.get("resolved") is False)
        least = min(max(float(s["resolution"]) for s in states) for states in own)
        yield (
            f"{name} cannot be told from {listed(friends)}, which differ: what its own solver may leave undone, up to "
            f"{number(least, 2)} a step, is more than lies between them."
        )


def _closed(name: str, entry: Summary) -> str:
    gone = share(entry["reduction"])
    text = f"Changing {name} takes {gone} of that away."
    if not made(entry):
        text = (
            f"With {name}, written into the equations of its bodies, {gone} of that is gone; "
            "the simulator itself cannot be told all of it."
        )
    same = [listed([called(c["effect"], c["site"]) for c in group]) for group in entry.get("ambiguous_with", ())]
    return f"{text} The motion alone does not tell it from {', or from '.join(same)}." if same else text


def _who(pairs: Sequence[Summary], order: Iterable[str]) -> str:
    """`a differs from b and c`, where one is part of every pair."""
    common = set.intersection(*({p["a"], p["b"]} for p in pairs))
    if not common:
        return f"{times(len(pairs), 'pair')} of simulators differ"
    name = pairs[0]["b"] if pairs[0]["b"] in common else pairs[0]["a"]
    others = {p["a"] if p["b"] == name else p["b"] for p in pairs}
    return f"{name} differs from {listed([n for n in order if n in others])}"


def compare_markdown(summary: Summary) -> str:
    """The answer and the pairs as text, for viewers that show markdown."""
    rows = []
    for p in summary["pairs"]:
        named = setting_name(p["explained_by"][0]) if p["explained_by"] else "agree" if p.get("resolved") is False else ""
        rows.append((f"{p['a']}, {p['b']}", number(p["mean"]), number(p["max"]), p.get("refused", named)))
    return "\n\n".join([*sentences(summary), markdown_table(("pair", "mean", "largest", "closed by"), rows)])
