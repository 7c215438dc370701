"""Small specs with controllers on cells of every kind, and saved controllers changed as a forger would change them."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np

import gapcert as gc
from gapcert_cells import AutomatonController, GridController, load_controller
from gapcert_verify.controllers import games
from gapcert_verify.controllers.cells import Cells

TANK = {
    "kind": "equations",
    "states": {"h": "m", "v": "m/s"},
    "inputs": {"a": "m/s^2"},
    "parameters": {"k": "0.3 1/m", "c": "0.4 1/s"},
    "derivative": {"h": "v", "v": "a - c*v*(1 + k*h)"},
    "integrator": "rk4",
    "substeps": 2,
    "period": "200 ms",
}
CAR = {
    "kind": "equations",
    "states": {"x": "m", "phi": {"unit": "rad", "kind": "angle"}},
    "inputs": {"w": "rad/s"},
    "parameters": {"s": "1.5 m/s"},
    "derivative": {"x": "s*sin(phi)", "phi": "w"},
    "integrator": "euler",
    "period": "0.2 s",
}
SLED = {
    "kind": "equations",
    "coordinates": {"q": "m"},
    "inputs": {"F": "N"},
    "parameters": {"m": "800 g", "g": "9.81 m/s^2", "mu": "0.02"},
    "mass_matrix": [["m"]],
    "forces": {"q": "F"},
    "dry_friction": {"q": "mu*m*g"},
    "integrator": "semi_implicit",
    "period": "0.25 s",
}
PLATE = {
    "kind": "equations",
    "states": {"x": "m", "y": "m", "v": "m/s"},
    "inputs": {"u": "m/s", "w": "m/s"},
    "parameters": {"tau": "0.5 s"},
    "next": {"x": "x + tau*u", "y": "y + tau*w", "v": "u"},
    "period": "0.5 s",
}
FULL = 6.283185307179586
HALL = {"x": [0, 4], "y": [0, 4]}


def drifting(model, **terms):
    """A backend that is the model with terms added to some of its right-hand sides."""
    made = json.loads(json.dumps(model))
    for part in ("derivative", "next", "forces"):
        for name in set(terms) & set(made.get(part) or {}):
            made[part][name] += f" + {terms[name]}"
    return made


def spec(name, model, domain, controller, gamma=None, backend=None, **more):
    made = {"version": 1, "name": name, "model": model, "domain": domain, "controller": {"kind": "symbolic", **controller}}
    made |= {"report": {"html": False, "rerun": False}}
    if gamma is not None:
        return made | {"gap": {"kind": "declared", "gamma": gamma}} | more
    made |= {
        "backend": backend,
        "sampling": {"kind": "adaptive", "budget": 60},
        "lipschitz": {"residual": {"kind": "interval"}},
    }
    return made | {"certificate": {"claim": "deterministic", "violation": 0.05, "confidence": 0.9}} | more


def specs():
    """Name → spec: uniform, refined, an automaton's and held controllers, on lines, on circles and behind relations."""
    room, belt = {"h": [0, 2], "v": [-1, 1]}, {"x": [-2, 2], "phi": [0, FULL]}
    slow = drifting(TANK, v="0.03*a")
    path = {"kind": "equations", "states": {"x": "m", "y": "m"}, "inputs": {"u": "m/s", "w": "m/s"}}
    path |= {"parameters": {"tau": "0.5 s"}, "next": {"x": "x + tau*u", "y": "y + tau*w"}, "period": "0.5 s"}
    visits = {"ltl": "F a & F b", "regions": {"a": {"x": [0, 1]}, "b": {"x": [3, 4], "y": [2.5, 4]}}}
    visits["avoid"] = [{"x": [1.6, 2.4], "y": [0, 1.4]}]
    forever = {"ltl": "G F a & G F b", "regions": visits["regions"]}
    steps = {"u": [-1, 1], "w": [-1, 1]}
    return {
        "staying": spec(
            "staying",
            TANK,
            {**room, "a": [-1, 1]},
            {"goal": {"invariance": {"h": [0.2, 1.8], "v": [-0.8, 0.8]}}, "cells": {"h": 31, "v": 40}, "inputs": {"a": 5}},
            backend=slow,
        ),
        "affine": spec(
            "affine",
            TANK,
            {**room, "a": [-1, 1]},
            {
                "goal": {"reach_and_stay": {"target": {"h": [0.9, 1.2], "v": [-0.3, 0.3]}}},
                "cells": {"h": 50, "v": 40},
                "inputs": {"a": 7},
            },
            backend=slow,
            gap={"kind": "envelope", "predictor": "affine"},
        ),
        "refined": spec(
            "refined",
            TANK,
            {**room, "a": [-1, 1]},
            {"goal": {"invariance": {"h": [0, 2], "v": [-1, 1]}}, "cells": {"h": 8, "v": 10}, "inputs": {"a": 5}, "refine": 3},
            gamma={"h": 1e-3, "v": 4e-3},
        ),
        "circle": spec(
            "circle",
            CAR,
            {**belt, "w": [-2, 2]},
            {
                "goal": {"reach_avoid": {"target": {"x": [1, 2]}, "avoid": [{"x": [-0.2, 0.1], "phi": [2, 4]}]}},
                "cells": {"x": 40, "phi": 36},
                "inputs": {"w": 5},
            },
            gamma={"x": 2e-3, "phi": 1e-3},
        ),
        "again": spec(
            "again",
            CAR,
            {**belt, "w": [-2, 2]},
            {"goal": {"recurrence": {"target": {"x": [-0.5, 0.5]}}}, "cells": {"x": 30, "phi": 24}, "inputs": {"w": 5}},
            gamma={"x": 2e-3, "phi": 1e-3},
        ),
        "sled": spec(
            "sled",
            SLED,
            {"q": [-1, 1], "q_dot": [-1, 1], "F": [-1, 1]},
            {"goal": {"invariance": {"q": [-1, 1], "q_dot": [-1, 1]}}, "cells": {"q": 40, "q_dot": 41}, "inputs": {"F": 9}},
            backend=drifting(SLED, q="0.04*F"),
            gap={"kind": "envelope", "predictor": "none"},
        ),
        "tour": spec(
            "tour",
            path,
            {**HALL, **steps},
            {"goal": visits, "cells": {"x": 20, "y": 16}, "inputs": {"u": 5, "w": 5}},
            gamma={"x": 5e-3, "y": 5e-3},
        ),
        "finer": spec(
            "finer",
            path,
            {**HALL, **steps},
            {"goal": visits, "cells": {"x": 7, "y": 6}, "inputs": {"u": 5, "w": 5}, "refine": 2},
            gamma={"x": 5e-3, "y": 5e-3},
        ),
        "forever": spec(
            "forever",
            path,
            {**HALL, **steps},
            {"goal": forever, "cells": {"x": 20, "y": 16}, "inputs": {"u": 5, "w": 5}},
            gamma={"x": 5e-3, "y": 5e-3},
        ),
        "held": spec(
            "held",
            PLATE,
            {**HALL, "v": [-1, 1], "u": [-1, 1], "w": [-1, 1]},
            {
                "goal": {"reach_avoid": {"target": {"x": [3, 4], "y": [3, 4]}, "avoid": [{"x": [1, 2], "y": [1, 2]}]}},
                "on": ["x", "y"],
                "cells": {"x": 24, "y": 24},
                "inputs": {"u": 5, "w": 5},
                "input_range": {"u": [-0.24, 0.24], "w": [-0.4, 0.4]},
            },
            backend=drifting(PLATE, x="0.01*tau*v"),
            relations=["abs(u - v) <= 0.5 m/s"],
        ),
    }


def planned():
    """Name → spec of a controller that plans: about one line, to a target, into winning cells, and about lines of its own."""
    room = {"h": [0, 2], "v": [-1, 1], "a": [-1, 1]}
    weak, near = drifting(TANK, v="0.01*a"), {"invariance": {"h": [0.2, 1.8], "v": [-0.8, 0.8]}}
    keeps = {"kind": "mpc", "goal": near, "horizon": 12}
    there = {"reach_avoid": {"target": {"x": [3, 4], "y": [3, 4]}, "avoid": [{"x": [1, 2], "y": [1, 2]}]}}
    path = {k: v for k, v in PLATE.items() if k != "states"} | {"states": {"x": "m", "y": "m"}}
    path["next"] = {"x": "x + tau*u", "y": "y + tau*w"}
    cells = {"kind": "symbolic", "cells": {"h": 30, "v": 40}, "inputs": {"a": 7}}
    moves = {"kind": "mpc", "goal": there, "horizon": 14, "searches": 12}
    led = {
        "kind": "equations",
        "states": {"x": "m", "v": "m/s"},
        "inputs": {"u": "m/s"},
        "parameters": {"tau": "0.3 s", "s": "1 m/s"},
    }
    led |= {"next": {"x": "x + tau*u", "v": "u"}, "period": "0.3 s"}
    slips = drifting(led, x="0.3*tau*abs(u - v)*(u - v)/s - tau*0.1*(u - v)", v="-0.1*(u - v)")
    close = {
        "relations": ["abs(u - v) <= 0.4 m/s"],
        "coordinates": {"d": "u - v"},
        "gap": {"kind": "envelope", "predictor": "affine"},
    }
    pole = {
        "kind": "equations",
        "states": {"q": "rad", "w": "rad/s"},
        "inputs": {"f": "rad/s^2"},
        "parameters": {"g": "9 1/s^2"},
    }
    pole |= {"derivative": {"q": "w", "w": "f - g*sin(q)"}, "integrator": "euler", "period": "50 ms"}
    upright = {"q": [-0.6, 0.6], "w": [-2, 2]}
    lattice = {"gap": {"kind": "multilinear", "predictor": "affine"}, "sampling": {"kind": "lattice", "budget": 300}}
    lattice |= {"lipschitz": {"residual": {"kind": "interval", "curvature": True}}}
    return {
        "relative": spec(
            "relative",
            led,
            {"x": [0, 2], "v": [-1, 1], "u": [-1, 1]},
            {"kind": "mpc", "goal": {"reach_avoid": {"target": {"x": [1.2, 1.8]}}}, "horizon": 8, "searches": 4},
            backend=slips,
            **close,
        ),
        "bent": spec(
            "bent",
            pole,
            {**upright, "f": [-8, 8]},
            {"kind": "mpc", "goal": {"invariance": upright}, "horizon": 2, "linearisation": "successive"},
            backend=drifting(pole, w="0.2*g*q**3 + 0.02*f"),
            **lattice,
        ),
        "tracking": spec("tracking", TANK, room, keeps, backend=weak, gap={"kind": "envelope", "predictor": "affine"}),
        "handed": spec("handed", TANK, room, keeps | {"terminal": cells}, gamma={"h": 1e-3, "v": 3e-3}),
        "along": spec("along", TANK, room, keeps | {"linearisation": "successive"}, gamma={"h": 1e-3, "v": 3e-3}),
        "arriving": spec("arriving", path, {**HALL, "u": [-1, 1], "w": [-1, 1]}, moves, gamma={"x": 5e-3, "y": 5e-3}),
    }


def everything_wins(c):
    """All cells win under all inputs, which are a thousand times as large."""
    bits = np.full_like(c.bits, 255)
    return recounted(replace(c, points=c.points * 1000, bits=bits, values=np.zeros_like(c.values)))


def reforged(run, change):
    """Change the controller with γ of a run and write it anew, with every digest mended."""
    folder = run / "controller" / "with_gamma"
    c = load_controller(folder)
    assert isinstance(c, GridController | AutomatonController)
    shutil.rmtree(folder)
    change(c).save(folder)


def relinked(run):
    """The controller names the certificate as it is now."""
    path = run / "controller" / "with_gamma" / "controller.json"
    data = json.loads(path.read_text())
    data["evidence"]["certificate"] = hashlib.sha256((run / "certificate.json").read_bytes()).hexdigest()
    path.write_text(json.dumps(data))


def made(folder):
    """A run folder of each spec."""
    return {name: gc.run(s, out=folder).folder for name, s in specs().items()}


def flipped(c, cell, which):
    """One bit more of a controller's inputs."""
    bits = c.bits.copy()
    bits[cell, which >> 3] |= np.uint8(128 >> (which & 7))
    return bits


def bit_more(controller, rng):
    """(forged, cell, part, input): one input more in a cell that wins, or in one that loses and is said to win; None: no such.

    The forger gives a losing cell the value that is easiest to keep, and says so wherever cells are counted.
    """
    parts = list(controller.parts) if isinstance(controller, AutomatonController) else [controller]
    q = int(rng.integers(len(parts)))
    part = parts[q]
    whole = np.ones(len(part.values), dtype=bool) if part.splits is None else part.splits.first == 0
    wins = rng.random() < 0.6
    cells = np.flatnonzero(whole & ((part.values >= 0) == wins))
    if not len(cells):
        return None
    cell = int(rng.choice(cells))
    free = np.flatnonzero(part.allowed(np.array([cell]))[0] == 0)
    if not len(free):
        return None
    which, values = int(rng.choice(free)), part.values.astype(np.int32)
    if not wins:
        values[cell] = 0 if part.goal.kind == "invariance" else values.max() + 1
    parts[q] = replace(part, bits=flipped(part, cell, which), values=values)
    changed = replace(controller, parts=tuple(parts)) if len(parts) > 1 else parts[0]
    return recounted(changed), cell, q, which


def recounted(c):
    """With the figures of its cells as they are now."""
    one = c.parts[0] if isinstance(c, AutomatonController) else c
    found = games.figures(Cells.of(one), c)
    return replace(c, evidence={**c.evidence, **found})


def broken(controller, cell, q, which, flow, rng, n=300):
    """Does some step from the cell under the input break what the controller promises? flow: (model, gap) that made it."""
    model, gap = flow
    parts = controller.parts if isinstance(controller, AutomatonController) else (controller,)
    only = np.full(len(parts[q].values), -1, dtype=np.int32)
    only[cell] = 0
    x = replace(parts[q], values=only).draw(n, rng)
    u = np.repeat(parts[q].points[which : which + 1], len(x), axis=0)
    low, high = gap.interval(np.concatenate([x, u], axis=1))
    after = model.step(x, u).x + np.where(rng.random(x.shape) < 0.5, low, high)
    lone = replace(parts[q], promised=None)
    if len(parts) == 1:
        return not lone.kept(x, u, after).all()
    free = replace(controller, parts=tuple(replace(p, promised=None) for p in parts))
    return not free.kept(x, u, after, np.full(len(x), q)).all()


BANDS = {
    "constant": {"gap": {"kind": "constant", "predictor": "affine"}},
    "cells": {"gap": {"kind": "envelope", "predictor": "none"}, "lipschitz": {"residual": {"kind": "interval", "cells": 12}}},
    "lattice": {
        "gap": {"kind": "multilinear", "predictor": "affine"},
        "lipschitz": {"residual": {"kind": "interval", "curvature": True}},
        "sampling": {"kind": "lattice", "budget": 120},
    },
    "basis": {
        "gap": {"kind": "basis", "functions": ["1", "abs(h)", "v^2", "abs(a)"]},
        "sampling": {"kind": "grid", "counts": {"h": 6, "v": 6, "a": 6}},
    },
    "lifted": {
        "gap": {"kind": "basis", "functions": ["1", "abs(a)"]},
        "certificate": {"claim": "deterministic", "route": "dominate", "violation": 0.05, "confidence": 0.9},
    },
    "slopes": {"gap": {"kind": "envelope", "predictor": "multilinear"}},
    "calibrated": {
        "gap": {"kind": "envelope", "predictor": "affine"},
        "certificate": {"claim": "statistical", "route": "calibrate", "violation": 0.05, "confidence": 0.9},
    },
}


def bands():
    """Name → the spec `staying` with a gap function of another form."""
    base = specs()["staying"]
    backend = drifting(TANK, v="0.03*a + 0.02*(1 1/s)*v") | {
        "parameters": {**TANK["parameters"], "d": "0.02 1/s", "b": "0.03 1/m^2"}
    }
    backend["derivative"] = {"h": "v", "v": "a - c*v*(1 + k*h) + 0.03*a + d*v*cos(2*k*h)"}
    goal = {**base["controller"], "cells": {"h": 24, "v": 30}}
    return {name: {**base, "name": name, "backend": backend, "controller": goal, **more} for name, more in BANDS.items()}


def others(folder):
    """Specs that need files beside them, or more than text: inputs beside velocities, a growth bound, an extended model."""
    room = {"h": [0, 2], "v": [-1, 1], "a": [-1, 1]}
    near = {**specs()["held"], "name": "beside", "coordinates": {"d": "u - v", "e": "w"}}
    wide = {**TANK, "parameters": {"k": "0.3 1/m", "c": "0.4 1/s", "tau": "0.2 s"}, "integrator": "euler"}
    radius = {k: wide[k] for k in ("kind", "states", "inputs", "parameters", "period")}
    radius["parameters"] = {**wide["parameters"], "fast": "1.1 m/s"}
    radius["next"] = {"h": "h + tau*v", "v": "v + tau*c*k*h*fast"}
    (folder / "radius.yaml").write_text(json.dumps({"version": 1, "name": "radius", "model": radius}))
    (folder / "extended.yaml").write_text(json.dumps({"version": 1, "name": "extended", "model": drifting(TANK, v="0.02*a")}))
    grown = {
        "goal": {"invariance": {"h": [0, 2], "v": [-1, 1]}},
        "align": "scots",
        "eta": {"h": 0.05, "v": 0.05, "a": 0.25},
        "growth": {"model": str(folder / "radius.yaml")},
    }
    base = specs()["staying"]
    return {
        "beside": near,
        "grown": spec("grown", wide, {**room, "h": [-0.1, 2.1], "v": [-1.1, 1.1]}, grown, gamma={"h": 1e-3, "v": 2e-3}),
        "extended": {
            **base,
            "name": "extended",
            "gap": {"kind": "envelope", "predictor": {"model": str(folder / "extended.yaml")}},
        },
    }
