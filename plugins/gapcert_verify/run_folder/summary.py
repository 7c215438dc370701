"""What a run folder says of itself, made again: its root digest, the summary, and the rows of controllers and closed loops."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gapcert.plugin import (
    Claim,
    Controller,
    beside_nominal,
    evaluate_expectations,
    nothing_won,
    order_statistics,
    outside,
)
from gapcert_cells import load_controller
from gapcert_verify.evidence import Evidence
from gapcert_verify.sentences import states

from .origin import Origin

_OWN = {"format", "form", "predictor", "domain", "arrays", "versions", "symmetry", "cover", "seed", "digests", "arithmetic"}
"""What a certificate stores beside its summary."""


def read(e: Evidence, name: str) -> dict[str, Any] | None:
    """A JSON object of the folder; None where there is no such file."""
    path = e.folder / name
    if not path.exists():
        return None
    found = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(found, dict):
        raise TypeError(f"{name} holds no object")
    return found


def root(e: Evidence) -> str | None:
    """ "" where every file that the root names is what it was, and the root is theirs."""
    stated = read(e, "root.json")
    if stated is None:
        run = not e.older and (e.folder / "summary.json").exists()
        return "root.json is missing from the folder of a run" if run else None
    files = stated["files"]
    for name, digest in files.items():
        path = e.folder / name
        if ".." in Path(name).parts or not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            return f"{name} was changed, or is missing"
    if lost := [n for n in ("spec.json", "summary.json", "certificate.json", "certificate.npz") if n not in files]:
        return f"the root does not name {lost[0]}"
    own = hashlib.sha256(json.dumps(files, sort_keys=True).encode()).hexdigest()
    return "" if stated["root"] == own else "the root is another one than that of its files"


def summary(e: Evidence, o: Origin) -> str | None:
    """ "" where the summary says of certificate, controller and verdict what follows."""
    if (told := read(e, "summary.json")) is None:
        return None
    made = {k: v for k, v in e.data.items() if k not in _OWN}
    if told["certificate"] != made:
        other = next((k for k in {**made, **told["certificate"]} if made.get(k) != told["certificate"].get(k)), "")
        return f"certificate.{other} of the summary is not that of the certificate"
    name, run = o.build.spec.config.name, Path(told["run_dir"]).name
    if told["name"] != name or run != f"{name}-{o.build.spec.digest[:8]}":
        return f"the summary is of {told['name']} in {run}, and the spec is {name}"
    if e.older:
        return _controlled(e, told) or _looped(e, told)
    known = {"name", "run_dir", "verdict", "reason", "certificate", "controller", "closed_loop", "beside", "timings"}
    if more := sorted(set(told) - known - {"expectations"}):
        return f"'{more[0]}' is no part of a summary that is known"
    if text := _controlled(e, told) or _looped(e, told):
        return text
    failures = [*_refutations(e, o, told), *_lost(e), *_loop_failures(told, e.data["claim"]["kind"])]
    verdict = ("fails", failures[0]) if failures else ("holds", reason(e))
    if (told["verdict"], told["reason"]) != verdict:
        return f"the answer is stated as '{told['verdict']}: {told['reason']}', and '{verdict[0]}: {verdict[1]}' follows"
    expect = o.build.spec.config.expect
    answers = json.loads(json.dumps(evaluate_expectations(expect, told), default=str)) if expect else None
    return "" if told.get("expectations") == answers else "expectations are answered otherwise than the summary says"


def reason(e: Evidence) -> str:
    """Why the claim holds."""
    c = e.data["claim"]
    if "recording" in e.data:
        level = f"ε = {c['epsilon']:g}" + (f", β = {c['beta']:g}" if "beta" in c else "")
        seen = f"{e.data['recording']['windows']['calibration']} windows that the fit has not seen set it"
        return f"the gap function holds at level statistical ({level}, {c['distribution']}): {seen}"
    if "audit" not in e.data:
        return "γ is declared and assumed; no simulator was asked"
    a = e.data["audit"]
    if c["kind"] == "assumed":
        return f"γ is declared and assumed; {a['points']} audited points do not refute it"
    level = c["kind"]
    if level == "statistical":
        level = f"statistical (ε = {c['epsilon']:g}, β = {c['beta']:g}, {c['distribution']})"
    head = f"the gap function holds at level {level}: "
    if made := e.data.get("calibration"):
        return (
            f"{head}{made['points']} calibration points; {a['violations']} of {a['points']} audited points lie outside, as it "
            f"allows"
        )
    return f"{head}{a['points']} audited points without a violation"


def _refutations(e: Evidence, o: Origin, told: Mapping[str, Any]) -> list[str]:
    """What refutes the claim, or keeps it from being reached, as a run tells it."""
    if "audit" not in e.data:
        return []
    a, units, out = e.data["audit"], dict(zip(e.data["domain"]["axes"], e.data["domain"]["units"], strict=True)), []
    refuted = next((s for s in e.data["assumptions"] if s.startswith("REFUTED")), "")
    if a["violations"] > a.get("allowed", 0):
        w = a["witness"]
        at = ", ".join(f"{n} = {v:.4g}{_unit(units[n])}" for n, v in zip(e.data["domain"]["axes"], w["z"], strict=True))
        state = states(e)[w["state"]]
        out.append(
            f"the audit refutes the gap function: {a['violations']} of {a['points']} points; at {at} the residual of {state} "
            f"is {w['residual']:.6g}{_unit(units[state])}, {outside(w)}"
        )
    if (h := e.data.get("hidden", {}).get("attack", {})) and (w := h.get("witness")):
        out.append(
            f"γ of the default hidden state does not hold for others: {h['violations']} of {h['points']} probes exceed it; at "
            f"(x, u) = {w['z']} with hidden state {w['hidden']} the residual of {w['state']} is {w['residual']:.6g}, and γ is "
            f"{w['gamma']:.6g}"
        )
    if (further := e.data.get("attack")) and further["violations"] > further.get("allowed", 0):
        out.append(f"{further['violations']} of {further['points']} further fresh points leave [l, u]")
    asked = o.build.spec.config.certificate
    if asked is not None and asked.claim != e.data["claim"]["kind"] and not out:
        out.append(f"a {asked.claim} claim was asked for: {refuted or 'its evidence does not allow it'}")
    elif refuted and not out:
        out.append(refuted)
    return out


def _unit(unit: str) -> str:
    return "" if unit in ("", "1") else f" {unit}"


def controllers(e: Evidence) -> dict[str, Controller]:
    where = e.folder / "controller"
    names = [n for n in ("with_gamma", "without_gamma") if (where / n / "controller.json").is_file()]
    return {n: load_controller(where / n) for n in names}


def _lost(e: Evidence) -> list[str]:
    controller = controllers(e).get("with_gamma")
    nothing = controller is not None and (not controller.wins or "reason" in controller.evidence)
    return [nothing_won(controller.evidence)] if nothing and controller is not None else []


def _controlled(e: Evidence, told: Mapping[str, Any]) -> str:
    """The row of the controller, of what both saved ones say."""
    made, stated = controllers(e), told.get("controller")
    if len(made) < 2:
        return "a controller is told of, and none is stored" if stated else ""
    if any((read(e, f"controller/{name}/controller.json") or {}).get("format", 1) != 1 for name in made):
        return "a controller is of a format that is not known"
    careful, trusting = made["with_gamma"], made["without_gamma"]
    kind = e.data["claim"]["kind"]
    carried = Claim(kind) if kind in ("deterministic", "assumed") else Claim("empirical")
    if careful.evidence.get("assumptions") and carried.kind != "assumed":
        carried = Claim("empirical")
    facts, other = careful.facts(), trusting.facts()
    said = {"kind": careful.kind, "claim": carried.summary(), **facts, **beside_nominal(facts, other)}
    said = json.loads(json.dumps(said, default=str))
    if stated == said:
        return ""
    wrong = next((k for k in {**said, **(stated or {})} if said.get(k) != (stated or {}).get(k)), "")
    return f"controller.{wrong} of the summary is not that of the saved controllers"


def _looped(e: Evidence, told: Mapping[str, Any]) -> str:
    """The closed loop's rows agree with each other, and with the runs that are stored."""
    if (loop := told.get("closed_loop")) is None:
        return ""
    with np.load(e.folder / "closed_loop.npz", allow_pickle=False) as stored:
        runs = {name: (stored[f"{name}_u"].shape[:2], int(stored[f"{name}_broken"].sum())) for name in _BOTH}
    for name in _BOTH:
        rows = [{k: v for k, v in r.items() if k != "controller"} for r in loop["policies"] if r["controller"] == name]
        head = loop[name]
        if head not in rows or (head["starts"], head["steps"]) != runs[name][0] or head["broken_promises"] != runs[name][1]:
            return f"closed_loop.{name} is not what its policies and the stored runs say"
        if any(not 0 <= r[k] <= r["starts"] for r in rows for k in ("violations", "stranded", "left_goal")):
            return f"closed_loop.{name} counts more runs than there are"
    if claim := loop.get("claim"):
        ours = [r for r in loop["policies"] if r["controller"] == "with_gamma"]
        least, most = max(r["violations"] for r in ours), sum(r["violations"] for r in ours)
        if claim["runs"] != ours[0]["starts"] or not least <= claim["violations"] <= most or _small(claim):
            return "the claim of the closed loop is not what its runs earn"
    return ""


_BOTH = ("with_gamma", "without_gamma")


def _small(claim: Mapping[str, Any]) -> bool:
    """Is ε smaller than the runs allow?"""
    return bool(order_statistics.missed(claim["violations"], claim["runs"], claim["epsilon"]) > claim["beta"])


def _loop_failures(told: Mapping[str, Any], claim: str) -> list[str]:
    rows = [p for p in told.get("closed_loop", {}).get("policies", ()) if p["controller"] == "with_gamma"]
    bad = [p for p in rows if p["violations"]]
    out = [f"closed loop with γ: {p['violations']} of {p['starts']} runs fail under policy '{p['policy']}'" for p in bad]
    broken = [p for p in rows if p.get("broken_promises") and claim in ("deterministic", "assumed")]
    return out + [_broken(p) for p in broken]


def _broken(row: Mapping[str, Any]) -> str:
    text = f"closed loop with γ: {row['broken_promises']} steps under policy '{row['policy']}' break the controller's promise"
    parts = {"gap": "γ, the residual being outside [l, u]", "bound": "the bound of the model's successors"}
    found = [f"{n} refute {parts[cause]}" for cause, n in row.get("refuted", {}).items() if n]
    return f"{text}: {' and '.join(found)}" if found else text


def whole_run(e: Evidence) -> str | None:
    """ "" where the folder of a run holds its spec, and all of it is of one format."""
    if e.data.get("format", 2) != 2:
        return f"the certificate is of format {e.data['format']}, and 2 is known"
    if e.older and ((e.folder / "root.json").exists() or {"units", "period"} & set(e.data["domain"]) or "arithmetic" in e.data):
        return "the certificate is of no format, and what it holds is of format 2"
    if not (e.folder / "summary.json").exists():
        return None
    lost = [n for n in ("spec.json", "run.json", "figures.json") if not (e.folder / n).exists()]
    return f"{lost[0]} is missing from the folder of a run" if lost else ""
