"""`gapcert runs compare`: what differs between the specs of runs, and which figures changed by more than their noise."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, final

from gapcert.plugin import Answer, Arguments, RunFolder, UsageError, columns, figure, leaves, stored

from .listing import entry

Change = Literal["same", "noise", "changed"]
EXACT = 1e-9  # relative: figures without noise differ by rounding at most
CLOCK = 0.25  # relative: how far two timings of the same work lie apart on a machine that does other things, too
TICK = 1.0  # seconds below which timings are not told apart


@final
@dataclass(frozen=True)
class Figure:
    """One figure of a run. `noise(other)` says whether a difference from another run's may be chance."""

    value: Any
    noise: Callable[[Any], bool] = lambda other: False
    spread: tuple[float, float] | None = None


def command(options: Arguments) -> Answer:
    if len(options.runs) < 2:
        raise UsageError("gapcert runs compare: one run folder was given; expected two or more")
    told = compare([RunFolder.at(path) for path in options.runs])
    return Answer(told, in_words(told, options.all))


def compare(runs: Sequence[RunFolder]) -> dict[str, Any]:
    """Runs side by side, each against the first."""
    found = [dict(figures(r)) for r in runs]
    names = list(dict.fromkeys(name for one in found for name in one))
    made = [_versions(r) for r in runs]
    return {
        "runs": [entry(r) for r in runs],
        "spec": differences([r.spec for r in runs]),
        "versions": [{"package": p, "values": [m.get(p) for m in made]} for p in sorted({k for m in made for k in m})],
        "same_samples": _samples(runs),
        "figures": [
            {
                "figure": name,
                "values": [one[name].value if name in one else None for one in found],
                "change": [change(found[0].get(name), one.get(name)) for one in found[1:]],
            }
            for name in names
        ],
    }


def differences(specs: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Paths at which specs differ, with the value of each; null where one has none."""
    flat = [dict(leaves(s)) for s in specs]
    paths = sorted({p for f in flat for p in f})
    return [{"path": p, "values": [f.get(p) for f in flat]} for p in paths if any(f.get(p) != flat[0].get(p) for f in flat)]


def change(a: Figure | None, b: Figure | None) -> Change:
    """Whether b is another figure than a."""
    if a is None or b is None:
        return "changed"
    if a.value == b.value or (_number(a.value) and _number(b.value) and math.isclose(a.value, b.value, rel_tol=EXACT)):
        return "same"
    if a.spread is not None and b.spread is not None:
        return "noise" if a.spread[0] <= b.spread[1] and b.spread[0] <= a.spread[1] else "changed"
    alike = _number(a.value) and _number(b.value) and (a.noise(b.value) or b.noise(a.value))
    return "noise" if alike else "changed"


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def figures(run: RunFolder) -> Iterator[tuple[str, Figure]]:
    """Name and figure of everything that a run found, under the paths of its JSON summary."""
    s = run.summary
    if not s:
        return
    yield "verdict", Figure(s.get("verdict"))
    yield from _certified(s.get("certificate", {}), "certificate")
    for part in ("before", "after"):
        yield from _certified(s.get("recertified", {}).get(part, {}), f"recertified.{part}")
    for name in ("winning_fraction", "winning_cells", "domain_fraction", "domain_of_nominal"):
        if (value := s.get("controller", {}).get(name)) is not None:
            yield f"controller.{name}", Figure(value)
    for who in ("with_gamma", "without_gamma"):
        if (row := s.get("closed_loop", {}).get(who)) is not None:
            yield f"closed_loop.{who}.violations", Figure(row["violations"], _chance(row["violations"]))
    yield from _diagnosed(s)
    yield from _compared(s)
    for name, value in s.get("timings", {}).items():
        yield f"timings.{name}", Figure(value, _clock(value))


def _certified(c: Mapping[str, Any], at: str) -> Iterator[tuple[str, Figure]]:
    if "claim" not in c:
        return
    yield f"{at}.claim", Figure(c["claim"]["kind"])
    points = c.get("audit", {}).get("points") or 0
    for state, told in c.get("states", {}).items():
        # The largest γ over an audit's points says more about these than about γ.
        for name in ("tightness", "gamma_mean", "gap_mean") if "gap_mean" in told else ("gamma_max",):
            if told.get(name) is not None:
                yield f"{at}.states.{state}.{name}", Figure(told[name], _mean(told[name], points))
    for name, n in c.get("samples", {}).items():
        yield f"{at}.samples.{name}", Figure(n)
    if "violations" in c.get("audit", {}):
        yield f"{at}.audit.violations", Figure(c["audit"]["violations"], _chance(c["audit"]["violations"]))


def _diagnosed(s: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    if "causes" not in s:
        return
    yield "causes", Figure(", ".join(sorted(f"{c['effect']} at {c['site']}" for c in s["causes"])) or "none")
    for c in s["causes"]:
        at = f"causes.{c['effect']}.{c['site']}"
        yield f"{at}.explained", Figure(c["explained"], _share(c["explained"]))
        for name, p in c["parameters"].items():
            yield f"{at}.{name}", Figure(p["value"], spread=(p["low"], p["high"]))
    for channel, r in s.get("residual", {}).items():
        yield f"residual.{channel}.after", Figure(r["after"])


def _compared(s: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    for p in s.get("pairs", ()):
        at = f"pairs.{p['a']}.{p['b']}"
        yield f"{at}.mean", Figure(p["mean"])
        yield f"{at}.explained_by", Figure(p["explained_by"][0]["setting"] if p["explained_by"] else "nothing")
    for r in s.get("rows", ()):
        yield f"rows.{r['backend']}.{r['family']}.{r['lipschitz']}.{r['seed']}.tightness", Figure(r["tightness"])


def _mean(own: float, points: int) -> Callable[[Any], bool]:
    """Means of two audits, each over n points whose spread is about their mean: three standard errors of the difference."""
    limit = 3 * math.sqrt(2 / points) if points else 0.0
    return lambda other: bool(abs(other - own) <= limit * abs(own))


def _chance(own: int) -> Callable[[Any], bool]:
    """Two counts of rare events differ by chance by up to twice the square root of their sum."""
    return lambda other: bool(abs(other - own) <= 2 * math.sqrt(other + own))


def _share(own: float) -> Callable[[Any], bool]:
    """Shares of an error, of which no more than whole percent are told."""
    return lambda other: bool(abs(other - own) < 0.01)


def _clock(own: float) -> Callable[[Any], bool]:
    return lambda other: bool(abs(other - own) <= max(TICK, CLOCK * max(own, other)))


def _versions(run: RunFolder) -> dict[str, str]:
    """Of what made the certificate, and of Gapcert where there is none."""
    told = next((line["version"] for line in reversed(run.standing.lines) if line["event"] == "run-started"), None)
    own = {} if told is None else {"gapcert": str(told)}
    return own | dict((stored(run.path, "certificate.json") or {}).get("versions", {}))


def _samples(runs: Sequence[RunFolder]) -> bool | None:
    """Whether all rest on the same samples, bit for bit; None where one has none."""
    certificates = [(stored(r.path, "certificate.json") or {}).get("digests") for r in runs]
    found = [c or r.summary.get("digest") for c, r in zip(certificates, runs, strict=True)]
    return None if not all(found) else all(f == found[0] for f in found)


def in_words(told: Mapping[str, Any], everything: bool = False) -> Iterator[str]:
    """A comparison for people; figures that are the same only where `everything` is asked for."""
    names = [Path(r["run_dir"]).name for r in told["runs"]]
    if len(set(names)) < len(names):
        names = [r["run_dir"] for r in told["runs"]]
    yield f"{names[0]} against {', '.join(names[1:])}"
    for i, (name, r) in enumerate(zip(names, told["runs"], strict=True)):
        if r["state"] != "finished":
            old = any(f["values"][i] is not None for f in told["figures"])
            yield f"  {name} is {r['state']}: " + ("its figures are of before" if old else "it has no figures to compare yet")
    if told["same_samples"] is not None:
        yield "  the samples are the same, bit for bit" if told["same_samples"] else "  the samples are others"
    yield from _block("spec", [(d["path"], *map(_short, d["values"])) for d in told["spec"]], names, "the specs are the same")
    apart = [v for v in told["versions"] if len(set(v["values"])) > 1]
    yield from _block(
        "version of", [(v["package"], *map(_short, v["values"])) for v in apart], names, "the versions are the same"
    )
    shown = [f for f in told["figures"] if everything or set(f["change"]) != {"same"}]
    rows = [(f["figure"], *map(_short, f["values"]), _judged(f["change"])) for f in shown]
    yield from _block("figure", rows, [*names, ""], "all figures are the same")


def _block(head: str, rows: Sequence[Sequence[str]], names: Sequence[str], none: str) -> Iterator[str]:
    yield ""
    if rows:
        yield from ("  " + line for line in columns((head, *names), rows))
    else:
        yield f"  {none}"


def _judged(changes: Sequence[Change]) -> str:
    return "changed" if "changed" in changes else "within noise" if "noise" in changes else ""


def _short(value: Any) -> str:
    text = "–" if value is None else figure(value) if _number(value) else value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= 48 else text[:47] + "…"
