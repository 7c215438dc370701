"""The sections of a report that say why a model is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gapcert.plugin import pretty
from gapcert_recordings import repairs
from gapcert_report.pictures.diagnosis import DiagnosisAlbum
from gapcert_report.pictures.svg import Picture
from gapcert_report.words import words
from gapcert_report.words.diagnosis import (
    briefly,
    cause_name,
    dependence,
    experiment_sentence,
    explained,
    impulse,
    least_size,
    measured,
    numbers,
    plus_minus,
    sentence,
    setting_value,
    shrunk,
    smallest_named,
    whole,
    won,
    won_of,
    won_sentence,
)
from gapcert_report.words.words import Summary, number

from .html import Html, folded, gallery, h, join, listing, part, said, table


def tiles(summary: Summary) -> list[tuple[str, str, str, str]]:
    """(class, value, unit, what it is): the numbers of the causes, and what they bought."""
    items = []
    for cause in summary.get("causes", ()):
        if setting := cause.get("setting"):
            items.append(("", setting_value(setting["value"]), "", cause_name(cause)))
            continue
        for name, p in cause["parameters"].items():
            unit = "" if p["unit"] == "1" else pretty(p["unit"])
            own = "" if len(cause["parameters"]) == 1 else f", {name.replace('_', ' ')}"
            items.append(("", number(p["value"], 3), unit, f"{cause_name(cause)}{own}"))
    gain = summary.get("gain") or {}
    if gain and summary.get("causes"):
        horizon = max(gain, key=float)
        for channel, g in gain[horizon].items():
            if g["after"] > 0:
                ratio = f"{number(g['before'] / g['after'], 3)} ×"
                items.append(("with", ratio, "", f"smaller error of {channel} over {horizon} s, held out"))
    items += [
        ("with", f"{number(old / new, 3)} ×", "", f"smaller γ of {name} with the causes in the model")
        for name, old, new in shrunk(summary)
    ]
    if (both := won(summary)) is not None:
        share = f"{100 * both[0]:.3g} → {100 * both[1]:.3g} %"
        items.append(("with", share, "", f"of {won_of(summary).replace('its', 'the')} win, before and after"))
    return items


def why_wrong(summary: Summary, album: DiagnosisAlbum, folder: Path, winning: Sequence[Picture] = ()) -> Html | None:
    """Causes and rivals, gain, what is left, the experiment, the extended model, and γ and winning domain before and after."""
    if "causes" not in summary:
        return None
    parts = [
        h("h2", "Is it wrong?" if summary["verdict"] == "nothing" else "Why is it wrong?"),
        said(sentence(summary) if "certificate" in summary else None),  # else the page begins with it
        *(h("p", f"Warning: {w}.", class_="bad") for w in summary.get("warnings", ())),
        _causes(summary),
        _refitted(summary),
        gallery(album.laws),
        folded(f"Against the other quantities ({len(album.other_laws)})", gallery(album.other_laws)),
        _rivals(summary),
        _ambiguous(summary),
        _smallest(summary),
        _experiment(summary, album, folder),
        _gain(summary, album),
        _left(summary, album),
        _assumed(summary),
        _log(summary),
        _recertified(summary, winning),
        _extended(summary, folder),
    ]
    return h("section", *parts)


def _causes(summary: Summary) -> Html | None:
    rows = []
    native = any(c.get("native") for c in summary["causes"])
    for c in summary["causes"]:
        for name, value in numbers(c):
            engine = (c.get("native") or "–",) if native else ()
            rows.append((cause_name(c), *engine, name, whole(value), explained(c)))
    if not rows:
        return None
    open_ = summary["verdict"] == "unexplained"
    named = "What part of the error goes with; none of it is shown to be the cause" if open_ else "Causes that were named"
    engine = ("engine's name",) if native else ()
    head = ("cause", *engine, "parameter", "value ± 95 % interval", "explains of the held-out error")
    flagged: dict[str, list[str]] = {}
    for c in summary["causes"]:
        for flag in c.get("flags", ()):
            flagged.setdefault(flag, []).append(cause_name(c))
    flags = [h("p", h("b", f"{words.listed(names)}: "), flag) for flag, names in flagged.items()]
    return join([table(f"{named}; each share with the other causes kept", head, rows, 3 + native), *flags])


def _refitted(summary: Summary) -> Html | None:
    rows = [
        (n, measured(number(p["stated"]), p["unit"]), measured(plus_minus(p["value"], p["low"], p["high"]), p["unit"]))
        for n, p in summary.get("refitted", {}).items()
    ]
    head = ("parameter", "stated", "fitted ± 95 % interval")
    return table("Parameters that have a tolerance, fitted beside whatever was named", head, rows, 1)


def _rivals(summary: Summary) -> Html | None:
    """What else was tried in place of each cause."""
    both = [(c, r) for c in summary["causes"] if (r := c.get("runner_up"))]
    rows = [(cause_name(c), cause_name(r), explained(c), explained(r), number(r.get("margin"), 3)) for c, r in both]
    head = ("cause", "best rival in its place", "the cause explains", "the rival explains", "behind by (ΔS)")
    limits = (
        "A rival less than 10 behind could not be told apart; where one law contains the other, whose numbers are charged "
        "already, the limit is 4, or 9 where much of the residual is not noise."
    )
    below = h("p", h("p", limits)) if any(r[-1] != "–" for r in rows) else None
    return part("Rivals", table("The best of what was fitted in place of each cause", head, rows, 2), below)


def _ambiguous(summary: Summary) -> Html | None:
    groups, parts = summary.get("ambiguous_with", ()), list[Html | None]()
    long = f"of {summary['seconds']:.3g} s " if "seconds" in summary else ""
    if groups:
        rest = h("ul", *(h("li", words.listed([cause_name(c) for c in group])) for group in groups))
        text = "These explain the recording as well" + (
            f"; no input {long}within the limits tells them apart, and the simplest was named:"
            if summary["verdict"] == "causes"
            else ":"
        )
        parts += [h("h3", "Not told apart"), h("p", text), rest]
    if small := summary.get("negligible", ()):
        each = [f"{cause_name(n)} ({100 * n['share']:.2g} % of the effort there)" for n in small]
        parts.append(h("p", f"Seen, but too small to be named: {words.listed(each)}."))
    return join(parts) if parts else None


def _smallest(summary: Summary) -> Html | None:
    if not (found := summary.get("smallest", ())):
        return None
    rows = [(cause_name(s), s["parameter"].replace("_", " "), least_size(s)) for s in found]
    rest = table("The smallest of each effect that this recording would have shown", ("effect", "parameter", "from"), rows, 2)
    text = f"Had it been there, it would have been seen: {briefly(smallest_named(summary), 4)}."
    return part("What would have been seen", h("p", text), folded(f"All {len(rows)}", rest))


def _experiment(summary: Summary, album: DiagnosisAlbum, folder: Path) -> Html | None:
    if not (design := summary.get("design")):
        return said(summary.get("experiment") and f"An experiment that would tell more: {summary['experiment']}")
    pair = [cause_name(r) for r in design["rivals"]]
    pairs = [
        (cause_name(p["one"]), cause_name(p["other"]), number(p["if_one"], 2), number(p["if_other"], 2))
        for p in design.get("apart", ())
    ]
    head = ("one", "other", "if one is true", "if other is")
    caption = "What this input tells apart: how far the best copy by the false one misses, in noise floors (RMS)"
    tried = "How far one rival's prediction stays from the best copy by the other, in noise floors (RMS)"
    rows = [(design["name"], number(design["separation"], 3))]
    rows += [(n, number(v, 3)) for n, v in sorted(design["others"].items(), key=lambda x: -x[1])]
    file = Path(summary["experiment_file"]).name if summary.get("experiment_file") else None
    return part(
        "The experiment that decides",
        h("p", f"Between {words.listed(pair)}. {experiment_sentence(design)}"),
        h("p", "The signal is in ", h("code", file), " in the folder of this run. Record the answer, add the log to ",
          h("code", "recording.files"), " and diagnose both together.") if file else None,
        gallery(album.experiment),
        table(caption, head, pairs, 2) if pairs else None,
        folded(f"What each of {len(rows)} inputs tells apart", table(tried, ("input", "apart"), rows)),
    )  # fmt: skip


def _gain(summary: Summary, album: DiagnosisAlbum) -> Html | None:
    units, named = summary.get("units", {}), bool(summary["causes"])
    rows = []
    for horizon, channels in sorted((summary.get("gain") or {}).items(), key=lambda x: float(x[0])):
        for channel, g in channels.items():
            smaller = f"{number(g['before'] / g['after'], 3)} ×" if g["after"] > 0 else "–"
            after = (number(g["after"]), f"{number(g['low'])} to {number(g['high'])}", smaller) if named else ()
            rows.append((f"{channel}, {horizon} s", number(g["before"]), *after, pretty(units.get(channel, ""))))
    if not rows:
        return None
    after = ("after", "95 % interval of after", "smaller by") if named else ()
    shown = table(
        f"Error of free rollouts ({summary.get('log', {}).get('error', 'RMSE')})",
        ("channel, horizon", "before" if named else "error", *after, "unit"),
        rows,
    )
    return part("On data that took no part", gallery(album.motions), shown)


def _left(summary: Summary, album: DiagnosisAlbum) -> Html | None:
    """The residual beside the noise floor, its tests, and what the answer `unexplained` says of it."""
    columns = {"before": "before", "after": "after"} if summary["causes"] else {"after": "residual"}
    columns |= {"noise_floor": "noise floor"}
    rows = [(n, *(number(r[k]) for k in columns)) for n, r in summary.get("residual", {}).items()]
    tests = summary.get("evidence", {})
    names = list(dict.fromkeys(c for one in tests.values() for c in one))
    found = [(test, _unit_of(test), *(number(one.get(c), 3) for c in names)) for test, one in tests.items()]
    rms = "RMS residual of the fitted windows beside the noise floor, in the channel's unit"
    told = "Tests of what is left; of noise alone, none is beyond 3 standard deviations"
    return join([
        h("h3", "What is left"),
        _unexplained(summary.get("unexplained")),
        _pushes(summary.get("pushes", ())),
        table(rms, ("channel", *columns.values()), rows),
        gallery(album.left),
        table(told, ("test", "in", *names), found, 2),
    ])  # fmt: skip


def _unit_of(test: str) -> str:
    """The unit of a test of the residual, with what noise gives."""
    if test.startswith(("mean square", "beyond", "error over")):
        return "1 is noise"
    return "0 is white" if test == "autocorrelation" else "standard deviations"


def _unexplained(rest: Summary | None) -> Html | None:
    if not rest:
        return None
    told = dependence(rest)
    parts: list[Html | None] = [said(told)]
    if (where := rest.get("where")) and "most of it at" not in told:
        parts.append(h("p", f"Most of it lies at {words.listed([f'{a:.3g} to {b:.3g} s' for a, b in where])}."))
    if kinds := rest.get("looks_like"):
        rows = [(k.replace("_", " "), f"{100 * v:.0f} %") for k, v in sorted(kinds.items(), key=lambda x: -x[1])]
        parts.append(table("Share that features of each kind predict in data not seen", ("kind", "share"), rows))
    if law := rest.get("correction"):
        terms = [(term, number(v)) for term, v in law["terms"].items()]
        known = f"it predicts {100 * law['explained']:.0f} % of the residual in data not seen"
        caption = f"A correction from data alone at {law['site']}, not a cause; {known}"
        parts.append(table(caption, ("term", "coefficient"), terms))
    return join(parts)


def _pushes(pushes: Sequence[Summary]) -> Html | None:
    rows = [
        (p["trajectory"], f"{p['t']:.3f} s", f"{p['duration']:.3f} s", p["site"], impulse(p),
         measured(number(p["force"], 3), p["force_unit"]))
        for p in pushes
    ]  # fmt: skip
    caption = "Pushes from outside, with 95 % intervals of their impulses"
    return table(caption, ("trajectory", "from", "for", "at", "impulse", "mean force"), rows) if rows else None


def _assumed(summary: Summary) -> Html | None:
    assumed = summary.get("assumptions")
    return h("p", h("b", "Assumed: "), "; ".join(assumed), ".") if assumed else None


def _log(summary: Summary) -> Html | None:
    if not (log := summary.get("log")):
        return None
    rows = [(str(k).replace("_", " "), _told(v)) for k, v in log.items()]
    found = "; ".join(repairs(log))
    return join([
        h("p", h("b", "Repaired in the recording: "), found, ".") if found else None,
        folded("What was found in the recording", table("Recording", ("what", "found"), rows, 2)),
    ])  # fmt: skip


def _told(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{k}: {_told(v)}" for k, v in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(_told, value)) or "none"
    return number(value)


def _recertified(summary: Summary, winning: Sequence[Picture]) -> Html | None:
    if not (again := summary.get("recertified")):
        return None
    rows = [(name, number(old), number(new), f"{number(old / new, 3)} ×") for name, old, new in shrunk(summary)]
    head = ("state", "mean γ before", "mean γ after", "smaller by")
    claims = [
        h("p", f"{when}: ", c["refused"] if "refused" in c else words.claim_sentence(c))
        for when, c in (("Without the causes", again.get("before")), ("With them", again.get("after")))
        if c
    ]
    shown = table("The certificate, before and after the causes were added to the model", head, rows)
    last = gallery(winning), _controllers(again), said(won_sentence(summary))
    return part("How wrong it was, and is", shown, *claims, *last)


def _controllers(again: Summary) -> Html | None:
    found = [(when, c) for when in ("before", "after") if (c := (again.get(when) or {}).get("controller"))]
    if not found:
        return None
    cells = any("winning_cells" in c for _, c in found)
    columns = {"winning_cells": "winning cells", "cells": "of"} if cells else {"domain_fraction": "starts from this share"}
    rows = [(when, *(number(c.get(k)) for k in columns)) for when, c in found]
    why = [(when, c.get("refused") or c.get("reason")) for when, c in found]
    shown = table("The controller, with the γ of each model", ("model", *columns.values()), rows)
    return join([shown, *(h("p", f"{when.capitalize()}: {text}") for when, text in why if text)])


def _extended(summary: Summary, folder: Path) -> Html | None:
    if not (path := summary.get("extended_model")):
        return None
    file = folder / Path(path).name
    text = file.read_text(encoding="utf-8") if file.is_file() else None
    equations = summary.get("equations")
    return part(
        "The extended model",
        listing(equations, "The equations of the extended model") if equations else None,
        h("p", "Saved as ", h("code", file.name), " in the folder of this run; ", h("code", f"gapcert extend {folder.name}"),
          " writes it elsewhere."),
        folded("As a spec", listing(text, "The extended model as a spec") if text else None),
    )  # fmt: skip
