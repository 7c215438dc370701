"""Why a mecanum base falls behind p + τ u, engine by engine: the causes that a diagnosis names, and what is left with them.

Every base is diagnosed from rest (a pause after every command) and in motion. `--write` renews
docs/benchmarks/mecanum_causes.md. An engine that is not installed is left out. `--runs` tabulates finished runs instead (of
specs/mecanum.yaml and specs/mecanum_lag.yaml, or of specs/diagnose/mecanum.yaml): γ and the closed loop, before and after; with
`--write` docs/benchmarks/mecanum_certified.md.
"""

from __future__ import annotations

import argparse
import copy
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import harness

import gapcert

ROOT = Path(__file__).resolve().parent.parent
WHY, SMALL = ROOT / "specs/diagnose/mecanum.yaml", ROOT / "specs/diagnose/mecanum_mujoco.yaml"
ENGINES = ROOT / "specs/mecanum_engines.yaml"
PERIOD = "0.3"
HEADER = ("base", "commands / (m/s)", "experiment", "causes", "gap rms / mm", "with them / mm", "ratio")
CERTIFIED = (
    "mean gap of px / mm",
    "mean γ of px / mm",
    "mean γ of vx / (mm/s)",
    "violations in the audit",
    "winning cells",
    "hits without γ",
    "hits with γ",
)
PLAIN = ("hidden", "sampling", "lipschitz", "gap", "certificate", "expect", "backend")


def questions(names: list[str]) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """(base, commands, experiment, spec): every base of mecanum_engines.yaml, the one that mecanum.yaml steers, and barrels."""
    asked = gapcert.load_spec(WHY).data
    asked = {k: v for k, v in asked.items() if k not in PLAIN} | {"report": {"html": False, "rerun": False}}
    compare = gapcert.load_spec(ENGINES)
    assert "compare" in compare.config.sections
    small = gapcert.load_spec(SMALL).data
    bases = [("mujoco-surface", "0.25", small["reality"], small["domain"], small["relations"])] + [
        (name, "1", _turned(section), asked["domain"], asked["relations"])
        for name, section in compare.data["compare"]["backends"].items()
        if name not in compare.config.sections["compare"].unavailable
    ]
    # Driven as rollers are.
    bases += [
        (name.replace("rollers", "barrels"), most, {**reality, "robot": reality["robot"].replace("rollers", "barrels")}, *rest)
        for name, most, reality, *rest in bases
        if "rollers" in name
    ]
    for name, most, reality, domain, relations in bases:
        if names and name not in names:
            continue
        reality = {**reality, "robot": str(ROOT / "specs/models/mecanum" / Path(reality["robot"]).name)}
        for experiment, pause in (("from rest", "0.6 s"), ("in motion", 0)):
            spec = {**asked, "name": "why", "reality": reality, "domain": domain, "relations": relations}
            yield name, most, experiment, {**spec, "play": {**asked["play"], "pause": pause}}


def _turned(section: dict[str, Any]) -> dict[str, Any]:
    """A backend's section with commands along the rollers' axes, (1, ±1)/√2."""
    out = {k: v for k, v in copy.deepcopy(section).items() if k != "period"} | {"inputs": {"ua": "drive", "ub": "drive"}}
    for element in out["drive"]["elements"].values():
        ux, uy = element.pop("ux"), element.pop("uy")
        element["ua" if ux * uy > 0 else "ub"] = math.sqrt(2) * ux
    return out


def row(base: str, most: str, experiment: str, spec: dict[str, Any]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as out:
        told = gapcert.run(spec, out=out).summary
    gains = told["gain"][PERIOD].values()
    before, after = (1e3 * math.sqrt(sum(g[k] ** 2 for g in gains) / len(gains)) for k in ("before", "after"))
    causes = [
        {"effect": c["effect"], "site": c["site"], **{k: [p["value"], p["unit"]] for k, p in c["parameters"].items()}}
        for c in told["causes"]
    ]
    head = {"base": base, "commands": most, "experiment": experiment, "verdict": told["verdict"]}
    return {**head, "causes": causes, "before": before, "after": after}


def _words(r: dict[str, Any]) -> str:
    found: dict[str, list[str]] = {}
    for c in r["causes"]:
        numbers = ", ".join(f"{v[0]:.4g} {v[1]}" for k, v in c.items() if k not in ("effect", "site"))
        found.setdefault(c["effect"], []).append(f"{c['site']} {numbers.replace('m/s/(s)', 'm/s²').removesuffix(' 1')}")
    named = "; ".join(f"{effect}: {', '.join(numbers)}" for effect, numbers in found.items()) or "none"
    return named if r["verdict"] == "causes" else f"{named} ({r['verdict']})"


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| " + " | ".join(HEADER) + " |", "| --- | ---: | --- | --- | ---: | ---: | ---: |"]
    for r in rows:
        numbers = f"{r['before']:.1f} | {r['after']:.3g} | {r['before'] / r['after']:.3g}"
        lines.append(f"| {r['base']} | {r['commands']} | {r['experiment']} | {_words(r)} | {numbers} |")
    return "\n".join(lines)


def certified(folders: list[Path]) -> str:
    """γ and the closed loop of finished runs, one row per certificate."""
    lines = ["| run | " + " | ".join(CERTIFIED) + " |", "| --- |" + " ---: |" * len(CERTIFIED)]
    for folder in folders:
        told = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        again = told.get("recertified")
        found = {told["name"]: told["certificate"]} if again is None else {f"{told['name']}, {k}": c for k, c in again.items()}
        for name, certificate in found.items():
            states = certificate["states"]
            mm = [f"{1e3 * states['px'][k]:.3g}" for k in ("gap_mean", "gamma_mean")]
            speed = f"{1e3 * states['vx']['gamma_mean']:.3g}" if "vx" in states else ""
            cells = f"{100 * told['controller']['winning_fraction']:.1f} %" if "controller" in told else ""
            loops = told.get("closed_loop", {})
            hits = [str(loops[k]["left_goal"]) if k in loops else "" for k in ("without_gamma", "with_gamma")]
            audit = str(certificate["audit"]["violations"]) if certificate.get("audit") else ""
            lines.append("| " + " | ".join([name, *mm, speed, audit, cells, *hits]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bases", nargs="*", metavar="BASE", help="names in specs/mecanum_engines.yaml; all that are installed")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--write", action="store_true", help="renew the documentation's table")
    parser.add_argument("--runs", nargs="+", type=Path, metavar="FOLDER", help="tabulate finished runs instead")
    options = parser.parse_args()
    here = harness.machine()
    if options.runs:
        text = f"{certified(options.runs)}\n"
        print(text, end="")
        if options.write:
            (ROOT / "docs/benchmarks/mecanum_certified.md").write_text(text, encoding="utf-8")
        return
    rows = [row(*question) for question in questions(options.bases)]
    text = f"{', '.join(f'{k}: {v}' for k, v in here.items())}\n\n{table(rows)}\n"
    print(json.dumps({"machine": here, "rows": rows}, indent=2) if options.json else text, end="")
    if options.write:
        (ROOT / "docs/benchmarks/mecanum_causes.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
