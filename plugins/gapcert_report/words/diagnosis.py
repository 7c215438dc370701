"""The answer of a diagnosis in sentences, from its JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from gapcert.plugin import pretty, share
from gapcert_figures import KINDS, called, per_second, spoken

from .words import Summary, listed, markdown_table, number, refutation

SETTINGS = {
    "damping": "the drag on every link, linear and by the square, in 1/s",
    "dry_friction": "how dry friction is solved",
    "implicit_damping": "whether damping is solved with the step",
    "time_step": "the seconds that one step advances",
    "use_inertia_from_file": "whether links have the file's inertia",
}
# What has no plural has no article.
_STUFF = {"friction", "drag", "cogging", "backlash", "coupling", "slip", "saturation", "quantisation", "play", "hysteresis"}


def cause_name(cause: Summary) -> str:
    """An effect at its site: `Coulomb friction at q`; of an engine its setting."""
    if cause["effect"] == "engine-setting":
        return f"the setting {cause['site']}"
    return called(cause["effect"], cause["site"])


def measured(text: str, unit: str) -> str:
    """A number with its unit, and pure numbers without one."""
    return text if unit in ("", "1") else f"{text} {pretty(unit)}"


def whole(text: str) -> str:
    """A text in which no line ends inside of a value and what it is uncertain by."""
    return text.replace(" ± ", "\u00a0±\u00a0")


def plus_minus(value: float, low: float, high: float) -> str:
    """`0.131 ± 0.004`: as many digits as the 95 % interval allows, one of it, two where it begins with 1."""
    half = (high - low) / 2
    if not (math.isfinite(half) and half > 0):
        return number(value, 3)
    exponent = math.floor(math.log10(half))
    digits = -exponent + (half < 1.95 * 10.0**exponent)
    if max(abs(value), half) < 1e-3 or max(abs(value), half) >= 1e6:
        power = math.floor(math.log10(max(abs(value), half)))
        inner = plus_minus(value / 10.0**power, low / 10.0**power, high / 10.0**power)
        return f"({inner})\u00a0×\u00a0{number(10.0**power)}"
    return " ± ".join(f"{round(v, digits):,.{max(0, digits)}f}" for v in (value, half))


def amount(cause: Summary) -> str:
    """A cause's numbers with their units: `0.131 ± 0.004 N·m`, or `plus 158 ± 2 N·s/m and minus 232 ± 3 N·s/m`; of a curve how
    many it has."""
    if "at_1" in cause["parameters"]:
        return f"drawn through {len(cause['parameters'])} points"
    parts = []
    for name, p in cause["parameters"].items():
        given = measured(plus_minus(p["value"], p["low"], p["high"]), p["unit"])
        parts.append(given if len(cause["parameters"]) == 1 else f"{name.replace('_', ' ')} {given}")
    return listed(parts)


def numbers(cause: Summary) -> Iterator[tuple[str, str]]:
    """(name, value with its interval and unit) of everything about a cause; of a setting its value and what it was."""
    if setting := cause.get("setting"):
        yield "value", f"{setting_value(setting['value'])} instead of {setting_value(setting['was'])}"
        return
    for name, p in cause["parameters"].items():
        yield name.replace("_", " "), measured(plus_minus(p["value"], p["low"], p["high"]), p["unit"])


def explained(cause: Summary) -> str:
    """How much of the held-out error goes with a cause."""
    return f"{100 * cause['explained']:.1f} %"


def setting_value(value: Any) -> str:
    """Of an engine, in words."""
    if value is None:
        return "what the file says"
    return number(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value).lower()


def lacking(cause: Summary) -> str:
    """A cause with its article, its site and its numbers."""
    name = spoken(cause["effect"])
    article = "" if name.split()[-1] in _STUFF else "an " if name[0].lower() in "aeio" else "a "
    return f"{article}{name} at {cause['site']}, {amount(cause)}"


def sentence(summary: Summary) -> str:
    """The answer: what the simulation lacks, what naming it bought on data that took no part, and what came second."""
    told = {"nothing": _nothing, "unexplained": _unexplained, "ambiguous": _ambiguous}
    text, pushes = told.get(summary["verdict"], _causes)(summary), pushes_named(summary)
    said = summary["verdict"] != "unexplained" and any(c["effect"] == "external-push" for c in summary["causes"])
    if len(pushes) < 2 and said:
        return text
    return f"{text} Pushes from outside: {briefly(pushes, 6)}." if pushes else text


def pushes_named(summary: Summary) -> list[str]:
    """Forces from outside: `−1.28 ± 0.05 rad/s at w from 5.78 s`, with their trajectory where there are several."""
    pushes = summary.get("pushes", ())
    several = len({p["trajectory"] for p in pushes}) > 1
    of = {p["trajectory"]: f" of {p['trajectory']}" if several else "" for p in pushes}
    return [f"{impulse(p)} at {p['site']} from {number(p['t'], 4)} s{of[p['trajectory']]}" for p in pushes]


def impulse(push: Summary) -> str:
    """Its sign, size, interval and unit."""
    size = measured(plus_minus(push["size"], push["low"], push["high"]), push["unit"])
    return f"{'+' if push['sign'] > 0 else '−'}{size}"


def _causes(summary: Summary) -> str:
    stated = {id(c): text for c in summary["causes"] if (text := _misstated(c))}
    otherwise = [(c["site"], *numbers(c)) for c in summary["causes"] if c.get("setting")]
    missing = [lacking(c) for c in summary["causes"] if id(c) not in stated and not c.get("setting")]
    wrong = list(stated.values())
    head = f"The simulation lacks {_joined(missing)}" if missing else ""
    if otherwise:
        told = listed([f"{site}{_means(site)} is {value}" for site, (_, value) in otherwise])
        head = f"{head}; of its settings, {told}" if head else f"Of the engine's settings, {told}"
    if wrong:
        told = f"{'and ' if head else ''}{listed(wrong)}, not as stated"
        head = f"{head}, {told}" if head else f"In the simulation {told}"
    gain, second = gain_phrase(summary), runner_up_phrase(summary)
    text = "; ".join(p for p in (head, gain, second) if p) + "."
    same = [listed([cause_name(c) for c in group]) for group in summary.get("ambiguous_with", ())]
    return f"{text} {_alike(same, summary.get('seconds'), summary.get('experiment'))}" if same else text


def _alike(same: Sequence[str], seconds: float | None, told: str | None) -> str:
    """What no experiment of so many seconds tells apart from the answer, and what to measure besides."""
    rivals, besides = ", or from ".join(same), f" {told[:1].upper()}{told[1:]}." if told else ""
    long = "" if seconds is None else f" of {seconds:.3g} s"
    return f"No input{long} within the limits separates this from {rivals}.{besides}"


def _means(setting: str) -> str:
    return f" ({SETTINGS[setting]})" if setting in SETTINGS else ""


def _misstated(c: Summary) -> str | None:
    """What a simulation has, but with another number."""
    if c["effect"] == "parameter":
        return f"{c['site']} is {amount(c)}"
    return f"{spoken(c['effect'])} at the {c['site']} is {amount(c)}" if c["effect"].startswith("contact-") else None


def _joined(parts: Sequence[str]) -> str:
    # The parts have commas of their own.
    return parts[0] if len(parts) == 1 else f"{'; '.join(parts[:-1])}; and {parts[-1]}"


def headline(summary: Summary) -> tuple[str, str, Summary] | None:
    """(horizon, channel, gain) that a sentence quotes: the longest horizon, and there the site of the first cause that is
    measured, else the channel that gained most.
    """
    gain = summary.get("gain") or {}
    if not gain:
        return None
    horizon = max(gain, key=float)
    shown = gain[horizon]
    best = max(shown, key=lambda channel: shown[channel]["before"] / max(shown[channel]["after"], 1e-300))
    channel = next((c["site"] for c in summary["causes"] if c["site"] in shown), best)
    return horizon, channel, shown[channel]


def gain_phrase(summary: Summary) -> str:
    if (found := headline(summary)) is None:
        return ""
    horizon, channel, g = found
    unit, several = summary.get("units", {}).get(channel, ""), len(summary["gain"][horizon]) > 1
    of = f" of {channel}" if several else ""
    with_it = "it" if len(summary["causes"]) == 1 else "them"
    before, after = number(g["before"], 3), measured(number(g["after"], 3), unit)
    return f"with {with_it} the {horizon} s error{of} falls from {before} to {after}"


def runner_up_phrase(summary: Summary) -> str:
    """What the nearest rival of the first cause that has one would leave of the quoted error, or explain instead."""
    found = headline(summary)
    for c in summary["causes"]:
        rival = c.get("runner_up")
        if not rival:
            continue
        same = rival["site"] == c["site"] and rival["effect"] != "engine-setting"
        name = spoken(rival["effect"]) if same else cause_name(rival)
        place = "the runner-up" if len(summary["causes"]) == 1 else f"the runner-up to {spoken(c['effect'])}"
        if found is not None and found[1] in rival.get("leaves", {}):
            return f"{name}, {place}, leaves {number(rival['leaves'][found[1]], 3)}"
        mine, other = (f"{100 * max(0.0, v):.0f} %" for v in (c["explained"], rival["explained"]))
        return f"{name}, {place}, explains {other} of the error instead of {mine}"
    return ""


def _nothing(summary: Summary) -> str:
    text = "No effect in the library explains more of this recording than its noise does."
    found = briefly(smallest_named(summary), 4)
    return f"{text} Had it been there, this would have been seen: {found}." if found else text


def briefly(items: Sequence[str], most: int) -> str:
    """`a, b and 29 more`: at most so many entries."""
    return listed(items if len(items) <= most else [*items[: most - 1], f"{len(items) - most + 1} more"])


def refitted_named(summary: Summary) -> list[str]:
    """Parameters with a tolerance that the data move by twice what chance does: `J is 0.0450 kg·m², stated 0.047`."""
    moved = {n: p for n, p in summary.get("refitted", {}).items() if abs(p["value"] - p["stated"]) > p["high"] - p["low"]}
    return [
        f"{n} is {measured(plus_minus(p['value'], p['low'], p['high']), p['unit'])}, stated {number(p['stated'])}"
        for n, p in moved.items()
    ]


def smallest_named(summary: Summary) -> list[str]:
    """The least of every effect that the data would have shown: `Coulomb friction at q from 0.003 N·m`."""
    return [f"{spoken(s['effect'])} at {s['site']} from {least_size(s)}" for s in summary.get("smallest", ())]


def least_size(seen: Summary) -> str:
    """The smallest size that would be seen: `0.003 N·m`, or `1 ± 0.02` of what does nothing at 1."""
    if (off := seen.get("off")) is None:
        return measured(_two_digits(seen["value"]), seen["unit"])
    return measured(f"{number(off)} ± {_two_digits(abs(seen['value'] - off))}", seen["unit"])


def _two_digits(value: float) -> str:
    return number(float(f"{value:.2g}"))


def _ambiguous(summary: Summary) -> str:
    groups = [[cause_name(c) for c in group] for group in (summary["causes"], *summary.get("ambiguous_with", ()))]
    shared = [n for n in groups[0] if all(n in group for group in groups)]
    names = [listed([n for n in group if n not in shared]) for group in groups]
    beside = f"Beside {listed(shared)}, this" if shared else "This"
    text = f"{beside} recording cannot tell whether it is {', or '.join(n for n in names if n)}."
    if design := summary.get("design"):
        text += f" {experiment_sentence(design)}"
    if (told := summary.get("experiment", "")) and not (design and all(p["separated"] for p in design.get("apart", ()))):
        text += f"{' Beyond that, t' if design else ' T'}{told[1:]}."
    gain = gain_phrase(summary).replace("with it", "With the simplest", 1).replace("with them", "With the simplest", 1)
    return f"{text} {gain}." if gain else text


def experiment_sentence(design: Summary) -> str:
    """From where to play what, where that leads and how fast, and how far the rivals then are apart."""
    size = number(float(f"{design['separation']:.2g}"))
    apart = f"whatever its numbers, the false one then misses the log by {size} noise floors (RMS)"
    start = [f"{n} = {measured(number(v['value'], 3), v['unit'])}" for n, v in design.get("start", {}).items()]
    begin = f"begin at {listed(start)}, and play" if start else "play"
    ways = [
        f"{name} between {number(y['low'], 3)} and {measured(number(y['high'], 3), y['unit'])} "
        f"(recorded: {number(y['recorded'][0], 3)} to {number(y['recorded'][1], 3)}), "
        f"at up to {measured(number(y['speed'], 3), per_second(y['unit']))} (recorded: {number(y['recorded_speed'], 3)})"
        for name, y in design.get("travel", {}).items()
    ]
    leads = f" It should keep {listed(ways)}." if ways else ""
    return f"To decide, {begin} {design['name']} for {number(design['seconds'], 3)} s: {apart}.{leads}"


def _unexplained(summary: Summary) -> str:
    odd = any(f.startswith("implausible") for c in summary["causes"] for f in c.get("flags", ()))
    lacks = "Something is missing in the model that no effect in the library explains"
    text = f"{lacks} with plausible numbers." if odd else f"{lacks}."
    rest = summary.get("unexplained") or {}
    text += f" {said}" if (said := dependence(rest)) else ""
    if kinds := {k: v for k, v in rest.get("looks_like", {}).items() if v > 0.1}:
        kind = max(kinds, key=lambda k: kinds[k])
        text += f" It looks like {KINDS.get(kind, kind)}: that predicts {100 * kinds[kind]:.0f} % of it in data not seen."
    if not summary["causes"]:
        return text
    shares = [f"{cause_name(c)} ({100 * c['explained']:.3g} %)" for c in summary["causes"]]
    return f"{text} Part of the held-out error goes with {listed(shares)}, which this does not show to be a cause."


def dependence(rest: Summary) -> str:
    """What the residual that nothing explains goes with, as its features tell; "" where nothing was to be learnt from them."""
    shares = rest.get("looks_like", {}).values()
    if rest.get("needs_memory"):
        return "It has memory: no law of the present state and input makes it."
    if any(v > 0.1 for v in shares):
        return "A function of the present state and input would do; it does not need memory."
    if not shares:
        return ""
    if rest.get("events"):
        return "No dependence on state, input or their past was found; single pushes from outside were."
    when = listed([f"{a:.3g} to {b:.3g} s" for a, b in rest.get("where", ())])
    most = f"most of it at {when}" if when else "about as much all along the recording"
    return f"No dependence on state, input or their past was found; it looks like an external disturbance, {most}."


def shrunk(summary: Summary) -> list[tuple[str, float, float]]:
    """(state, mean γ before, mean γ after) for the states that were certified with and without the named causes.

    Empty where either certificate is refuted: its γ bounds nothing.
    """
    again = summary.get("recertified") or {}
    both = [again.get(k, {}) for k in ("before", "after")]
    if any("states" in c and refutation(c) for c in both):
        return []
    before, after = (c.get("states", {}) for c in both)
    return [(n, before[n]["gamma_mean"], after[n]["gamma_mean"]) for n in before if after.get(n, {}).get("gamma_mean")]


def won(summary: Summary) -> tuple[float, float] | None:
    """The share of its grid, or of the set to stay in, from which the controller wins, (before, after) the causes."""
    before, after = (share(c) for c in _controllers(summary))
    return None if before is None or after is None else (before, after)


def _controllers(summary: Summary) -> list[Summary]:
    return [(summary.get("recertified") or {}).get(k, {}).get("controller", {}) for k in ("before", "after")]


def won_of(summary: Summary) -> str:
    """What the shares of `won` are shares of."""
    return "the set to stay in" if all("domain_fraction" in c for c in _controllers(summary)) else "its cells"


def won_sentence(summary: Summary) -> str:
    if (both := won(summary)) is None:
        return ""
    of = won_of(summary)
    return f"The controller wins from {100 * both[0]:.3g} % of {of} before, and from {100 * both[1]:.3g} % after."


def diagnosis_markdown(summary: Summary) -> Iterator[str]:
    """The paragraphs that a viewer shows."""
    yield sentence(summary)
    rows = []
    for c in summary["causes"]:
        if c.get("setting"):
            rows += [(cause_name(c), name, value, "", explained(c)) for name, value in numbers(c)]
            continue
        for name, p in c["parameters"].items():
            value = measured(number(p["value"]), p["unit"])
            limits = f"{number(p['low'])} to {number(p['high'])}"
            rows.append((cause_name(c), name, value, limits, explained(c)))
    if rows:
        head = ("cause", "parameter", "value", "95 % interval", "explains")
        yield markdown_table(head, rows)
    yield from (f"Mean γ of {n}: {number(a)} before, {number(b)} with the causes in the model." for n, a, b in shrunk(summary))
    yield won_sentence(summary)
