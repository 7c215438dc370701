"""How results are shown: in a line, in a sentence, on a terminal, and in a notebook. The components of kind `view`.

A notebook shows the verdict and the sentence of its claim, a small table, a picture or two. Words, tables and pictures are
the report's, so that no more is said here than there. Colours are such as can be read on white and on black, and text has
that of its surroundings: no script has to ask which theme is on.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, final

from gapcert.plugin import View, times

from .pages.html import Html, h, join, legend, table
from .words import words
from .words.words import Summary, number

if TYPE_CHECKING:
    from .pictures.svg import Picture

MOST = 2  # pictures: a cell's output is read in passing
ROWS = 12  # of a table; more are counted
_SPENT = {"lipschitz": "constants", "symmetry": "the check of the symmetry"}
_STYLE = """
.gapcert { --ink: currentColor; --truth: currentColor; --card: transparent; --faint: #808891; --line: #80889155;
  --with: #3b7fdb; --without: #cc6c12; --bad: #d8404f; --good: #1f9058; --open: #ad7d12;
  font: 14px/1.5 system-ui, sans-serif; max-width: 1000px; margin: .3em 0; }
.gapcert .answer { border-left: 4px solid; padding: .1em .8em; margin: 0 0 .6em; }
.gapcert .answer p { margin: .2em 0; max-width: 80ch; } .gapcert .verdict { font-size: 19px; font-weight: 700; }
.gapcert .good { border-color: var(--good); } .gapcert .bad { border-color: var(--bad); }
.gapcert .open { border-color: var(--open); }
.gapcert .good .verdict { color: var(--good); } .gapcert .bad .verdict { color: var(--bad); }
.gapcert .open .verdict { color: var(--open); }
.gapcert table { border-collapse: collapse; margin: .4em 0; color: inherit; background: none; font-size: 13px; }
.gapcert caption { text-align: left; opacity: .75; padding: 0 0 .2em; caption-side: top; }
.gapcert tr, .gapcert tbody tr:nth-child(odd), .gapcert tbody tr:hover { background: none; }
.gapcert th, .gapcert td { text-align: left; padding: .15em .9em .15em 0; border: 0; border-bottom: 1px solid var(--line);
  color: inherit; background: none; font-weight: 400; }
.gapcert thead th { font-weight: 600; } .gapcert .n { text-align: right; font-variant-numeric: tabular-nums; }
.gapcert .scroll { overflow-x: auto; } .gapcert .pictures { display: flex; flex-wrap: wrap; gap: .8em; }
.gapcert figure { margin: .4em 0; flex: 1 1 320px; max-width: 460px; }
.gapcert svg { display: block; width: 100%; height: auto; }
.gapcert .legend { list-style: none; display: flex; flex-wrap: wrap; gap: .1em 1em; margin: 0; padding: 0; font-size: 12px; }
.gapcert .legend li { display: flex; align-items: center; gap: .4em; margin: 0; } .gapcert .legend svg { width: 22px; }
.gapcert figcaption, .gapcert .note { font-size: 12px; opacity: .75; margin: .2em 0; } .gapcert figure b { font-size: 13px; }
"""


def shown(answer: Sequence[object], kind: str, *parts: object, pictures: Sequence[Picture] = ()) -> str:
    """One output: what was found, tables, and at most MOST pictures; everything that is no markup yet is escaped."""
    head = h("div", *answer, class_=f"answer {kind}")
    drawn = [h("figure", h("b", p.title), legend(p), _apart(p.svg), h("figcaption", p.caption)) for p in pictures[:MOST]]
    gallery = h("div", *drawn, class_="pictures") if drawn else None
    return str(h("div", h("style", Html(_STYLE)), head, *parts, gallery, class_="gapcert"))


def _apart(svg: str) -> Html:
    """With ids of its own: a notebook has many outputs on one page, and pictures of one name in several."""
    key = "g" + hashlib.sha256(svg.encode()).hexdigest()[:8]
    svg = re.sub(r'\bid="', f'id="{key}-', svg).replace("url(#", f"url(#{key}-").replace('href="#', f'href="#{key}-')
    return Html(svg)


def _verdict(word: str, kind: str) -> Html:
    return h("p", f"{words.MARKS[kind]} {word}", class_="verdict")


def certificate_html(c: Summary, pictures: Sequence[Picture] = ()) -> str:
    """Of a certificate's summary: the claim, γ per state, and what refutes it if anything does."""
    return shown(*_certified(c), _states(c), _asked(c), _assumed(c), pictures=pictures)


def _certified(c: Summary) -> tuple[list[object], str]:
    claim = c["claim"]["kind"]
    word, kind = claim.capitalize(), "open" if claim in ("assumed", "empirical") else "good"
    if words.refutation(c) is not None:
        word, kind = "Refuted", "bad"
    said = [words.claim_sentence(c), words.tightness_sentence(c)]
    warned = [h("p", f"Warning: {w.rstrip('.')}.") for w in c.get("warnings", ())]
    return [_verdict(word, kind), *(h("p", s) for s in said if s), *warned], kind


def _states(c: Summary) -> Html:
    columns = {"gap_mean": "mean gap", "gamma_mean": "mean γ", "gamma_max": "max γ", "tightness": "tightness"}
    columns |= {"constant_bound": "constant bound"}
    used = {k: v for k, v in columns.items() if any(k in s for s in c["states"].values())}
    rows = [(n, *(number(s.get(k)) for k in used)) for n, s in c["states"].items()]
    return _short("Per state, in its unit, per step", ("state", *used.values()), rows)


def _asked(c: Summary) -> Html | None:
    if "samples" not in c:
        return None
    spent = ", ".join(f"{number(n)} for {_SPENT.get(what, f'the {what}')}" for what, n in c["samples"].items() if n)
    return h("p", f"Transitions: {spent}.", class_="note")


def _assumed(c: Summary) -> Html | None:
    """What the claim rests on, folded: its sentence speaks of what stands below."""
    rests = [h("li", words.plain(a)) for a in c.get("assumptions", ())]
    return h("details", h("summary", times(len(rests), "assumption")), h("ol", *rests), class_="note") if rests else None


def _short(caption: str, head: Sequence[object], rows: Sequence[Sequence[object]], texts: int = 1) -> Html:
    more = h("p", f"and {len(rows) - ROWS} more", class_="note") if len(rows) > ROWS else None
    return join([table(caption, head, rows[:ROWS], texts), more])


def _diagnosed(summary: Summary) -> tuple[list[object], str]:
    from .words.diagnosis import sentence

    word, kind, _ = words.VERDICTS[summary["verdict"]]
    return [_verdict(word, kind), h("p", sentence(summary))], kind


def _causes(summary: Summary) -> Html:
    from .words.diagnosis import cause_name, explained, numbers

    rows = [(cause_name(c), n, v, explained(c)) for c in summary["causes"] for n, v in numbers(c)]
    head = ("cause", "parameter", "value ± 95 % interval", "explains of the held-out error")
    return _short("Each share with the other causes kept", head, rows, 3)


def _compared(summary: Summary) -> tuple[list[object], str]:
    from .words.compare import sentences

    word, kind, _ = words.VERDICTS[summary["verdict"]]
    return [_verdict(word, kind), *(h("p", s) for s in sentences(summary))], kind


def _pairs(summary: Summary) -> Html:
    from .words.compare import setting_name, share

    rows = []
    for p in summary["pairs"]:
        same = p.get("refused") or ("differ" if p["resolved"] else "agree")
        by = p["explained_by"][:1]
        rows.append((
            f"{p['a']} – {p['b']}", same, f"{setting_name(by[0])} ({share(by[0]['reduction'])})" if by else "",
            number(p["mean"]), number(p["max"]),
        ))  # fmt: skip
    head = ("pair", "they", "closed by", "mean difference", "largest")
    return _short("After one step, in the unit of each state", head, rows, 3)


def certificate_line(c: Summary, name: str) -> str:
    """`Certificate(statistical, γ 1.005 × the gap of theta, 0 of 14,502 audited points outside)`."""
    tight = [f"γ {t:.3f} × the gap of {n}" for n, t in words.tightness(c).items()]
    audit = c.get("audit")
    seen = [f"{audit['violations']:,} of {audit['points']:,} audited points outside"] if audit else []
    level = "REFUTED" if words.refutation(c) is not None else c["claim"]["kind"]
    return f"{name}({', '.join([level, *tight, *seen])})"


@final
class CertificateView(View):
    """Of a Certificate, or a Declaration."""

    def line(self, value: Any) -> str:
        return certificate_line(value.summary(), type(value).__name__)

    def html(self, value: Any) -> str:
        return certificate_html(value.summary())


@final
class RecordingView(View):
    """Of a certificate on a recording, with the scores of its windows."""

    def line(self, value: Any) -> str:
        return certificate_line(value.summary(), type(value).__name__)

    def html(self, value: Any) -> str:
        from gapcert_figures import recorded_figure

        from .pictures.gap import recorded_pictures

        return certificate_html(value.summary(), recorded_pictures(recorded_figure(value)))


@final
class DiagnosisView(View):
    """Of a Diagnosis: what was found, its numbers, and the pictures that carry the answer."""

    def line(self, value: Any) -> str:
        """`Diagnosis(causes: coulomb-friction at q 92 %)`."""
        named = ", ".join(f"{c.effect} at {c.site} {c.explained:.0%}" for c in value.causes)
        return f"Diagnosis({value.verdict}{': ' + named if named else ''})"

    def sentence(self, value: Any) -> str:
        from .words.diagnosis import sentence

        return sentence(value.summary())

    def html(self, value: Any) -> str:
        from .pictures.diagnosis import diagnosis_album

        summary = value.summary()
        return shown(*_diagnosed(summary), _causes(summary), pictures=diagnosis_album(value.figure, summary).hero)


@final
class ComparisonView(View):
    """Of a Comparison: who agrees with whom, and which setting separates the others."""

    def line(self, value: Any) -> str:
        """`Comparison(differ: 2 of 6 pairs of 4 simulators, 1 explained)`."""
        s, differ = value.summary, value.summary["differ"]
        of = f"{differ['pairs']} of {len(s['pairs'])} pairs of {len(s['backends'])} simulators"
        return f"Comparison({s['verdict']}: {of} differ, {differ['explained']} explained)"

    def html(self, value: Any) -> str:
        from gapcert_figures import Figures

        from .pages.compare import hero

        drawn = hero(value.summary, Figures(compare=value.figure))
        return shown(*_compared(value.summary), _pairs(value.summary), pictures=drawn)


@final
class RunView(View):
    """Of a Run, or of a matrix of them."""

    def line(self, value: Any) -> str:
        """`Run(pendulum: holds, runs/pendulum-1a2b3c4d)`."""
        if value.runs:
            return f"Run({len(value.runs)} runs: {', '.join(str(r.summary['verdict']) for r in value.runs)})"
        summary, folder = value.summary, value.folder
        return f"Run({summary.get('name', folder.name)}: {summary.get('verdict', 'unfinished')}, {folder})"

    def lines(self, summary: Summary) -> Iterator[str]:
        from .words.summary import in_words

        return in_words(summary)

    def html(self, value: Any) -> str:
        """The report's first screen, small; of a matrix a row for each."""
        from gapcert_figures import Figures

        from .pages import compare
        from .pictures.album import album_of

        folder, summary = value.folder, value.summary
        if value.runs:
            every = [r.summary for r in value.runs]
            rows = [(s["name"], words.verdict(s)[0], str(s.get("reason") or "")) for s in every]
            counted = h("p", times(len(rows), "run"), class_="verdict")
            return shown([counted], "open", _short("", ("run", "verdict", "why"), rows, 3))
        word, kind, meaning = words.verdict(summary)
        said: list[object] = [_verdict(f"{summary.get('name', folder.name)}: {word.lower()}", kind)]
        parts: list[Html | None] = []
        if "certificate" in summary:
            c = summary["certificate"]
            said += [h("p", words.claim_sentence(c)), h("p", f"{words.tightness_sentence(c)} {words.loop_sentence(summary)}")]
            parts = [_states(c), _assumed(c)]
        elif "causes" in summary:
            said, parts = [said[0], *_diagnosed(summary)[0][1:]], [_causes(summary)]
        elif "pairs" in summary:
            said, parts = [said[0], *_compared(summary)[0][1:]], [_pairs(summary)]
        if summary["verdict"] in ("fails", "unknown") or len(said) == 1:
            said.append(h("p", summary.get("reason") or meaning))
        expected = summary.get("expectations", ())
        met = f"{sum(bool(e['met']) for e in expected)} of {len(expected)} expectations met. " if expected else ""
        parts.append(h("p", f"{met}Folder: {folder}", class_="note"))
        figures = Figures.load(folder) if folder.is_dir() else Figures()
        drawn = compare.hero(summary, figures) if "pairs" in summary else album_of(figures, summary).hero
        return shown(said, kind, *parts, pictures=drawn)
