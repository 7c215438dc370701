"""A run's summary in words: as lines for a terminal, and as text for viewers that show markdown."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gapcert.plugin import columns
from gapcert_closed_loop import broken_sentence

from .compare import compare_markdown, sentences, setting_name
from .diagnosis import diagnosis_markdown, numbers, refitted_named, shrunk, won_sentence
from .words import (
    Summary,
    claim_sentence,
    hidden_sentence,
    learned_sentence,
    loop_sentence,
    markdown_table,
    number,
    on_the_way,
    plain,
)


def in_words(summary: Summary) -> Iterator[str]:
    """A run's JSON summary as lines for people."""
    for one in summary.get("runs", ()):
        yield from in_words(one)
        yield ""
    if "verdict" not in summary:
        return
    yield f"{summary.get('name', 'run')}: {summary['verdict']}" + (f" ({summary['reason']})" if summary.get("reason") else "")
    yield from _certificate(summary.get("certificate", {}))
    yield from _controller(summary)
    yield from _diagnosis(summary)
    yield from _comparison(summary)
    if expectations := summary.get("expectations", []):
        met = sum(e["met"] for e in expectations)
        yield f"expectations: {met} of {len(expectations)} met"
        yield from (f"  NOT MET  {e['text']}   (found {e['value']})" for e in expectations if not e["met"])
    if "run_dir" in summary:
        folder = Path(summary["run_dir"])
        yield f"results in {folder}"
        found = [(what, folder / name) for what, name in (("report", "report.html"), ("recording", "run.rrd"))]
        yield from (f"  {what}: {path}" for what, path in found if path.exists())


def _number(value: Any) -> str:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return f"{value:.4g}"
    return "-" if value is None else str(value)


def _told_of(states: Summary) -> dict[str, str]:
    """What a table tells of each state, with its title; of a γ that nothing was compared with, that alone."""
    told = {"gap_mean": "mean gap", "gamma_mean": "mean γ", "tightness": "tightness", "constant_bound": "constant"}
    return told if any("gap_mean" in s for s in states.values()) else {"gamma_max": "declared γ"}


def _certificate(certificate: Summary) -> Iterator[str]:
    if states := certificate.get("states", {}):
        told = _told_of(states)
        rows = [[name, *(_number(s.get(k)) for k in told)] for name, s in states.items()]
        yield from ("  " + line for line in columns(("state", *told.values()), rows))
        if empty := [name for name, s in states.items() if s.get("vacuous")]:
            yield f"  vacuous for {', '.join(empty)}: a constant, or a model in which nothing moves, would do as well"
    if audit := certificate.get("audit"):
        allowed = f" (up to {audit['allowed']} are no surprise)" if "allowed" in audit else ""
        yield f"  audit: {audit.get('violations')} violations at {audit.get('points')} fresh points{allowed}"
    if made := certificate.get("recording"):
        windows = made["windows"]
        others = f"{windows['calibration']} others set it (rank {made['rank']})"
        yield f"  recording: {windows['fit']} windows made the band, {others}"
    if (hidden := certificate.get("hidden", {})).get("names"):
        yield f"  {hidden_sentence(hidden)}"
        if "bound" in hidden:
            spread = ", ".join(f"{n} by {_number(2 * b)}" for n, b in hidden["bound"].items())
            yield f"  it may move {spread} (the most that was seen, times {hidden['safety']:g})"
    if (lipschitz := certificate.get("lipschitz", {})).get("marked"):
        yield f"  jumps in {lipschitz['marked']} of {lipschitz['cells']} cells"
    yield from (f"  warning: {w}" for w in certificate.get("warnings", ()))


def _controller(summary: Summary) -> Iterator[str]:
    if controller := summary.get("controller"):
        share = f", {controller['winning_fraction']:.1%} of the volume" if controller.get("levels") else ""
        cells = f"{controller.get('winning_cells')} of {controller.get('cells')} cells win{share}"
        part = controller.get("domain_fraction")
        left = controller.get("domain_of_nominal")
        tail = "" if left is None else f" ({left:.1%} of what it would be without γ)"
        yield f"  controller: {cells if part is None else f'starts from {part:.1%} of the set to stay in'}{tail}"
    loop = summary.get("closed_loop", {})
    for key, name in (("with_gamma", "with γ"), ("without_gamma", "without γ")):
        if row := loop.get(key):
            tail = f", {late} are still on the way" if (late := on_the_way(row)) else ""
            tail += f", {row['refused']} of the starts drawn are refused" if row.get("refused") else ""
            tail += f", {row['fallbacks']} steps went on with a plan of before" if row.get("fallbacks") else ""
            yield f"  closed loop {name}: {row['violations']} of {row['starts']} runs fail{tail} (policy {row['policy']})"
    if claim := loop.get("claim"):
        tried = [r["policy"] for r in loop["policies"] if r["controller"] == "with_gamma"]
        under = f"any of {len(tried)} policies" if len(tried) > 1 else f"policy {tried[0]}"
        yield (
            f"  closed loop audit: with confidence 1 − {_number(claim['beta'])} at most {_number(claim['epsilon'])} of runs "
            f"with γ fail under {under}"
        )
    if "learned" in loop:
        yield f"  {learned_sentence(loop)}"
    ours = [r for r in loop.get("policies", ()) if r["controller"] == "with_gamma"]
    yield from (f"  {broken_sentence(r)}" for r in ours if r.get("broken_promises"))


def _comparison(summary: Summary) -> Iterator[str]:
    if "pairs" not in summary:
        return
    yield from (f"  {text}" for text in sentences(summary))
    yield from (f"  {u['backend']} is unavailable: {u['reason']}" for u in summary["unavailable"])
    keys = ("backend", "family", "lipschitz", "seed", "tightness", "samples", "cpu_s", "claim", "violations")
    rows = [[_number(r[k]) if k != "samples" else r[k] or "-" for k in keys] + [r.get("refused", "")] for r in summary["rows"]]
    if rows:
        yield ""
        yield from ("  " + line for line in columns((*keys, ""), rows))
    pairs = []
    for p in summary["pairs"]:
        named = setting_name(p["explained_by"][0]) + f" ({p['explained_by'][0]['reduction']:.1%})" if p["explained_by"] else ""
        same = p.get("refused") or ("differ" if p["resolved"] else "agree")
        pairs.append((p["a"], p["b"], _number(p["mean"]), _number(p["max"]), same, named))
    if pairs:
        yield ""
        yield from ("  " + line for line in columns(("a", "b", "mean", "max", "", "closed by"), pairs))


def _diagnosis(summary: Summary) -> Iterator[str]:
    if "causes" not in summary:
        return
    if text := summary.get("sentence"):
        yield f"  {text}"
    for cause in summary["causes"]:
        values = ", ".join(
            f"{n} = {_number(p['value'])}{'' if p['unit'] == '1' else ' ' + p['unit']}" for n, p in cause["parameters"].items()
        )
        values = next(numbers(cause))[1] if cause.get("setting") else values
        yield f"  {cause['effect']} at {cause['site']}: {values} (explains {_number(cause['explained'])})"
        yield from (f"    {flag}" for flag in cause.get("flags", ()))
    for group in summary.get("ambiguous_with", ()):
        yield "  cannot be told apart: " + ", ".join(f"{c['effect']} at {c['site']}" for c in group)
    yield from (f"  refitted: {text}" for text in refitted_named(summary))
    yield from (f"  warning: {text}" for text in summary.get("warnings", ()))
    yield from (f"  assumed: {text}" for text in summary.get("assumptions", ()))
    for name, old, new in shrunk(summary):
        yield f"  mean γ of {name}: {_number(old)} before, {_number(new)} with the causes in the model"
    if text := won_sentence(summary):
        yield f"  {text}"
    if path := summary.get("experiment_file"):
        yield f"  the input to play: {path}"


def markdown(summary: Summary) -> str:
    """The answer of a run as text, for viewers that show markdown: the verdict and its reason, then what they rest on."""
    parts = [f"# {summary['name']}: {summary['verdict']}"] if "verdict" in summary else []
    if summary.get("verdict") in ("fails", "unknown") and summary.get("reason"):
        parts.append(f"**{plain(str(summary['reason'])).rstrip('.')}.**")
    if "certificate" in summary:
        c, states = summary["certificate"], summary["certificate"]["states"]
        known = {k: title for k, title in _told_of(states).items() if any(s.get(k) is not None for s in states.values())}
        named = {n: f"{n} (vacuous)" if s.get("vacuous") else n for n, s in states.items()}
        rows = [(named[name], *(number(s.get(k), 3) for k in known)) for name, s in states.items()]
        parts += [claim_sentence(c), loop_sentence(summary), markdown_table(("state", *known.values()), rows)]
        parts += ["## Assumptions", "\n".join(f"{i}. {plain(a)}" for i, a in enumerate(c["assumptions"], 1)) or "None."]
        if "samples" in c:
            parts += [f"Transitions spent: {', '.join(f'{k} {v:,}' for k, v in c['samples'].items())}."]
    if "pairs" in summary:
        parts.append(compare_markdown(summary))
    if "causes" in summary:
        parts += diagnosis_markdown(summary)
    return "\n\n".join(p for p in parts if p) + "\n"
