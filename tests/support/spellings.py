"""Drawn questions as specs, edits that mean nothing, and edits that mean something: for attacks on the book of audits."""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gapcert as gc
from gapcert.certification.fingerprint import Fingerprint
from gapcert.certification.gates.augment import widen
from gapcert.run.build import Build

Spec = dict[str, Any]
Draws = np.random.Generator
UNITS = {"rad": ("deg", 180 / np.pi), "1": ("1", 1.0)}
WORD = r"\b{}\b"


def drawn(rng: Draws) -> Spec:
    """A plant of one to four states and up to three inputs, and a simulator of it with up to three further terms."""
    states, inputs = (
        [f"{letter}{k}" for k in range(n)] for letter, n in (("x", rng.integers(1, 5)), ("u", rng.integers(0, 4)))
    )
    axes = [*states, *inputs]
    unit = {name: str(rng.choice(list(UNITS))) for name in axes}
    same = [float(v) for v in np.round(rng.uniform(0.2, 3, 2), 2)]
    f = {s: sum_of([f"{s}", *(term(rng, axes) for _ in range(rng.integers(1, 3)))]) for s in states}
    fhat = {s: sum_of([text, *(term(rng, axes, 0.05) for _ in range(rng.integers(0, 3)))]) for s, text in f.items()}
    # Half of the ranges are equal, so that their order tells nothing.
    ranges = {
        n: [-same[0], same[0]] if rng.random() < 0.5 else sorted(np.round(rng.uniform(-4, 4, 2), 3).tolist()) for n in axes
    }
    spec = {
        "version": 1,
        "name": "drawn",
        "model": system(states, inputs, unit, f),
        "backend": system(states, inputs, unit, fhat),
        "domain": {n: r if r[1] - r[0] > 0.1 else [-1.0, 1.0] for n, r in ranges.items()},
    }
    pairs = [(a, b) for a, b in itertools.pairwise(axes) if unit[a] == unit[b]]
    if rng.random() < 0.3 and pairs:
        a, b = pairs[0]
        centre = sum(sum(spec["domain"][n]) / 2 for n in (a, b))
        width = sum(spec["domain"][n][1] - spec["domain"][n][0] for n in (a, b))
        spec["relations"] = [f"{a} + {b} <= {centre + width / 4:.6g} {unit[a]}".removesuffix(" 1")]
    return spec


def system(states: list[str], inputs: list[str], unit: dict[str, str], following: dict[str, str]) -> Spec:
    """As a section; numbers and angles, so that any product may be added to any state."""
    return {
        "kind": "equations",
        "states": {s: unit[s] for s in states},
        "inputs": {u: unit[u] for u in inputs},
        "next": {s: following[s] for s in states},
        "period": "0.1 s",
    }


def term(rng: Draws, axes: list[str], size: float = 0.5) -> str:
    a, b = rng.choice(axes, 2)
    forms = (f"{a}", f"{a}*{b}", f"sin({a})", f"{a}*abs({b})", f"{a}**3", f"cos({a} + {b})", f"exp(-{a}**2)", f"tanh(2*{a})")
    return f"{float(np.round(size * rng.uniform(0.1, 1), 3))}*{rng.choice(forms)}"


def sum_of(terms: list[str]) -> str:
    return " + ".join(terms)


def asked(spec: Spec) -> Fingerprint:
    build = Build(gc.load_spec(spec), "threads", Path(), False)
    model = build.make("model")
    backend, domain = build.against(model)
    model, backend = widen(model, backend, domain)
    return Fingerprint(model, backend, domain)


def texts(spec: Spec, change: Callable[[str], str]) -> None:
    """All texts of both systems, and relations, changed."""
    for part in (spec["model"], spec["backend"]):
        part["next"] = {s: change(text) for s, text in part["next"].items()}


def renamed(spec: Spec, rng: Draws) -> None:
    names = [*spec["model"]["states"], *spec["model"]["inputs"]]
    new = dict(
        zip(names, rng.permutation([f"{w}_{k}" for k, w in enumerate("abcdefghijk"[: len(names)])]).tolist(), strict=True)
    )

    def changed(text: str) -> str:
        return re.sub("|".join(WORD.format(n) for n in names), lambda m: new[m[0]], text)

    for part in (spec["model"], spec["backend"]):
        for key in ("states", "inputs"):
            part[key] = {new[n]: unit for n, unit in part[key].items()}
        part["next"] = {new[s]: changed(text) for s, text in part["next"].items()}
    spec["domain"] = {new[n]: r for n, r in spec["domain"].items()}
    if "relations" in spec:
        spec["relations"] = [changed(r) for r in spec["relations"]]


def shuffled(values: dict[str, Any], rng: Draws) -> dict[str, Any]:
    return {k: values[k] for k in rng.permutation(list(values)).tolist()} if values else values


def reordered(spec: Spec, rng: Draws) -> None:
    for key in ("states", "inputs"):
        spec["model"][key] = shuffled(spec["model"][key], rng)
        spec["backend"][key] = {n: spec["backend"][key][n] for n in spec["model"][key]}
    for part in (spec["model"], spec["backend"]):
        part["next"] = shuffled(part["next"], rng)
    spec["domain"] = shuffled(spec["domain"], rng)


def in_other_units(spec: Spec, rng: Draws) -> None:
    unit = {**spec["model"]["states"], **spec["model"]["inputs"]}
    for name, ends in spec["domain"].items():
        other, factor = UNITS[unit[name]]
        if rng.random() < 0.7 and not isinstance(ends[0], str):
            spec["domain"][name] = [f"{v * factor!r} {other}".removesuffix(" 1") for v in ends]
    spec["backend"]["period"] = "100 ms"


def rewritten(spec: Spec, rng: Draws) -> None:
    """By computer algebra, or by hand: the same numbers but for their last bits."""
    import sympy

    def changed(text: str) -> str:
        names = {n: sympy.Symbol(n, real=True) for n in (*spec["model"]["states"], *spec["model"]["inputs"], "spare")}
        e = sympy.sympify(text, locals={**names, "abs": sympy.Abs})
        ways = (
            lambda: str(sympy.nsimplify(e, rational=True)),
            lambda: str(sympy.expand(3 * e) / 3),
            lambda: f"({text})*2/2",
            lambda: f"1.5*({text}) - 0.5*({text})",
            lambda: str(sympy.Add(*reversed(sympy.Add.make_args(e)), evaluate=False)),
            lambda: f"({text}) + 0",
            lambda: re.sub(r"(\w+)\*\*2", r"\1*\1", text),
        )
        way = ways[int(rng.integers(len(ways)))]
        return way().replace("Abs(", "abs(")

    texts(spec, changed)


def with_parameters(spec: Spec, rng: Draws) -> None:
    for part in (spec["model"], spec["backend"]):
        found = sorted(set(re.findall(r"(?<![\w.*])\d+\.\d+(?=\*)", " ".join(part["next"].values()))))[
            : int(rng.integers(1, 4))
        ]
        part.setdefault("parameters", {}).update({f"k{part['period'][0]}{k}_": float(v) for k, v in enumerate(found)})
        for k, v in enumerate(found):
            part["next"] = {
                s: re.sub(rf"(?<![\w.*]){re.escape(v)}(?=\*)", f"k{part['period'][0]}{k}_", text)
                for s, text in part["next"].items()
            }


def with_idle(spec: Spec, rng: Draws) -> None:
    """A parameter, an input and a state that nothing needs, and a relation that always holds."""
    name = f"spare{rng.integers(1000)}"
    for part in (spec["model"], spec["backend"]):
        part.setdefault("parameters", {})[f"p_{name}"] = float(rng.random())
    kind = rng.integers(3)
    if kind == 0:
        for part in (spec["model"], spec["backend"]):
            part["inputs"] = {**part["inputs"], name: "1"}
        spec["domain"][name] = [-1.0, float(rng.uniform(0, 3))]
    if kind == 1:
        for part in (spec["model"], spec["backend"]):
            part["states"] = {name: "1", **part["states"]}
            part["next"] = {**part["next"], name: name}
        spec["domain"][name] = [-1.0, float(rng.uniform(0, 3))]
    if kind == 2:
        first = next(iter(spec["model"]["states"]))
        unit = spec["model"]["states"][first]
        spec["relations"] = [*spec.get("relations", []), f"{first} <= 1000 {unit}".removesuffix(" 1")]


def elsewhere(spec: Spec, rng: Draws) -> None:
    """Another name, seed and family, and a range that differs in its last digits."""
    spec |= {"name": f"other{rng.integers(1000)}", "seed": int(rng.integers(1000)), "gap": {"kind": "constant"}}
    name = str(rng.choice(list(spec["domain"])))
    ends = spec["domain"][name]
    if not isinstance(ends[0], str):
        spec["domain"][name] = [ends[0], ends[1] + 1e-11 * (ends[1] - ends[0]) * float(rng.uniform(-1, 1))]


MEANINGLESS = (renamed, reordered, in_other_units, rewritten, with_parameters, with_idle, elsewhere)


def respelled(spec: Spec, rng: Draws, edits: int) -> tuple[Spec, list[str]]:
    """The same question after so many drawn edits, and which these were."""
    spec, told = copy.deepcopy(spec), []
    for k in rng.choice(len(MEANINGLESS), edits, replace=False):
        MEANINGLESS[k](spec, rng)
        told.append(MEANINGLESS[k].__name__)
    return spec, told


def another(spec: Spec, rng: Draws) -> Spec:
    """Another plant, simulator or domain; by how much is drawn over ten decades."""
    spec, size = copy.deepcopy(spec), float(10 ** rng.uniform(-10, 0))
    states, axes = list(spec["model"]["states"]), list(spec["domain"])
    state, kind = str(rng.choice(states)), rng.integers(4)
    if kind == 0:
        name = str(rng.choice(axes))
        low, high = spec["domain"][name]
        spec["domain"][name] = [low, high + (high - low) * max(size, 1e-7)]
    else:
        parts = ("backend",) if kind < 3 else ("model", "backend")
        more = f" + {size!r}*{term(rng, axes, 1.0)}"
        for part in parts:
            spec[part]["next"][state] += more
    return spec
