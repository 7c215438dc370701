"""Every sentence that a certificate may say, as a function of its data. A list that holds anything else is refused.

A row gives the sentences that it owes, in the order of the rows: as text where the data give every word, else as a pattern
whose free parts are numbers and names. A certifier that says something new needs one row here.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from gapcert.plugin import on_curvature, order_statistics

from .evidence import Evidence
from .margin import radii

Said = str | re.Pattern[str]
NUMBER = r"-?(?:\d+(?:\.\d+)?(?:e[+-]?\d+)?|inf|nan)"
NAMES = r"[^\s,;:()]+(?:, [^\s,;:()]+)*"
_UNITS = r"(?: [\w*/^.()·°%-]+)?"


def assumptions(e: Evidence) -> str:
    """ "" where the certificate assumes what its data say, sentence by sentence."""
    return _other("assumption", e.data["assumptions"], [said for row in ASSUMPTIONS for said in row(e)])


def warnings(e: Evidence) -> str:
    """ "" where every warning is one that a gate or an estimator gives, and none of a recording is left out."""
    said, known = e.data.get("warnings", []), [*_gates(e), *_slopes(e)]
    if "recording" in e.data:
        return _other("warning", said, list(_recorded(e)))
    book = damaged(e)
    if said[len(said) - len(book) :] != book:
        return f"the warning '{book[0]}' is left out"
    said = said[: len(said) - len(book)]
    strange = next((w for w in said if not (isinstance(w, str) and any(p.fullmatch(w) for p in known))), None)
    return "" if strange is None else f"'{strange}' is no warning that is known"


def method(e: Evidence) -> str:
    """ "" where the constants come from what they are said to come from."""
    stated, made = str(e.data["lipschitz"]["method"]), e.data["lipschitz"]["provenance"]
    name = stated.partition(" ")[0]
    pattern, provenance = METHODS.get(name, (re.escape(name), made))
    if not re.fullmatch(pattern, stated) or made != provenance:
        return f"'{stated}' is no method that gives {made} constants"
    cells, jump = (re.search(rf"(\d+) {what}", stated) for what in ("cells", "jump"))
    if cells and int(cells[1]) != e.data["lipschitz"].get("cells"):
        return "the method names another number of cells"
    same = jump is None or int(jump[1]) == int((e.arrays["cells.J"] > 0).any(axis=1).sum())
    return "" if same else "the method names another number of cells that jump"


METHODS: Mapping[str, tuple[str, str]] = {
    "wood-zhang": (r"wood-zhang \(\d+ pairs in \d+ batches per axis\)", "estimated"),
    "gradient-elite": (r"gradient-elite \(\d+ pairs in \d+ rounds per axis\)", "estimated"),
    "piecewise": (r"piecewise \(\d+ cells, of which \d+ jump\)", "estimated"),
    "interval": (r"interval(?: \(\d+ cells\))?", "interval"),
    "declared": ("declared", "declared"),
    order_statistics.NO_CONSTANTS: (re.escape(order_statistics.NO_CONSTANTS), "estimated"),
}


def _other(what: str, stated: Any, expected: Sequence[Said]) -> str:
    if not (isinstance(stated, list) and all(isinstance(s, str) for s in stated)):
        return f"the {what}s are no list of sentences"
    for text, said in zip(stated, expected, strict=False):
        if not (text == said if isinstance(said, str) else said.fullmatch(text)):
            return f"the {what} '{text}' is stated; the data give '{said if isinstance(said, str) else said.pattern}'"
    if len(stated) > len(expected):
        return f"the {what} '{stated[len(expected)]}' does not follow from the data"
    left = expected[len(stated) :]
    return f"the {what} '{left[0] if isinstance(left[0], str) else left[0].pattern}' is left out" if left else ""


# What the words are made of


def states(e: Evidence) -> list[str]:
    return list(e.data["domain"]["axes"][: e.data["domain"]["states"]])


def _unit(unit: str) -> str:
    return "" if unit == "1" else f" {unit}"


def _box(e: Evidence) -> str:
    z = e.data["domain"]
    axes = zip(z["axes"], z["low"], z["high"], z["units"], strict=True)
    means = z["coordinates"]
    return ", ".join(
        f"{a}{f' = {means[a]}' if a in means else ''} in [{low:g}, {high:g}]{_unit(unit)}" for a, low, high, unit in axes
    )


def words(e: Evidence) -> str:
    """What points are drawn from."""
    return "X × U within its relations" if e.zone.relations else "X × U"


def _each(names: Sequence[str], values: Sequence[float], digits: int) -> str:
    return ", ".join(f"{n} by {v:.{digits}g}" for n, v in zip(names, values, strict=True))


def hidden_words(e: Evidence) -> str:
    """What the distribution says of hidden state."""
    return str(e.data.get("hidden", {}).get("distribution", ""))


def _drawn(e: Evidence) -> bool:
    """Has the certificate an audit of drawn points?"""
    return "audit" in e.data


def _bounded(e: Evidence) -> bool:
    return e.data["route"] in ("theorem1", "dominate")


# The rows


def _curvature(e: Evidence) -> Iterator[Said]:
    if not (_bounded(e) and on_curvature(e.data["form"]) and "curvature" in e.arrays):
        return
    provenance = e.data["lipschitz"]["provenance"]
    proved = f"proved by interval arithmetic from the equations of both systems{_but(e)}"
    origin = {"declared": "declared and taken on trust", "interval": proved}.get(provenance, provenance)
    bare = [n for n, row in zip(states(e), e.arrays["curvature"], strict=True) if np.isinf(row).any()]
    rest = f"; where none is known ({', '.join(bare)}) it rests on the Lipschitz constants instead" if bare else ""
    yield (
        "The band rests on bounds of the second derivative of g = r − p along each axis on Z, with a first derivative that is "
        f"Lipschitz there (C¹·¹); they are {origin}{rest}."
        + ("" if provenance == "interval" else " At a kink or a jump that they do not show, it is no bound.")
    )


def _but(e: Evidence) -> str:
    """What is no proof among constants that are called proved."""
    s = e.data.get("symmetry")
    open_ = s is not None and not s.get("proved")
    return f", but for those along {' and '.join(s['names'])}, which rest on the declared symmetry" if s and open_ else ""


def _constants(e: Evidence) -> Iterator[Said]:
    if not _bounded(e):
        return
    bound, p = e.data["lipschitz"], e.data["predictor"]
    origin = {
        "analytic": f"were derived analytically{_but(e)}",
        "interval": f"were proved by interval arithmetic from the equations of both systems{_but(e)}",
        "declared": "were declared by the user and are taken on trust",
        "estimated": f"were estimated by {bound['method']} from {e.data['samples']['lipschitz']} transitions and multiplied by "
        f"{bound['safety']:g}; an estimate is not a bound",
    }[bound["provenance"]]
    yield f"The per-axis Lipschitz constants of {'r' if p == 'none' else f'r − p (p: {p} predictor)'} {origin}."
    if "cells.L" in e.arrays:
        yield _cells(e)


def _cells(e: Evidence) -> str:
    bound, z = e.data["lipschitz"], e.data["domain"]
    head = f"The constants hold per cell, of {bound['cells']} that tile the domain"
    if not bound["marked"]:
        proved = f"; they were proved in each of them{_but(e)}."
        none = "; none of them is marked: no slope grew as the distance shrank."
        return head + (proved if bound["provenance"] == "interval" else none)
    units = dict(zip(z["axes"], z["units"], strict=True))
    sizes = [
        f"{j['state']} by {j['size']:.3g}{_unit(units[j['state']])} at "
        f"({', '.join(f'{name} = {value:.4g}' for name, value in ((n, j['where'][n]) for n in z['axes']))})"
        for j in bound["jumps"]
    ]
    return (
        f"{head}; {bound['marked']} of them ({100 * bound['marked_share']:.2g} % of its volume) are marked: there f̂ − f jumps, "
        f"which is bounded on both sides by jumps as large as those measured times {bound['safety']:g}, and nowhere else. "
        f"Largest jumps: {'; '.join(sizes)}."
    )


def _declared(e: Evidence) -> Iterator[Said]:
    if e.data["route"] != "declared":
        return
    gamma = ", ".join(f"{g:.6g} in {n}" for n, g in zip(states(e), e.arrays["gap.gamma"], strict=True))
    yield f"γ was declared by the user, and is assumed: |f̂ − f| ≤ {gamma} on Z."
    if not _drawn(e):
        yield "No simulator was asked: nothing speaks for γ, and nothing was given the chance to refute it."


def _calibration(e: Evidence) -> Iterator[Said]:
    if (made := e.data.get("calibration")) is None:
        return
    draws, noise = made["repeats"], made["noise"]
    each = f", each with {draws} independent draws of the noise, all of which count as one trial" if noise else ""
    yield (
        f"The claim rests on {made['points']} calibration points, independent and uniform on {words(e)}{hidden_words(e)}"
        f"{_noise(made)}, which no fit has seen (calibration {made['number']} of this question){each}: the score that all but "
        f"{made['exceedances']} of them keep is exceeded with probability above {e.data['audit']['epsilon']:g} only with "
        f"probability β/2^{made['number']} or less."
    )
    yield (
        "It does not rest on the Lipschitz constants, nor on the samples: these gave the band that was calibrated, and the "
        "scale per state in which scores are counted, before any calibration point was drawn."
    )
    if noise:
        yield (
            "Each point has its own draw of the backend's noise, whose seed is a hash of the point: independent draws are "
            "assumed of the backend for different seeds."
        )


def _noise(made: Mapping[str, Any]) -> str:
    draws = made["repeats"]
    return "" if not made["noise"] else order_statistics.NOISE if draws == 1 else order_statistics.NOISE_OF.format(draws)


def _resolution(e: Evidence) -> Iterator[Said]:
    if _drawn(e) and "calibration" not in e.data:
        each = ", ".join(f"e({n}) = {v:.2g}" for n, v in zip(states(e), e.rounding, strict=True))
        told = f"One step of f̂ and of f, as computed, is within e of its exact value: {each}"
        yield f"{told}." if (both := e.data.get("arithmetic")) is None else f"{told}; {_within(both)}.{_terms(e, both)}"


def _within(both: Sequence[Mapping[str, Any]]) -> str:
    """How it is known of f̂ and of f."""
    fhat, f = map(_known, both)
    return f"of both it {f}" if fhat == f else f"of f̂ it {fhat}, and of f it {f}"


def _known(a: Mapping[str, Any]) -> str:
    if "jitter" in a:
        by = f"close answers leave a parabola by, {max(a['jitter']):.2g} at most"
        return f"is measured, not proved: it covers four times what {by}"
    return "is proved by a running error analysis of the equations" if a["proved"] else "is assumed as it is stated, not proved"


def _terms(e: Evidence, both: Sequence[Mapping[str, Any]]) -> str:
    """Terms with which text cancels badly, and states of f̂ that jitter by more than is stated."""
    systems = zip(("f̂", "f"), both, strict=True)
    each = ((n, term, of) for of, a in systems for n, term in zip(states(e), a["terms"], strict=False) if term)
    seen = zip(states(e), both[0]["e"], both[0].get("jitter", ()), strict=False)
    told = [f" e({n}) of f̂ is four times its jitter, which is more than is stated." for n, own, j in seen if own == 4 * j > 0]
    return "".join([*told, *(f" Most of e({n}) is the rounding of {term} in {of}." for n, term, of in each)])


def _purity(e: Evidence) -> Iterator[Said]:
    if _drawn(e) and not e.data.get("calibration", {}).get("noise"):
        alone = (
            "in this process only: it belongs to the running script|another process could not be asked: it ended|"
            r"it cannot be had in another process: [\w .:'<>()-]{1,200}"
        )
        yield re.compile(
            rf"f̂ is a function of its arguments alone: repeated and permuted queries, close neighbours, other sizes of call"
            rf"(?:, a fresh copy and another worker {_AGREED}| and a fresh copy {_AGREED} \((?:{alone})\)); \d+ measured rows, "
            rf"asked again alone, some after a close neighbour, and half of them in another order, {_AGREED}; this was probed, "
            r"not proved\."
        )


_AGREED = rf"agreed (?:bit for bit|within e, though not bit for bit \(they differ by up to {NUMBER}\))"


def _turns(e: Evidence) -> Iterator[Said]:
    """Angles that close on themselves; which of them do is for the check that knows f and f̂."""
    known = r"(?:proved by its equations|probed at \d+ states, not proved)"
    for name in states(e) if _drawn(e) else ():
        if any(str(a).startswith(f"{name} closes on itself (") for a in e.data["assumptions"]):
            yield re.compile(
                rf"{re.escape(name)} closes on itself \((?:the domain spans a turn|f and f̂ are whole turns apart)\); that f "
                rf"repeats with it was {known}, that f̂ does was {known}\."
            )


def _augmented(e: Evidence) -> Iterator[Said]:
    h = e.data.get("hidden", {})
    if h.get("mode") == "augment" and h["names"]:
        yield f"Hidden state that the domain names ({', '.join(h['names'])}) is state here, and f holds it constant."


def _hidden(e: Evidence) -> Iterator[Said]:
    h = e.data.get("hidden", {})
    if "queries" not in h:
        return
    names = NAMES if h["mode"] == "augment" or "bound" in h else re.escape(", ".join(h["names"]))
    measured = re.escape(_each(states(e), [h["spread"][n] for n in states(e)], 3))
    if h["harmless"]:
        yield re.compile(
            rf"f̂ has hidden state \({names}\) that does not matter: moved alone, together and as visited in rollouts, it "
            rf"changed {measured}, no more than rounding can; this was probed, not proved\."
        )
    elif "bound" not in h:
        yield re.compile(
            rf"f̂ depends on hidden state \({names}\), which changed {measured}; the claim is about its default alone\."
        )
    else:
        yield re.compile(rf"f̂ depends on hidden state \({names}\); {re.escape(_law(e, h))}")


def _law(e: Evidence, h: Mapping[str, Any]) -> str:
    law = str(h["distribution"]).removeprefix(", hidden state ")
    follows = (
        "; constants were taken under a common hidden state, so how the visited ones change with x has to lie within constants "
        "and spread"
        if law.startswith("that of one of")
        else ""
    )
    bound = _each(states(e), [2 * h["bound"][n] for n in states(e)], 3)
    return (
        f"it is {law}. For any two such states and equal (x, u), r differs by no more than {bound} (the largest difference "
        f"seen, times {h['safety']:g}; an estimate is not a bound){follows}."
    )


LAWS = re.compile(
    rf"(?:, hidden state (?:at its default|uniform on \S+ ∈ \[{NUMBER}, {NUMBER}\](?: × \S+ ∈ \[{NUMBER}, {NUMBER}\])*|"
    r"that of one of the \d+ nearest of \d+ states visited in rollouts|in equal parts at its default, as rollouts of up to \d+ "
    r"steps leave it, and moved from its default as the probe does))?"
)
"""What a distribution may say of hidden state."""


def _warned(e: Evidence) -> Iterator[Said]:
    known = _gates(e)
    for text in e.data.get("warnings", []):
        if any(p.fullmatch(text) for p in known):
            yield f"Warning: {text}."


def _symmetric(e: Evidence) -> Iterator[Said]:
    if _drawn(e) and "calibration" not in e.data and (s := e.data.get("symmetry")) is not None:
        yield (
            f"The residual does not change when {' and '.join(s['names'])} {'are' if len(s['names']) > 1 else 'is'} shifted: "
            f"declared by the user, and checked on {s['pairs']} pairs of points of Z, which differed by up to "
            f"{max(s['deviation']):.3g}; {_PROOF if s.get('proved') else 'nothing proves it'}; the audit does not use it."
        )


_PROOF = "interval arithmetic proves it from the equations of both systems"


def _scope(e: Evidence) -> Iterator[Said]:
    if "recording" in e.data:
        return
    texts = ", ".join(dict.fromkeys(r.text for r in e.zone.relations))
    zone = words(e) if "calibration" in e.data else f"X × U with {texts}" if texts else "X × U"
    yield (
        f"The claim is about one period of {e.data['domain']['period']:g} s with the input held, on Z = {zone}; what happens "
        f"between samples and outside Z is not covered. X × U: {_box(e)}."
    )


def _audited(e: Evidence) -> Iterator[Said]:
    if not _drawn(e):
        return
    a = e.data["audit"]
    if "calibration" in e.data:
        yield (
            "It is about that distribution alone: it does not carry over to others, nor to a closed loop, which may stay in "
            f"the part that was missed. The audit's {a['points']} points, drawn afterwards in the same way, are a second look: "
            f"{a['violations']} lie outside, and {a['allowed'] + 1} or more would refute the claim."
        )
        return
    yield (
        f"The audit's {a['points']} points are independent and uniform on {words(e)}{hidden_words(e)} (audit {a['number']} of "
        f"this question); its statement does not carry over to other distributions, nor to a closed loop."
    )


def _covered(e: Evidence) -> Iterator[Said]:
    if e.data["route"] == "theorem1":
        ex, eu = radii(e)
        yield f"The samples cover Z with radius {ex:.6g} in the states and {eu:.6g} in the inputs (computed, rounded up)."


def _refuted(e: Evidence) -> Iterator[Said]:
    """Whether two samples contradict the constants is for the claim's own check; of a declared γ it is counted here."""
    stated = [a for a in e.data["assumptions"] if isinstance(a, str) and a.startswith("REFUTED")]
    if e.data["route"] == "declared" and _drawn(e):
        z, r = e.samples
        low = np.flatnonzero((np.abs(r) > e.arrays["gap.gamma"]).any(axis=1))
        if len(low):
            yield (
                f"REFUTED: at {len(low)} of {len(z)} samples |f̂ − f| lies above the declared γ, first at (x, u) = "
                f"{z[low[0]].tolist()}."
            )
    elif _bounded(e) and stated:
        names = "|".join(map(re.escape, states(e)))
        both = rf"(?:: g changes by {NUMBER}, and they allow {NUMBER})?"
        yield re.compile(rf"REFUTED: two samples contradict the constants of (?:{names}) by {NUMBER}{both}\.")


def _windows(e: Evidence) -> Iterator[Said]:
    if (made := e.data.get("recording")) is None:
        return
    claim, rows, window = e.data["claim"], made["rows"], made["window"]
    beta, unit = claim.get("beta"), "a whole trajectory" if window is None else f"a window of {window:g} s"
    like = "exchangeable: their order says nothing" if beta is None else "independent draws of one distribution"
    level = (
        "on average over such calibrations; this one may be worse, and no confidence is stated for it."
        if beta is None
        else f"unless this calibration is one of a share β = {beta:g} that are worse."
    )
    yield (
        f"The unit is {unit}: {made['units']} have transitions in the domain, and these units, with the one that the claim is "
        f"about, are {like}. That is assumed, not tested; a machine that wears, warms up or decays breaks it."
    )
    yield (
        f"{made['windows']['calibration']} units that the fit has not seen, chosen at random, set the band by the score of "
        f"rank {made['rank']}. A further unit has a transition outside with probability {claim['epsilon']:g} at most, {level}"
    )
    yield "Model, domain, windows and family were chosen before anyone looked at how the held units come out."
    yield (
        f"The residual is what was measured, noise included, over one period of {e.data['domain']['period']:g} s with the "
        f"input held, where a transition begins in Z: {_box(e)}. Of {rows['all']:,} rows {rows['no_transition']:,} begin no "
        f"such transition and {rows['outside']:,} one outside Z or in no whole window; nothing is said of them."
    )
    yield "It does not carry over to other inputs, machines or days, nor to a closed loop that chooses its own points."
    if once := copies(e):
        yield f"{once}; windows with such rows are left out."


def copies(e: Evidence) -> str:
    """What its list of copies says in words, empty where it is; which rows these are the recording alone can tell."""
    made = e.data["recording"]
    whole, parts = ([c for c in made.get("copies", []) if c["whole"] is k] for k in (True, False))
    if not (found := [*whole, *parts]):
        return ""
    named = [f"'{c['name']}' {'is a copy ' if k == 0 else ''}of '{c['of']}'" for k, c in enumerate(whole)]
    part = "'{name}' has {rows} rows from {start:.6g} s on that are a copy of rows of '{of}'"
    named += [part.format(**c) for c in parts]
    rest = [f"and {len(named) - NAMED} more"] if len(named) > NAMED else []
    has, have = ("has rows that are", "have rows that are") if parts else ("is", "are")
    count = len({c["name"] for c in found})
    are = f"{has} a copy and counts" if count == 1 else f"{have} copies of others and count"
    return f"{count} of {made['trajectories']} trajectories {are} once: {', '.join([*named[:NAMED], *rest])}"


NAMED = 3
"""Copies that a certificate names: as many as `copies_told` of recordings has."""


def _book(e: Evidence) -> Iterator[Said]:
    if _drawn(e):
        yield from (f"Warning: {w}." for w in damaged(e))


def damaged(e: Evidence) -> list[str]:
    """What is wrong with the book, of what the entry says that it found."""
    audit = e.data.get("recording", e.data.get("audit", {}))
    if not (book := audit.get("book", {})):
        # Certificates of before this warning lack it; by which rule their points were drawn is told as trusted all the same.
        old = f"audit {audit.get('number')} is of a book before format 2, whose rule of drawing lets a fit know its points"
        return [old] if old in e.data.get("warnings", []) else []
    n = book.get("lost", 0)
    lost = f"lacks {n} that run folders beside it tell of, so that it was lost or replaced" if n else ""
    told = " and ".join(filter(None, (lost, "was edited" if book.get("edited") else "")))
    return [f"the book of audits {told}; what nothing else tells of is not counted"] if told else []


ASSUMPTIONS: tuple[Callable[[Evidence], Iterator[Said]], ...] = (
    _windows,
    _curvature,
    _constants,
    _calibration,
    _declared,
    _resolution,
    _purity,
    _turns,
    _augmented,
    _hidden,
    _warned,
    _symmetric,
    _scope,
    _audited,
    _book,
    _covered,
    _refuted,
)
"""In the order in which a certificate says them."""


# Warnings


def _gates(e: Evidence) -> list[re.Pattern[str]]:
    """Of an input that does not arrive, or not as far."""
    z = e.data["domain"]
    state, u = ("|".join(map(re.escape, part)) or "(?!)" for part in (states(e), z["axes"][z["states"] :]))
    return [
        re.compile(
            rf"(?:{state}) of f̂ does not answer to (?:{u}) at all, and that of f does; look for a motor or a lock that holds "
            r"the joint, or a wrong joint name"
        ),
        re.compile(
            rf"(?:{u}) moves (?:{state}) of f̂ {NUMBER} times as far as that of f; look for another time step, inertia or gain, "
            r"unless that is the question"
        ),
    ]


def _slopes(e: Evidence) -> list[re.Pattern[str]]:
    """Of slopes that grew, and of second differences that do not settle."""
    z = e.data["domain"]
    axis, state = "|".join(map(re.escape, z["axes"])), "|".join(map(re.escape, states(e)))
    at = r"\((?:\S+ = " + NUMBER + r"(?:, )?)+\)"
    grew = (
        rf"The slope of (?:{state}) along (?:{axis}) grew from {NUMBER} to {NUMBER} as the distance shrank from {NUMBER} to "
        rf"{NUMBER}{_UNITS}"
    )
    bounds = r"no constant bounds a jump; use lipschitz\.residual: \{kind: piecewise\}\."
    kink = rf"(?:{state}) along (?:{axis}) \((?:kink|noise|unresolved)\)"
    return [
        re.compile(rf"{grew} at {at}: f̂ − f seems to jump there, by {NUMBER}{_UNITS}, and {bounds}"),
        re.compile(rf"{grew}: f̂ − f seems to jump there, and {bounds}"),
        re.compile(
            rf"{grew}: of random pairs too, so f̂ − f seems to be noisy beyond its resolution, and the constants measure noise\."
        ),
        re.compile(
            rf"Second differences do not settle as the distance shrinks: {kink}(?:, {kink})*\. No curvature is used there; a "
            r"bound along these axes rests on the Lipschitz constants\."
        ),
    ]


def _recorded(e: Evidence) -> Iterator[Said]:
    made, period = e.data["recording"], e.data["domain"]["period"]
    rows = made["rows"]
    if once := copies(e):
        yield once
    if 2 * rows["no_transition"] > rows["all"]:
        yield (
            f"{rows['no_transition']:,} of {rows['all']:,} rows begin no transition of one period of {period:g} s (the next "
            f"row is late, early or missing, a value is missing, or the input moved); the claim is about the others"
        )
    if made.get("number", 1) > 1:
        yield (
            f"this is calibration {made['number']} on the same measurements; fresh ones cannot be drawn from a recording, so "
            f"that one which was chosen by its figures claims too much"
        )
    yield from damaged(e)
