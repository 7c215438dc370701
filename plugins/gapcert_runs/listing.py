"""`gapcert runs list`: a table of run folders."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from gapcert.plugin import Answer, Arguments, RunFolder, columns, duration, figure, folders

ORDERS: dict[str, Callable[[RunFolder], Any]] = {
    "age": lambda r: -r.changed,
    "name": lambda r: (r.name, r.path.name),
    "kind": lambda r: r.kind,
    "state": lambda r: (r.standing.state, r.standing.verdict or ""),
    "size": lambda r: -r.size,
    "seconds": lambda r: -(r.seconds or 0.0),
}
"""What a list may be sorted by; figures have the largest first, and age the youngest."""


def chosen(out: Path, names: Sequence[str] = (), states: Sequence[str] = (), order: str = "age") -> list[RunFolder]:
    """Those whose name or folder matches one of some patterns, and whose state or verdict is one of some words."""
    found = [r for r in folders(out) if not names or any(fnmatch(n, p) for n in (r.name, r.path.name) for p in names)]
    if states:
        found = [r for r in found if {r.standing.state, r.standing.verdict} & set(states)]
    return sorted(found, key=ORDERS[order])


def entry(run: RunFolder, now: float | None = None) -> dict[str, Any]:
    """One row, for machines."""
    s, summary = run.standing, run.summary if run.standing.state == "finished" else {}
    expectations = summary.get("expectations", [])
    return {
        "run_dir": str(run.path),
        "name": run.name,
        "kind": run.kind,
        "state": s.state,
        "verdict": s.verdict,
        "exit_code": s.exit_code,
        "reason": s.reason or summary.get("reason"),
        "owner": None if s.owner is None else {k: s.owner[k] for k in ("pid", "place") if k in s.owner},
        "stage": s.stage if s.state != "finished" else None,
        "share": s.share if s.state != "finished" else None,
        "age_s": round((time.time() if now is None else now) - run.changed, 1),
        "size_bytes": run.size,
        "seconds": None if run.seconds is None else round(run.seconds, 1),
        "headline": headline(summary),
        "expectations": {"met": sum(e["met"] for e in expectations), "of": len(expectations)} if expectations else None,
    }


def table(rows: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """The rows as lines for people."""
    head = ("run", "kind", "state", "age", "size", "took", "expected", "found")
    cells = [
        (
            Path(r["run_dir"]).name,
            r["kind"],
            condition(r),
            duration(r["age_s"]).rsplit(" ", 2)[0] if r["age_s"] >= 60 else duration(r["age_s"]),
            sized(r["size_bytes"]),
            duration(r["seconds"]),
            "" if r["expectations"] is None else f"{r['expectations']['met']} of {r['expectations']['of']}",
            r["headline"] or ((r["reason"] or "").partition("\n")[0] if r["state"] == "failed" else ""),
        )
        for r in rows
    ]
    yield from (line if len(line) <= 200 else line[:199] + "…" for line in columns(head, cells))


def condition(row: Mapping[str, Any]) -> str:
    """`holds`; `running, sampling bound-0 40 % (process 4711)`; `interrupted, audit`; `failed`."""
    if row["state"] == "finished":
        return row["verdict"] or "finished"
    at = row["stage"] + (f" {row['share']:.0%}" if row["share"] is not None else "") if row["stage"] else ""
    who = f" (process {row['owner']['pid']})" if row["owner"] else ""
    return f"{row['state']}{f', {at}' if at and row['state'] != 'failed' else ''}{who}"


def sized(size: float) -> str:
    """`812 B`, `3.4 MB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.0f} {unit}" if unit == "B" or size >= 100 else f"{size:.1f} {unit}"
        size /= 1000
    return f"{size:.1f} TB"


def headline(summary: Mapping[str, Any]) -> str:
    """The figures that one looks for first: tightness and claim; causes and what they explain; who differs."""
    if "causes" in summary:
        named = [f"{c['effect']} at {c['site']}" + _explained(c) for c in summary["causes"]]
        return "; ".join(named) or "no cause"
    if "pairs" in summary:
        differ = summary.get("differ", {})
        return f"{differ.get('pairs', 0)} of {len(summary['pairs'])} pairs differ, {differ.get('explained', 0)} explained"
    told = list(_certified(summary.get("certificate", {})))
    if (controller := summary.get("controller")) is not None:
        share = controller.get("winning_fraction", controller.get("domain_fraction"))
        told.append(f"{controller['kind']} wins" + (f" {share:.0%}" if share is not None else ""))
    if (loop := summary.get("closed_loop", {}).get("with_gamma")) is not None:
        told.append(f"{loop['violations']} of {loop['starts']} runs fail")
    return ", ".join(told)


def _explained(cause: Mapping[str, Any]) -> str:
    share = cause.get("explained")
    return f" {share:.0%}" if isinstance(share, float) else ""


def _certified(certificate: Mapping[str, Any]) -> Iterator[str]:
    if not certificate:
        return
    yield str(certificate["claim"]["kind"])
    states = certificate.get("states", {}).items()
    if tight := {n: s["tightness"] for n, s in states if s.get("tightness") is not None}:
        worst = max(tight, key=lambda n: tight[n])
        yield f"γ {tight[worst]:.3f} × the gap" + (f" of {worst}" if len(tight) > 1 else "")
    elif largest := {n: s["gamma_max"] for n, s in states if s.get("gamma_max") is not None}:
        yield "γ ≤ " + ", ".join(f"{figure(v)} for {n}" for n, v in largest.items())


def command(options: Arguments) -> Answer:
    rows = [entry(r) for r in chosen(options.out, options.name, options.state, options.sort)]
    none = f"no run folders in {options.out}" + (" that match" if options.name or options.state else "")
    return Answer(rows, table(rows) if rows else [none])
