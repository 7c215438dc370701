"""A run folder as one self-contained page: the answer first, then what it rests on."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gapcert.plugin import DAMAGE, UsageError, __version__, clipped, times, write_atomic
from gapcert_closed_loop import broken_sentence
from gapcert_figures import Figures
from gapcert_report.pictures.album import Album, album_of
from gapcert_report.words import words
from gapcert_report.words.compare import sentences
from gapcert_report.words.diagnosis import cause_name, sentence, whole
from gapcert_report.words.words import Summary, number

from . import compare, diagnosis
from .html import Html, document, folded, framed, gallery, h, join, listing, part, said, section, table

_STATE_COLUMNS = {
    "gap_mean": "mean gap",
    "gamma_mean": "mean γ",
    "gamma_max": "max γ",
    "tightness": "tightness",
    "constant_bound": "constant bound",
    "envelope_mean": "mean of the envelope",
    "tightness_vs_envelope": "γ / envelope",
    "safety_factor": "safety factor",
    "resolved": "resolved",
    "vacuous": "vacuous",
}
_QUANTITIES = {
    "domain_fraction": "starts from, as a share of the set to stay in",
    "domain_of_nominal": "domain with γ over that without",
    "horizon": "horizon [steps]",
    "tube": "tube, ± at its widest",
    "tube_at_end": "tube, ± at the end",
    "terminal_margin": "margin of the terminal set, as a share of it",
    "adapt": "parameters that are learned, from",
}


def mark(good: bool | None) -> Html:
    """A verdict in a table cell: sign and word, never colour alone."""
    kind, word = ("good", "yes") if good else ("open", "not decided") if good is None else ("bad", "no")
    return h("b", f"{words.MARKS[kind]} {word}", class_=kind)


def answer(summary: Summary) -> Html:
    """Verdict, and the sentence that the claim allows."""
    word, kind, meaning = words.verdict(summary)
    parts = [h("p", f"{words.MARKS[kind]} {word}", class_="verdict")]
    if "certificate" in summary:
        c = summary["certificate"]
        refuted = words.refutation(c) is not None
        told = (words.claim_sentence(c), "" if refuted else words.tightness_sentence(c), words.loop_sentence(summary))
        parts += [h("p", s) for s in told if s]
    elif "causes" in summary:
        parts.append(h("p", whole(sentence(summary))))
    elif "pairs" in summary:
        parts += [h("p", text) for text in sentences(summary)]
    if summary["verdict"] in ("fails", "unknown") or len(parts) == 1:
        parts.append(h("p", summary.get("reason") or meaning))
    if unmet := [e for e in summary.get("expectations", ()) if not e["met"]]:
        which = words.some([f"{e['text']} (found {_value(e['value'])})" for e in unmet], 3)
        parts.append(h("p", h("b", f"{words.MARKS['bad']} Not as the spec expects", class_="bad"), f": {which}."))
    if "certificate" in summary:
        parts.append(h("p", words.symbols(summary["certificate"]), class_="symbols"))
    return h("section", *parts, class_=f"answer {kind}", aria_label="Answer")


def tiles(summary: Summary) -> Html | None:
    """The few numbers that a reader looks for: (class, value, unit, what it is)."""
    items: list[tuple[str, str, str, str]] = []
    certificate, loop = summary.get("certificate", {}), summary.get("closed_loop", {})
    tight = words.tightness(certificate)
    if len(tight) > words.MANY:
        ends = f"{min(tight.values()):.3f}\u00a0–\u00a0{max(tight.values()):.3f}\u00a0×"
        items.append(("", ends, "", f"mean γ over mean gap, {len(tight)} states"))
    else:
        items += [("", f"{t:.3f} ×", "", f"mean γ over mean gap of {name}") for name, t in tight.items()]
    if "samples" in certificate:
        whose = "measured" if "recording" in certificate else "simulator"
        items.append(("", number(certificate["samples"].get("bound")), "", f"{whose} transitions behind the bound"))
    if windows := certificate.get("recording", {}).get("windows"):
        items.append(("", number(windows["calibration"]), f"of {sum(windows.values()):,}", "windows, unseen by the fit, set γ"))
    if "audit" in certificate:
        a = certificate["audit"]
        kind = "bad" if a["violations"] > a.get("allowed", 0) else ""
        items.append((kind, number(a["violations"]), f"of {a['points']:,}", "fresh points outside the band"))
    for key, label in (("without_gamma", "without\u00a0γ"), ("with_gamma", "with\u00a0γ")):
        if run := loop.get(key):
            items.append((key.split("_")[0], number(run["violations"]), f"of {run['starts']:,}", f"runs broken {label}"))
    items += compare.tiles(summary) if "pairs" in summary else []
    items += diagnosis.tiles(summary)
    cards = (h("li", h("strong", v, " ", h("small", unit)), h("span", text), class_=kind) for kind, v, unit, text in items)
    return h("ul", *cards, class_="tiles") if items else None


def expectations(summary: Summary) -> Html | None:
    # What is not met stands first, and is seen at once.
    found = sorted(summary.get("expectations", ()), key=lambda e: bool(e["met"]))
    if not found:
        return None
    rows = [(e["text"], _value(e["value"]), mark(e["met"])) for e in found]
    met = sum(bool(e["met"]) for e in found)
    shown = table("What the spec expects, and what was found", ("expected", "found", "met"), rows, 3)
    told = f"{words.MARKS['good' if met == len(rows) else 'bad']} {met} of {len(rows)} that the spec states are met"
    if met == len(rows):
        return section("Expectations", folded(told, shown))
    return section("Expectations", h("p", f"{told}.", class_="bad"), shown)


def _value(value: Any) -> str:
    if isinstance(value, Mapping) and "effect" in value:
        return cause_name(value)
    if isinstance(value, Mapping):
        return ", ".join(_value(v) if k == "kind" else f"{k} {_value(v)}" for k, v in value.items())
    if isinstance(value, list | tuple):
        told = [_value(v) for v in value]
        return f"{told[0]}, {len(told)} times" if len(told) > 3 and len(set(told)) == 1 else ", ".join(told) or "none"
    return number(value)


def _short(value: Any) -> str:
    """A value; of a digest its first digits, which are enough to tell it from others."""
    text = _value(value)
    return f"{text[:12]}…" if len(text) == 64 and set(text) <= set("0123456789abcdef") else text


def beside(summary: Summary) -> Html | None:
    """Certificates of one question by different routes: tightness, samples and seconds in one table."""
    rows = summary.get("beside", ())
    if not rows:
        return None
    states = list(rows[0]["states"])
    columns = ("spec", "family", "route", *(f"tightness of {s}" for s in states), "samples of the bound", "in all", "seconds")
    cells = [
        (
            r["name"],
            r["family"],
            r["route"],
            *(number(r["states"][s].get("tightness")) for s in states),
            number(r["samples"]["bound"]),
            number(sum(r["samples"].values())),
            number(r["seconds"]),
        )
        for r in rows
    ]
    return section("The same question by another route", table("Sampling included", columns, cells))


def how_wrong(summary: Summary, figures: Figures, album: Album) -> Html | None:
    """The certificate: table, pictures, assumptions, what was spent, and the audit."""
    c = summary.get("certificate")
    if not c:
        return None
    seen = figures.gap.axes if figures.gap else figures.winning.axes if figures.winning else ()
    held = [(s.state, s.unit) for s in figures.recorded.stretches] if figures.recorded else []
    units = {n: unit for n, unit in [*((a.name, a.unit) for a in seen), *held] if unit not in ("", "1")}
    columns = {k: v for k, v in _STATE_COLUMNS.items() if any(k in s for s in c["states"].values())}
    # Said only where there is something to be said.
    if all(s.get("resolved", True) for s in c["states"].values()):
        columns.pop("resolved", None)
    if not any(s.get("vacuous") for s in c["states"].values()):
        columns.pop("vacuous", None)
    rows = [(f"{n} [{units[n]}]" if n in units else n, *(number(s.get(k)) for k in columns)) for n, s in c["states"].items()]
    measured = "recording" in c
    asked = "samples" in c
    over = ", over the transitions of the held windows" if measured else ", over the audit's points" if asked else ""
    # Warnings stand above the list already.
    rests = [words.plain(a) for a in c["assumptions"] if not a.startswith("Warning: ")]
    return section(
        "How wrong can the model be?",
        table(f"Per state{over}; γ in the unit of the state, per step", ("state", *columns.values()), rows),
        gallery(album.pairs, "pictures pairs"),
        gallery(album.bands),
        folded(f"Along the other axes ({len(album.other_axes)})", gallery(album.other_axes)),
        h("h3", "What the claim rests on"),
        h("p", words.claim_sentence(c)),
        *(h("p", f"Warning: {w.rstrip('.')}.", class_="bad") for w in c.get("warnings", ())),
        said(words.jump_sentence(c)),
        h("ol", *(h("li", a) for a in rests)) if rests else h("p", "No assumption is recorded."),
        _hidden(c),
        _spent(c) if asked else None,
    )


def _spent(c: Summary) -> Html | None:
    """Transitions by their purpose, and what attacked the band, or set it."""
    spent = {"bound": "for the bound itself", "lipschitz": "to estimate constants", "audit": "for the audit"}
    spent |= {"calibration": "to set the band", "symmetry": "to check the symmetry"}
    samples = [(spent.get(k, k), number(v)) for k, v in c["samples"].items()]
    measured = "recording" in c
    title = "What was measured, and what set the band" if measured else "What was spent, and what attacked it"
    shown = table("Measured transitions" if measured else "Simulator transitions", ("purpose", "transitions"), samples)
    return part(title, h("div", shown, _windows(c["recording"]) if measured else _audit(c), class_="side"))


def _hidden(c: Summary) -> Html | None:
    """What the model leaves out, how far it was seen to move each state, and how far the claim allows for it."""
    hidden = c.get("hidden")
    if not hidden or not hidden.get("names"):
        return None
    states = list(c["states"])
    rows = [(f"probe: {r['name']} alone", *(number(r["spread"][n], 3) for n in states)) for r in hidden.get("ranked", ())]
    rows += [("probe: any of it", *(number(hidden["spread"][n], 3) for n in states))] if rows else []
    if (bound := hidden.get("bound")) is not None:
        allowed = f"γ allows for: the most between two draws, times {hidden['safety']:g}"
        rows.append((allowed, *(number(2 * bound[n], 3) for n in states)))
    shown = table("How far it moves the next state, in the unit of each", ("hidden state", *states), rows)
    return part("What the model leaves out", h("p", words.hidden_sentence(hidden)), shown)


def _windows(made: Summary) -> Html | None:
    windows, rows = made["windows"], made["rows"]
    counts = [
        ("windows of the fit", windows["fit"]),
        ("windows that set the band", windows["calibration"]),
        ("rank of the score that did", made["rank"]),
        ("rows of the recording", rows["all"]),
        ("rows that begin no transition of one period", rows["no_transition"]),
        ("transitions outside the domain, or in no whole window", rows["outside"]),
    ]
    return table("The recording", ("of it", "count"), [(what, number(n)) for what, n in counts])


def _audit(c: Summary) -> Html:
    names = {"points": "points", "violations": "outside [l, u]", "gamma_violations": "above γ", "epsilon": "ε", "beta": "β"}
    rows = [(t, *(number(c[t].get(k)) for k in names)) for t in ("audit", "attack") if t in c]
    inner = table("On points that no fit has seen", ("test", *names.values()), rows)
    return h("div", inner, said(words.witness_sentence(c)))


def compared(summary: Summary, figures: Figures) -> Html | None:
    """Simulator against simulator, and the matrix of certificates."""
    if "pairs" not in summary:
        return None
    seen, others = compare.gallery_of(summary, figures)
    more = folded(f"The other pairs ({len(others)} pictures)", gallery(others, "pictures pairs"))
    parts = [compare.differences(summary), gallery(seen, "pictures pairs"), more, compare.causes(summary)]
    return join([*parts, compare.matrix(summary), compare.unavailable(summary)])


def controller(summary: Summary, album: Album) -> Html | None:
    """The controller and its runs, all policies, and which of them fail without γ."""
    c, loop = summary.get("controller"), summary.get("closed_loop")
    if not (c or loop):
        return None
    parts: list[Html | None] = [gallery(album.loop)]
    if loop:
        rows = loop.get("policies") or [{**loop[k], "controller": k} for k in ("without_gamma", "with_gamma") if k in loop]
        parts.append(_policies(rows))
        failing = [r["policy"] for r in rows if r["controller"] == "without_gamma" and r["violations"]]
        many = "policies" if len(failing) > 1 else "policy"
        parts.append(h("p", f"Fails without γ: {many} {words.listed(failing)}." if failing else "No policy failed without γ."))
        late = [
            f"{n:,} of {times(r['starts'], 'run')} under policy {r['policy']}"
            for r in rows
            if r["controller"] == "with_gamma" and (n := words.on_the_way(r))
        ]
        parts.append(said(f"With γ, still on the way to the target after the last step: {words.listed(late)}." if late else ""))
        parts += [h("p", broken_sentence(r), ".") for r in rows if r["controller"] == "with_gamma" and r.get("broken_promises")]
        if skipped := loop.get("skipped"):
            told = words.listed(skipped).replace("gamma", "γ")
            parts.append(h("p", f"Asked for, and not run since these controllers do not know them: {told}."))
        parts += [said(words.learned_sentence(loop)), said(words.runs_sentence(loop))]
    if c:
        hidden = ("levels", "gap_over_cells", "assumptions")
        rows = [(_QUANTITIES.get(k, k.replace("_", " ")), _short(v)) for k, v in c.items() if k not in hidden]
        parts.append(table("Controller", ("quantity", "value"), rows, 2))
        if trusted := c.get("assumptions"):
            parts += [h("h3", "What the controller takes on trust"), h("ol", *(h("li", words.plain(a)) for a in trusted))]
        parts.append(_levels(c["levels"]) if c.get("levels") else None)
        parts.append(h("p", words.suprema(told)) if (told := c.get("gap_over_cells")) else None)
    return h("section", h("h2", "What does it buy a controller?"), *parts)


def _levels(levels: Sequence[Summary]) -> Html | None:
    """The winning part of the volume against the size of the smallest cells, and what a uniform grid of these would count."""
    shown, made = list[tuple[object, ...]](), 0
    for row in levels:
        made += row["cells"]
        sizes = " × ".join(f"{v:.3g}" for v in row["cell"].values())
        shown.append((sizes, f"{row['winning_fraction']:.2%}", f"{made:,}", f"{row['uniform_cells']:,}"))
    names = " × ".join(levels[0]["cell"])
    head = (f"smallest cells, {names}", "winning", "cells solved so far", "cells of this size alone")
    return table("Domain against cell size", head, shown)


def _policies(counts: Sequence[Summary]) -> Html | None:
    order = list(dict.fromkeys(r["policy"] for r in counts))
    columns = {"violations": "violations", "stranded": "stranded", "left_goal": "left the goal"}
    if any("reached" in r for r in counts):
        columns |= {"reached": "reached", "late": "still on the way"}
    told = {"settled": "came to stay", "visits": "fewest visits", "broken_promises": "steps that broke a promise"}
    told |= {"refused": "refused", "fallbacks": "on an old plan"}
    columns |= {k: text for k, text in told.items() if any(k in r for r in counts)}
    columns |= {"outside": "steps outside [l, u]"} if any("steps_held" in r for r in counts) else {}
    in_order = sorted(counts, key=lambda r: (order.index(r["policy"]), r["controller"] == "with_gamma"))
    rows = []
    for r in in_order:
        shown = {k: number(v) for k, v in {**r, "late": words.on_the_way(r)}.items()}
        if "steps_held" in r:
            shown["outside"] = f"{number(r['outside_gap'])} of {number(r['steps_held'])}"
        # A no-break space: rows stay one line high.
        named = r["controller"].replace("_gamma", "\u00a0γ")
        rows.append((r["policy"], named, _kept(r), *(shown.get(k, "") for k in columns)))
    head = ("policy", "controller", "kept", *columns.values())
    # All runs are from the same starts, less those that are refused, and equally long.
    most = max(r["starts"] for r in counts)
    runs = f"{times(most, 'run')} of at most {times(counts[0]['steps'], 'step')} each"
    return table(f"Closed loop on the simulator, {runs}; a violation ends its run", head, rows, 3)


def _kept(row: Summary) -> Html:
    # Nothing broke, and some runs have not arrived: that is neither kept nor not.
    return mark(False if row["violations"] else None if words.on_the_way(row) else True)


def provenance(summary: Summary, figures: Figures, folder: Path) -> Html | None:
    """Stages, timings, versions, and the commands that look at this run again."""
    times = {k.replace("_", " "): number(v) for k, v in _flat(summary.get("timings", {}))}
    versions = sorted(_versions(folder).items())
    lanes = {lane.stage.replace("_", " "): lane.states[-1] for lane in figures.lanes}
    stages = [(name, lanes.get(name, ""), times.get(name, "")) for name in dict.fromkeys([*lanes, *times])]
    certified = [p for p in (folder, folder / "before", folder / "after") if (p / "certificate.json").exists()]
    verify = (
        f"gapcert verify {p.relative_to(folder.parent)}  # check the certificate again, from its data\n" for p in certified
    )
    commands = "".join([*verify, f"gapcert report {folder.name}  # write this page again\n"])
    if (folder / "run.rrd").exists():
        commands += f"rerun --bind 127.0.0.1 {folder.name}/run.rrd  # walk through the run in the Rerun viewer\n"
    tables = (
        table("Stages", ("stage", "ended with", "seconds"), stages, 2),
        table("Versions", ("package", "version"), versions, 2),
    )
    return section(
        "How this was made",
        h("p", "From the folder above the run:"),
        listing(commands, "Commands"),
        folded("Stages, time and versions", h("div", *tables, class_="side")),
    )


def _versions(folder: Path) -> dict[str, str]:
    """Those that the certificate was made with; of a diagnosis, those of its first certificate."""
    for place in (folder, folder / "before"):
        if (file := place / "certificate.json").is_file():
            with suppress(*DAMAGE):  # a damaged certificate is for `verify` to tell
                return dict(json.loads(file.read_text(encoding="utf-8"))["versions"])
    return {}


def _flat(timings: Summary) -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for k, v in timings.items():
        out += [(f"{k} {a}", b) for a, b in _flat(v)] if isinstance(v, Mapping) else [(k, v)]
    return out


def contents(body: Html) -> tuple[Html, Html]:
    """Links to the sections, and the page with the places that they lead to."""
    names = re.findall("<h2>(.*?)</h2>", body)
    for k, name in enumerate(names):
        body = Html(body.replace(f"<h2>{name}</h2>", f'<h2 id="part{k}">{name}</h2>', 1))
    links = (h("a", Html(name), href=f"#part{k}") for k, name in enumerate(names))
    return h("nav", *links, class_="contents", aria_label="On this page"), body


def neighbours(folder: Path) -> Html | None:
    """Links to the other runs of a matrix."""
    if not (file := folder / "matrix.json").is_file():
        return None
    links = []
    for one in json.loads(file.read_text(encoding="utf-8")):
        text = ", ".join(f"{k} = {v}" for k, v in one["values"].items()) or one["folder"]
        here = {"aria_current": "page"} if one["folder"] == folder.name else {}
        links.append(h("a", text, href=f"../{quote(one['folder'])}/report.html", **here))
    return h("nav", h("span", "Runs of this matrix:"), *links, aria_label="Runs of this matrix")


def page(summary: Summary, figures: Figures, folder: Path, version: str) -> Html:
    """The whole document."""
    name = str(summary.get("name", folder.name))
    title = f"{name}: {words.verdict(summary)[0].lower()}"
    album = album_of(figures, summary)
    first = compare.hero(summary, figures) if "pairs" in summary else album.hero
    parts = [
        answer(summary), tiles(summary), h("h2", "At a glance", class_="unseen") if first else None, gallery(first),
        expectations(summary), compared(summary, figures), how_wrong(summary, figures, album), beside(summary),
        controller(summary, album), diagnosis.why_wrong(summary, album.diagnosis, folder, album.loop),
        provenance(summary, figures, folder),
    ]  # fmt: skip
    inside, main = contents(join(parts))
    return document(title, *framed([h("h1", name), inside, neighbours(folder)], [main], version))


def write_report(folder: Path) -> Path:
    """Write `report.html` from `summary.json` and the figures of a run folder; no other file, no network."""
    source = folder / "summary.json"
    if not source.is_file():
        raise UsageError(f"{folder}: there is no summary.json; expected the folder of a finished run; run the spec again")
    try:
        summary = json.loads(source.read_text(encoding="utf-8"))
        if not isinstance(summary, dict):
            raise TypeError("it holds no object")
        text = page(summary, Figures.load(folder), folder.resolve(), __version__)
    except DAMAGE as error:
        what = f"{source}: cannot be read ({type(error).__name__} {clipped(str(error))[0]})"
        raise UsageError(f"{what}; expected what `gapcert run` writes; run the spec again") from error
    path = folder / "report.html"
    write_atomic(path, text.encode())
    return path
