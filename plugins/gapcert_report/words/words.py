"""Numbers and sentences of a report: none says more than the claim behind it allows."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from gapcert.plugin import outside, pretty, times

Summary = Mapping[str, Any]
"""What a run has found, as its summary.json holds it, or a part of that."""
MARKS = {"good": "✓", "bad": "✗", "open": "?"}
MANY = 3  # states of which each is named; of more there is a range
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

VERDICTS = {
    "holds": ("Holds", "good", "Every claim asked for was reached at its level."),
    "fails": ("Fails", "bad", "A claim was refuted."),
    "unknown": ("Unknown", "open", "The budget or the solver ended before the claim was decided."),
    "causes": ("Causes named", "good", "Causes were found that lower the error on held-out data."),
    "ambiguous": ("Ambiguous", "open", "This recording cannot tell apart several causes."),
    "nothing": ("Nothing found", "good", "No effect in the library explains more of the recording than its noise does."),
    "agree": ("They agree", "good", "Every pair of simulators gives one answer, within the resolution of their arithmetic."),
    "explained": ("Explained", "good", "Simulators differ, and settings that close every difference were named and verified."),
    "differ": ("They differ", "bad", "Simulators differ, and no setting that was tried closes every difference."),
    "compared": ("Compared", "open", "There were no two simulators to lay side by side."),
    "unexplained": ("Unexplained", "bad", "The model misses something that no known effect explains."),
}


def verdict(summary: Summary) -> tuple[str, str, str]:
    """Word, kind and meaning of the verdict: open where γ was declared or is vacuous, or where causes leave more than noise."""
    word, kind, meaning = VERDICTS[summary["verdict"]]
    certificate = summary.get("certificate", {})
    if summary["verdict"] == "holds" and certificate.get("claim", {}).get("kind") == "assumed":
        return "Holds if γ does", "open", meaning
    if summary["verdict"] == "holds" and certificate.get("vacuous"):
        whole = all(s["vacuous"] for s in certificate["states"].values())
        return f"Holds, {'but' if whole else 'in part'} vacuous", "open", meaning
    flags = [f for c in summary.get("causes", ()) for f in c.get("flags", ())]
    if summary["verdict"] == "causes" and any(f.startswith("inadequate") for f in flags):
        return "Causes named, and something is left", "open", meaning
    return word, kind, meaning


def power(exponent: int) -> str:
    """10 to an integer power: `10⁻⁵`."""
    return "10" + str(exponent).translate(_SUPERSCRIPT)


def number(value: Any, digits: int = 4) -> str:
    """A number for people: 4 significant digits, thousands apart, powers of ten written out; `–` for none."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return "no number" if math.isnan(value) else "∞" if value > 0 else "−∞"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if value == 0 or -3 <= int(exponent) < 6:
        return f"{value:,.{max(0, digits - 1 - int(exponent))}f}" if value and int(exponent) >= 3 else f"{value:.{digits}g}"
    mantissa = mantissa.rstrip("0").rstrip(".")
    return power(int(exponent)) if mantissa == "1" else f"{mantissa}\u00a0×\u00a0{power(int(exponent))}"


def _fresh(certificate: Summary) -> str:
    points = certificate.get("audit", {}).get("points", 0)
    return f"{points:,} fresh points" if points else "the points that were looked at"


def refutation(certificate: Summary) -> str | None:
    """What refutes a certificate, or None."""
    audit = certificate.get("audit", {})
    if (found := audit.get("violations", 0)) > audit.get("allowed", 0):
        return f"Refuted: at {found:,} of {_fresh(certificate)}, f̂ − f lies outside the certified band."
    attack = certificate.get("attack", {})
    if attack.get("violations", 0) > attack.get("allowed", 0):
        of = f"{attack['violations']:,} of {attack['points']:,} further fresh points"
        return f"Refuted: at {of}, f̂ − f lies outside the certified band."
    if any(a.startswith("REFUTED") for a in certificate.get("assumptions", ())):
        if certificate["claim"]["kind"] == "assumed":
            return "Refuted: at sampled points f̂ − f lies outside the declared band."
        return "Refuted: two samples contradict the constants that the certified band rests on."
    return None


def jump_sentence(certificate: Summary) -> str | None:
    """In how much of the domain f̂ − f jumps, and where most; None where nothing does."""
    lipschitz = certificate.get("lipschitz", {})
    if not lipschitz.get("marked"):
        return None
    largest = [
        f"{j['state']} by {number(j['size'], 3)} at " + ", ".join(f"{n} = {number(v, 3)}" for n, v in j["where"].items())
        for j in lipschitz["jumps"]
    ]
    return (
        f"f̂ − f jumps in {lipschitz['marked']:,} of {lipschitz['cells']:,} cells, {100 * lipschitz['marked_share']:.2g} % of "
        f"the domain; there the band is as wide as the jump, and nowhere else. The largest jumps: {'; '.join(largest)}."
    )


def witness_sentence(certificate: Summary) -> str | None:
    """Where fresh points left the band by most."""
    w = certificate.get("audit", {}).get("witness", {})
    if "at" not in w:
        return None
    at = ", ".join(f"{n} = {number(v)}" for n, v in w["at"].items())
    state = list(certificate["states"])[w["state"]]
    return f"Worst at {at}: there f̂ − f of {state} is {number(w['residual'])}, {outside(w)}."


def claim_sentence(certificate: Summary) -> str:
    """What the claim says of |f̂ − f|, at its level, and nothing beyond it."""
    if (refuted := refutation(certificate)) is not None:
        return refuted
    claim, audit, fresh = certificate["claim"], certificate.get("audit", {}), _fresh(certificate)
    if claim["kind"] == "deterministic":
        return "Everywhere on the domain |f̂ − f| ≤ γ, provided that the assumptions below hold."
    if claim["kind"] == "assumed":
        seen = f"{fresh} gave no violation" if audit else "no simulator was asked"
        return f"|f̂ − f| ≤ γ is assumed everywhere on the domain: γ was declared by the user, and not found; {seen}."
    if (made := certificate.get("recording")) is not None:
        return _further(claim, made)
    if claim["kind"] == "statistical":
        epsilon, beta = claim.get("epsilon", audit.get("epsilon")), claim.get("beta", audit.get("beta"))
        drawn = claim.get("distribution") or "uniform on the domain"
        if (made := certificate.get("calibration")) is not None:
            return (
                f"With confidence 1 − {number(beta)}, |f̂ − f| ≤ γ outside a set of probability {number(epsilon)} ({drawn}): "
                f"{made['points']:,} calibration points set γ, and of {fresh} that were looked at afterwards "
                f"{audit['violations']:,} lie outside; {audit['allowed'] + 1:,} would refute it."
            )
        return (
            f"With confidence 1 − {number(beta)}, |f̂ − f| ≤ γ outside a set of probability {number(epsilon)} "
            f"({drawn}): {fresh} gave no violation."
        )
    return f"At {fresh}, |f̂ − f| ≤ γ without a violation. This is evidence, not a proof: nothing is claimed elsewhere."


def _further(claim: Summary, made: Summary) -> str:
    """The claim of a recording: about a further window, of which it assumes something."""
    epsilon, beta, held = number(claim["epsilon"]), claim.get("beta"), made["windows"]["calibration"]
    level, alike = "On average over calibrations", "exchangeable"
    if beta is not None:
        level, alike = f"With confidence 1 − {number(beta)}", "independent draws"
    return (
        f"{level}, a further window of measurements has a transition with |x⁺ − f| > γ with probability {epsilon} at most, "
        f"provided that windows are {alike}: {held:,} of them, which the fit has not seen, set γ."
    )


def symbols(certificate: Summary) -> str:
    """What f, f̂ or x⁺, γ and [l, u] are."""
    if "recording" in certificate:
        return (
            "In words: f is the next state that the model gives for a state and an input, and x⁺ the one that was measured. "
            "γ is the bound on how far the two are apart, and [l, u] that on x⁺ − f with its sign, both as claimed above."
        )
    other = "what γ was declared for" if certificate["claim"]["kind"] == "assumed" else "the simulator"
    return (
        f"In words: f is the model, and f̂ {other}; each gives the next state for a state and an input in the domain X × U. "
        "γ is the bound on how far the two are apart, and [l, u] that on f̂ − f with its sign, both as claimed above."
    )


def tightness(certificate: Summary) -> dict[str, float]:
    """Mean γ over mean gap, of the states that have one."""
    return {n: s["tightness"] for n, s in certificate.get("states", {}).items() if s.get("tightness") is not None}


def tightness_sentence(certificate: Summary) -> str:
    """How much larger γ is than the gap it bounds, over the audit's points."""
    tight = tightness(certificate)
    parts = [f"{t:.3f} × the mean gap of {name}" for name, t in tight.items()]
    if not parts and "audit" not in certificate and "recording" not in certificate:
        return ""
    if not parts:
        return "The gap is too small to be resolved by the arithmetic of the simulator."
    empty = [name for name, s in certificate["states"].items() if s.get("vacuous")]
    told = f"γ is on average {listed(parts)}."
    if len(parts) > MANY:
        least, most = min(tight.values()), max(tight.values())
        told = f"γ is on average {least:.3f} to {most:.3f} × the mean gap of each of {len(parts)} states."
    return told + (
        f" For {listed(empty)} it is vacuous: a constant, or a model in which nothing moves, would do as well." if empty else ""
    )


def plain(sentence: str) -> str:
    """A sentence whose numbers and units are written for people: 1.96e-05 N*m becomes 1.96 × 10⁻⁵ N·m."""
    sentence = re.sub(r"\b[a-zA-Z]\w*(?:[*/^]-?\w+)+", lambda m: pretty(m[0]), sentence)
    return re.sub(r"\b(\d[\d.]*)e([-+]\d+)\b", lambda m: number(float(m[0])), sentence)


HIDDEN = {
    "refuse": "It was probed, and does not matter.",
    "augment": "What the domain names of it is state of this certificate.",
    "default": "The claim is about its declared default alone.",
    "sample": "Each point gets its own, and γ bounds the gap over them.",
}
"""What became of hidden state that matters, by mode."""


def hidden_sentence(hidden: Summary) -> str:
    """What is done about engine state that the model leaves out."""
    what = HIDDEN["refuse" if hidden.get("harmless") else hidden["mode"]]
    return f"The simulator's state has parts that the model's has not: {listed(hidden['names'])}. {what}"


def on_the_way(row: Summary) -> int:
    """How many runs neither broke nor reached the target within their steps; only a reach-avoid goal has any."""
    return int(row["starts"] - row["violations"] - row["reached"]) if "reached" in row else 0


def suprema(told: Summary) -> str:
    """Over which blocks of cells and inputs γ was bounded, and over which coordinates its supremum was taken."""
    blocks = " × ".join(f"{n} of {name}" for name, n in told["blocks"].items())
    taken = [
        f" In the windows of {name} it counts by its supremum over {listed(s['over'])}: "
        f"{number(s['cells'])} cells wider on average."
        for name, s in told.get("suprema", {}).items()
    ]
    return f"γ was bounded over blocks, {blocks}.{''.join(taken)}"


def runs_sentence(loop: Summary) -> str:
    """What the runs with γ earn as an audit of independent starts."""
    if not (c := loop.get("claim")):
        return ""
    tried = [r["policy"] for r in loop.get("policies", ()) if r["controller"] == "with_gamma"]
    under = f"under policy {tried[0]}" if len(tried) == 1 else "under at least one of these policies"
    return (
        f"As an audit, with confidence 1 − {number(c['beta'])}: a further run with γ, from a start drawn in the same way, "
        f"breaks the specification {under} with probability {number(c['epsilon'])} at most."
    )


def learned_sentence(loop: Summary) -> str:
    """What the runs with γ learned of parameters, and whether γ or a range was found to be wrong."""
    parts, refuted = [], 0
    for name, told in loop.get("learned", {}).items():
        first, last = between(*told["first"]), between(*told["last"])
        parts.append(f"{name} was {first} at first and {last} after the last step ({number(100 * told['left'], 2)} % is left)")
        refuted = max(refuted, told["refuted"])
    if not parts:
        return ""
    void = f" In {times(refuted, 'run')} no value makes all steps that were seen: γ or the range is wrong."
    return f"What runs with γ have learned: {'; '.join(parts)}." + (void if refuted else "")


def between(low: float, high: float) -> str:
    """`0.6 to 1.4`; where both ends read alike, the middle and what it may be off by."""
    first, last = number(float(low)), number(float(high))
    return f"{first} to {last}" if first != last else f"{first} ± {number((high - low) / 2, 2)}"


def loop_sentence(summary: Summary) -> str:
    """What was seen in closed loop; runs that were seen, unless the controller's claim says more."""
    loop = summary.get("closed_loop")
    if not loop:
        return ""
    with_gamma, without = loop.get("with_gamma"), loop.get("without_gamma")
    parts = []
    if without:
        parts.append(f"without γ {without['violations']:,} of {times(without['starts'], 'start')} broke the specification")
    if with_gamma:
        broke = "none" if with_gamma["violations"] == 0 else f"{with_gamma['violations']:,}"
        parts.append(f"with γ {broke} of {with_gamma['starts']:,} did")
        if refused := with_gamma.get("refused"):
            parts.append(f"{refused:,} further starts, where the controller without γ wins, are refused with γ")
        if late := on_the_way(with_gamma):
            parts.append(f"after {with_gamma['steps']:,} steps {late:,} of them had not reached the target, still on the way")
    if strange := loop.get("hidden_outside"):
        parts.append(f"{100 * strange:.2g} % of the steps with γ began with hidden state that the certificate does not cover")
    if (left := summary.get("controller", {}).get("domain_of_nominal")) is not None:
        safe = "; to know where the simulator errs to the safe side can win states" if left > 1 else ""
        parts.append(f"the controller's domain with γ is {100 * left:.3g} % of that without{safe}")
    claim = summary.get("controller", {}).get("claim", {})
    what = "These are the runs that were made, not a claim about others." if claim.get("kind") == "empirical" else ""
    what = runs_sentence(loop) or what
    return f"In closed loop on the simulator, {'; '.join(parts)}. {what}".strip()


def listed(items: Sequence[str]) -> str:
    """`a, b and c`."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}" if items else ""


def some(items: Sequence[str], most: int) -> str:
    """`a, b and 4 more`."""
    return listed([*items[:most], f"{len(items) - most:,} more"] if len(items) > most else items)


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """As viewers that show markdown want it."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ("---",) * len(head), *rows))
