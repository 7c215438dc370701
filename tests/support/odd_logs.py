"""Odd logs and odd specs of diagnoses: a plant, what is wrong with its log, and what is odd about its spec, drawn from a seed.

A case is plain data: {"spec": a spec, "logs": {file name: text}, "command": "diagnose" or "inspect"}.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

N, M, S = "N*m", "m", "s"


@dataclass(frozen=True)
class Plant:
    """A model's section, f(x, u) of its states, what the log shows of them, its start and the size of its input."""

    section: dict
    f: Callable
    shown: Callable
    start: tuple[float, ...]
    size: float = 0.0
    period: float = 0.02
    discrete: bool = False


def _plants() -> dict[str, Plant]:
    def state(*names):
        return lambda x, u: {n: x[:, i] for i, n in enumerate(names)}

    pendulum = {"coordinates": {"q": {"unit": "rad", "kind": "angle"}}, "inputs": {"u": N}, "mass_matrix": [["m*l**2"]]}
    pendulum |= {"parameters": {"m": {"value": "1 kg", "tolerance": "2 %"}, "l": "0.5 m", "g": "9.81 m/s^2"}}
    pendulum |= {"bias": {"q": "m*g*l*sin(q)"}, "forces": {"q": "u"}}
    normal = pendulum | {
        "inputs": {},
        "parameters": {"w": "4 1/s"},
        "mass_matrix": [["1"]],
        "bias": {"q": "w**2*sin(q)"},
        "forces": {},
    }
    cart = {"coordinates": {"q": M}, "inputs": {"u": "N"}, "parameters": {"m": {"value": "2 kg", "tolerance": "3 %"}}}
    cart |= {"mass_matrix": [["m"]], "bias": {"q": "0"}, "forces": {"q": "u"}}
    motor = {
        "states": {"w": "rad/s", "i": "A"},
        "inputs": {"V": "V"},
        "derivative": {"w": "(K*i - b*w)/J", "i": "(V - R*i - K*w)/L"},
    }
    motor |= {
        "parameters": {
            "K": "0.05 V*s/rad",
            "b": "1e-4 N*m*s/rad",
            "J": "5e-4 kg*m^2",
            "R": {"value": "2 ohm", "tolerance": "2 %"},
        }
    }
    motor["parameters"] |= {"L": "2e-3 H"}
    servo = motor | {"inputs": {"ref": "rad/s"}}
    servo["derivative"] = motor["derivative"] | {"i": "(c*(ref - w) - R*i - K*w)/L"}
    servo["parameters"] = motor["parameters"] | {"c": "0.5 V*s/rad"}
    rc = {
        "states": {"v": "V"},
        "inputs": {"u": "V"},
        "derivative": {"v": "(u - v)/T"},
        "parameters": {"T": {"value": "0.3 s", "tolerance": "2 %"}},
    }
    heater = {"states": {"T": "K"}, "inputs": {"P": "W"}, "derivative": {"T": "(P - U*(T - Ta))/C"}}
    heater |= {"parameters": {"U": "0.2 W/K", "Ta": "293 K", "C": {"value": "20 J/K", "tolerance": "3 %"}}}
    strut = {"states": {"x": M}, "inputs": {"v": "m/s"}, "derivative": {"x": "v"}, "outputs": {"x": "x", "F": "k*x + c*v"}}
    strut |= {"parameters": {"k": {"value": "500 N/m", "tolerance": "2 %"}, "c": "40 N*s/m"}}
    away = {
        "states": {"x": "1"},
        "inputs": {"u": "1"},
        "derivative": {"x": "(a*x + u)/T"},
        "parameters": {"a": {"value": 3, "tolerance": "2 %"}, "T": "1 s"},
    }
    stiff = {"states": {"x": "1", "z": "1"}, "inputs": {"u": "1"}, "derivative": {"x": "(z - x)/T", "z": "(u - z)/s"}}
    stiff |= {"parameters": {"T": "0.2 s", "s": "2e-3 s"}}
    step = {
        "states": {"x": "1"},
        "inputs": {"u": "1"},
        "next": {"x": "a*x + b*u"},
        "parameters": {"a": 0.9, "b": {"value": 0.1, "tolerance": "5 %"}},
    }
    twice = {"states": {"x": "1"}, "inputs": {"u": "1"}, "derivative": {"x": "(a*b*u - x)/T"}, "parameters": {"T": "0.4 s"}}
    twice["parameters"] |= {n: {"value": 1, "tolerance": "5 %"} for n in "ab"}
    zero = {
        "states": {"x": "1"},
        "inputs": {"u": "1"},
        "derivative": {"x": "(u - x + z*x**2)/T"},
        "parameters": {"T": "0.4 s", "z": 0},
    }
    pair = {
        "coordinates": {"p": M, "q": M},
        "inputs": {"u": "N"},
        "parameters": {"m": "1 kg", "n": "0.5 kg", "k": {"value": "30 N/m", "tolerance": "2 %"}},
    }
    pair |= {"mass_matrix": [["m", "0"], ["0", "n"]], "bias": {"p": "k*(p - q)", "q": "k*(q - p)"}, "forces": {"p": "u"}}
    tank = {"states": {"h": M}, "inputs": {"q": "m^3/s"}, "derivative": {"h": "(q - c*sqrt(max(h, 0)))/A"}}
    tank |= {"parameters": {"c": {"value": "0.02 m^2.5/s", "tolerance": "3 %"}, "A": "0.3 m^2"}}
    limit = {"states": {"x": "1"}, "inputs": {"u": "1"}, "derivative": {"x": "(min(max(u, -s), s) - abs(x)*x)/T"}}
    limit |= {"parameters": {"T": "0.3 s", "s": {"value": 0.8, "tolerance": "2 %"}}}
    bell = {
        "states": {"a": {"unit": "rad", "kind": "angle"}, "b": "rad/s"},
        "derivative": {"a": "b", "b": "-w**2*sin(a) - 2*d*w*b"},
    }
    bell |= {"parameters": {"w": {"value": "9 1/s", "tolerance": "2 %"}, "d": 0.001}}
    both = {
        "states": {"x": "1", "y": "1"},
        "inputs": {"u": "1", "v": "1"},
        "next": {"x": "0.8*x + 0.1*y + u", "y": "0.5*y + v"},
    }
    both |= {"outputs": {"x": "x", "z": "k*x + y + u"}, "parameters": {"k": {"value": 2, "tolerance": "5 %"}}}
    return {
        "pendulum": Plant(pendulum, lambda x, u: (x[1], -19.62 * np.sin(x[0]) + 4 * u - 0.2 * x[1]), state("q"), (0.5, 0), 1.0),
        "normalised": Plant(normal, lambda x, u: (x[1], -16 * np.sin(x[0])), state("q", "q_dot"), (0.8, 0)),
        "cart": Plant(cart, lambda x, u: (x[1], u / 2 - 0.4 * np.tanh(x[1] / 0.01)), state("q"), (0, 0), 3.0),
        "motor": Plant(
            motor,
            lambda x, u: ((0.05 * x[1] - 1e-4 * x[0]) / 5e-4, (u - 2 * x[1] - 0.05 * x[0]) / 2e-3),
            state("w"),
            (0, 0),
            8.0,
        ),
        "servo": Plant(
            servo,
            lambda x, u: ((0.05 * x[1] - 2e-4 * x[0]) / 5e-4, (0.5 * (u - x[0]) - 2 * x[1] - 0.05 * x[0]) / 2e-3),
            state("w", "i"),
            (0, 0),
            20.0,
        ),
        "rc": Plant(rc, lambda x, u: ((u - x[0]) / 0.33,), state("v"), (0,), 5.0),
        "heater": Plant(heater, lambda x, u: ((u - 0.2 * (x[0] - 293)) / 20,), state("T"), (293,), 10.0, 2.0),
        "strut": Plant(strut, lambda x, u: (u,), lambda x, u: {"F": 500 * x[:, 0] + 40 * u}, (0,), 0.1),
        "away": Plant(away, lambda x, u: (3 * x[0] + u,), state("x"), (0,), 0.01),
        "stiff": Plant(stiff, lambda x, u: ((u - x[0]) / 0.2, -x[1]), state("x"), (0, 0), 1.0),
        "step": Plant(step, lambda x, u: (0.9 * x[0] + 0.1 * u,), state("x"), (0,), 1.0, 0.05, True),
        "twice": Plant(twice, lambda x, u: ((1.1 * u - x[0]) / 0.4,), state("x"), (0,), 1.0),
        "zero": Plant(zero, lambda x, u: ((u - x[0] + 0.1 * x[0] ** 2) / 0.4,), state("x"), (0,), 1.0),
        "tank": Plant(tank, lambda x, u: ((u - 0.02 * np.sqrt(max(x[0], 0))) / 0.3,), state("h"), (0.5,), 0.03, 1.0),
        "limit": Plant(limit, lambda x, u: ((min(max(u, -0.7), 0.7) - abs(x[0]) * x[0]) / 0.3,), state("x"), (0,), 2.0),
        "bell": Plant(bell, lambda x, u: (x[1], -81 * np.sin(x[0]) - 0.04 * x[1]), state("a"), (1, 0)),
        "both": Plant(
            both,
            lambda x, u: (0.8 * x[0] + 0.1 * x[1] + u, 0.5 * x[1] + u),
            lambda x, u: {"z": 2.2 * x[:, 0] + x[:, 1] + u},
            (0, 0),
            1.0,
            0.1,
            True,
        ),
        "pair": Plant(
            pair, lambda x, u: (x[2], x[3], 30 * (x[1] - x[0]) + u, 60 * (x[0] - x[1])), state("p", "q"), (0, 0.1, 0, 0), 2.0
        ),
    }


PLANTS = _plants()
EFFECTS = (
    *("viscous-friction", "coulomb-friction", "stribeck-friction", "quadratic-drag", "external-push", "cogging", "backlash"),
    *("input-gain", "input-offset", "input-delay", "input-lag", "input-dead-zone", "input-saturation", "input-nonlinearity"),
    *("input-hysteresis", "supply-sag", "sensor-bias", "sensor-scale", "sensor-delay", "sensor-quantisation", "parameter"),
    *("constant-force", "gravity-tilt", "linear-spring", "joint-coupling", "dahl-friction", "payload"),
)


def played(p: Plant, count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Columns of a log: t, the inputs, and what is shown."""
    held = rng.integers(3, 25)
    u = p.size * rng.uniform(-1, 1, count)[np.arange(count) // held] * (rng.random() < 0.95)
    acts = (
        u,
        1.4 * u,
        u + 0.3 * p.size,
        np.roll(u, 3),
        np.clip(u, -p.size / 2, p.size / 2),
        u - np.clip(u, -p.size / 5, p.size / 5),
    )
    act = acts[rng.integers(len(acts))]
    x, out, sub = np.array(p.start, dtype=float), [], 1 if p.discrete else 20
    h = p.period / sub
    for k in range(count):
        out.append(x.copy())
        for _ in range(sub):
            if p.discrete:
                x = np.array(p.f(x, act[k]), dtype=float)
                continue
            a = np.array(p.f(x, act[k]))
            x = x + h * np.array(p.f(x + h / 2 * a, act[k]))
        x = np.clip(x, -1e150, 1e150)
    shown = {
        n: y * rng.choice([1, 1, 1.2]) + rng.choice([0, 0, 0.1]) * np.std(y) for n, y in p.shown(np.array(out), act).items()
    }
    noise = 10.0 ** rng.uniform(-5, -1) if rng.random() < 0.9 else 0.0
    shown = {n: y + noise * np.nanstd(y) * rng.standard_normal(count) for n, y in shown.items()}
    inputs = dict.fromkeys(p.section.get("inputs", {}), u)
    return {"t": p.period * np.arange(count), **shown, **inputs}


# --- what may be wrong with a log: each takes columns, the names of its signals and a generator


def _some(names, rng):
    return names[int(rng.integers(len(names)))]


def _constant(c, names, rng):
    c[_some(names, rng)][:] = rng.choice([0.0, 1.0, 1e9, -3e-7])


def _still(c, names, rng):
    for n in names:
        c[n][:] = 0.0


def _gaps(c, names, rng):
    n = _some(names, rng)
    c[n][rng.random(len(c[n])) < rng.choice([0.02, 0.3, 0.9, 1.0])] = np.nan


def _hole(c, names, rng):
    a = int(rng.integers(len(c["t"])))
    for n in names if rng.random() < 0.5 else [_some(names, rng)]:
        c[n][a : a + int(rng.integers(1, 60))] = np.nan


def _infinite(c, names, rng):
    c[_some(names, rng)][int(rng.integers(len(c["t"])))] = rng.choice([np.inf, -np.inf, 1e300, -1e300])


def _short(c, names, rng):
    count = int(rng.choice([0, 1, 2, 3, 5, 9, 17, 30]))
    for n in c:
        c[n] = c[n][:count]


def _doubled(c, names, rng):
    t, k = c["t"], rng.integers(1, len(c["t"]), int(rng.choice([1, 5, 60])))
    t[k] = t[k - 1]


def _stopped(c, names, rng):
    c["t"][:] = c["t"][0] if rng.random() < 0.3 else np.repeat(c["t"][::2], 2)[: len(c["t"])]


def _back(c, names, rng):
    c["t"] = c["t"][::-1].copy() if rng.random() < 0.5 else np.roll(c["t"], int(rng.integers(1, 50)))


def _times(c, names, rng):
    c["t"] = c["t"] * 10.0 ** rng.choice([-12, -9, -6, -3, 3, 6, 9]) + rng.choice([0, 0, 1.7e9, -5.0, 1e15])


def _trembling(c, names, rng):
    t = c["t"]
    c["t"] = np.sort(t + rng.choice([0.05, 0.3, 1.0, 5.0]) * np.median(np.diff(t)) * rng.standard_normal(len(t)))


def _dropped(c, names, rng):
    keep = rng.random(len(c["t"])) > rng.choice([0.01, 0.2, 0.8])
    for n in c:
        c[n] = c[n][keep]


def _scaled(c, names, rng):
    n = _some(names, rng)
    c[n] = c[n] * 10.0 ** rng.integers(-12, 13)


def _all_scaled(c, names, rng):
    size = 10.0 ** rng.choice([-12, -6, 6, 12])
    for n in names:
        c[n] = c[n] * size


def _whole(c, names, rng):
    n = _some(names, rng)
    c[n] = np.round(c[n] * 10.0 ** rng.integers(0, 3))


def _switched(c, names, rng):
    n = _some(names, rng)
    c[n] = (c[n] > np.median(c[n])).astype(float)


def _saturated(c, names, rng):
    n = _some(names, rng)
    size = rng.choice([0.02, 0.3, 0.8]) * np.nanmax(np.abs(c[n]), initial=0.0)
    c[n] = np.clip(c[n], -size, size)


def _stuck(c, names, rng):
    n = _some(names, rng)
    k = int(rng.integers(len(c["t"])))
    c[n][k:] = c[n][k]


def _noisy(c, names, rng):
    n = _some(names, rng)
    c[n] = c[n] + 10.0 ** rng.choice([0, 2, 6]) * (np.nanstd(c[n]) + 1e-12) * rng.standard_normal(len(c[n]))


def _outliers(c, names, rng):
    n = _some(names, rng)
    c[n][rng.random(len(c[n])) < 0.03] += 1e4 * (np.nanstd(c[n]) + 1e-12)


def _shifted(c, names, rng):
    c[_some(names, rng)] += rng.choice([1e3, 1e8, -1e12])


def _alone(c, names, rng):
    """A few whole stretches between gaps."""
    for n in names:
        c[n][np.arange(len(c["t"])) % int(rng.integers(4, 60)) == 0] = np.nan


def _unmoved(c, names, rng):
    n = _some(names, rng)
    c[n][: int(0.7 * len(c[n]))] = c[n][0]


def _held(c, names, rng):
    """Moves in the first part only: what is held out is at rest."""
    n = _some(names, rng)
    c[n][int(0.6 * len(c[n])) :] = c[n][int(0.6 * len(c[n]))]


def _random(c, names, rng):
    for n in names:
        c[n] = rng.standard_normal(len(c["t"]))


LOGS = (
    *(_constant, _still, _gaps, _hole, _infinite, _short, _doubled, _stopped, _back, _times, _trembling, _dropped, _scaled),
    *(_all_scaled, _whole, _switched, _saturated, _stuck, _noisy, _outliers, _shifted, _alone, _unmoved, _held, _random),
)


def text(columns: dict[str, np.ndarray], words: str = "") -> str:
    """As CSV; words: how values are written."""

    def cell(name, v):
        if words == "bool" and name != "t" and v in (0.0, 1.0):
            return str(bool(v))
        if words == "whole" and np.isfinite(v) and v == int(v):
            return str(int(v))
        return ("" if words == "empty" else "nan") if np.isnan(v) else repr(float(v))

    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(cell(n, v) for n, v in zip(columns, r, strict=True)) for r in rows)]) + "\n"


# --- what may be odd about a spec


def _hold_out(spec, rng, files):
    share = rng.choice(["33 %", "1 %", "99 %", "0.1 %", "50 %", 0.5])
    ways = [{"last": share}, {"from": f"{rng.choice([0, 1, 3, 100])} s"}, {"from": "1 s", "to": "1.02 s"}, {"to": "2 s"}]
    ways += [{"trajectories": [0]}, {"trajectories": [files[0].removesuffix(".csv")]}, {"every": rng.choice([1, 2, 7])}]
    ways += [{"trajectories": ["nobody"]}, {"from": "2 s", "to": "1 s"}, {"every": 2, "first": 1}, {"trajectories": [9]}]
    spec["diagnose"]["hold_out"] = rng.choice(ways)


def _train(spec, rng, files):
    spec["diagnose"]["train"] = rng.choice([{"trajectories": [0]}, {"every": 2}, {"trajectories": ["x"]}])


def _horizons(spec, rng, files):
    some = [["1e9 s"], ["1e-9 s"], ["0.5 s", "100 s"], ["0.02 s"], ["3 s"], ["0.1 s", "0.1 s"], ["0 s"], ["-1 s"], []]
    spec["diagnose"]["horizons"] = rng.choice(some)


def _window(spec, rng, files):
    spec["diagnose"]["window"] = rng.choice(["1e-6 s", "0.1 s", "1 s", "1e6 s", "0.02 s"])


def _exact(spec, rng, files):
    spec["diagnose"]["exact"] = rng.choice([list(spec["model"].get("inputs", {})), ["nobody"], []])


def _limits(spec, rng, files):
    names = [*spec["model"].get("inputs", {}), *spec["recording"]["columns"], "nobody"]
    some = [[-1, 1], [0, 0], [1, -1], [-1e9, 1e9], [1e-9, 2e-9]]
    asked = {"limits": {rng.choice(names): rng.choice(some)}, "seconds": rng.choice([0.01, 1, 12])}
    spec["diagnose"]["experiment"] = asked


def _unknown(spec, rng, files):
    spec["diagnose"]["effects"] = [rng.choice(["frictoin", "", "VISCOUS-FRICTION", "input-gain-2"])]


def _missing(spec, rng, files):
    columns = spec["recording"]["columns"]
    if columns:
        name = rng.choice([*columns])
        if rng.random() < 0.5:
            del columns[name]
        else:
            columns[name] = rng.choice(["nothing", "t", ""])


def _values(spec, rng, files):
    parameters = spec["model"]["parameters"]
    name = rng.choice([*parameters])
    old = parameters[name]
    number, _, unit = str(old["value"] if isinstance(old, dict) else old).partition(" ")
    value = rng.choice([0, -1, 1e-12, 1e12, 2, 0.5, 1e3, 1e-3]) * float(number)
    parameters[name] = {"value": f"{value!r} {unit}".strip(), "tolerance": rng.choice(["2 %", "0 %", "50 %", "1e-6 %"])}


def _tolerances(spec, rng, files):
    parameters = spec["model"]["parameters"]
    for name, old in parameters.items():
        parameters[name] = {"value": old["value"] if isinstance(old, dict) else old, "tolerance": "10 %"}


def _substeps(spec, rng, files):
    spec["model"]["substeps"] = rng.choice([1, 7, 300])


def _period(spec, rng, files):
    spec["model"]["period"] = rng.choice(["1 ms", "7 ms", "0.02 s", "1 s", "1e-4 s"])


def _every(spec, rng, files):
    spec["recording"]["every"] = rng.choice(["0.04 s", "0.1 s", "1 s", "1 ms"])


def _model(spec, rng, files):
    """A word of the equations is changed."""
    section = rng.choice([k for k in ("derivative", "next", "bias", "forces") if spec["model"].get(k)])
    name = rng.choice([*spec["model"][section]])
    text = spec["model"][section][name]
    ways = [f"-({text})", f"2*({text})", f"({text})**3", f"0*({text})", f"({text})/1e-9", f"1e6*({text})", f"sqrt(({text})**2)"]
    spec["model"][section][name] = rng.choice(ways)


def _hold(spec, rng, files):
    spec["recording"]["hold"] = rng.choice(["zero", "first"])


def _units(spec, rng, files):
    name = rng.choice([*spec["recording"]["columns"], "t"])
    spec["recording"]["units"] = {name: rng.choice(["deg", "ms", "mm", "1", "mV", "degC", "rpm"])}


def _unseen(spec, rng, files):
    """A state that nothing drives or shows."""
    m = spec["model"]
    if "derivative" in m:
        m["states"]["ghost"], m["derivative"]["ghost"] = "1", rng.choice(["-ghost/T0", "0/T0", "1/T0", "ghost/T0"])
        m["parameters"]["T0"] = rng.choice(["1 s", "1e-4 s", "1e4 s"])


def _output(spec, rng, files):
    """Outputs in the model's text."""
    m = spec["model"]
    if "states" in m and "outputs" not in m:
        m["outputs"] = {n: rng.choice([n, f"2*{n}", f"abs({n})", f"sqrt({n})", f"0*{n}"]) for n in m["states"]}


SPECS = (
    *(_hold_out, _train, _horizons, _window, _exact, _limits, _unknown, _missing, _values, _tolerances, _substeps, _period),
    *(_every, _model, _model, _hold, _units, _unseen, _output),
)


def drawn(seed: int) -> dict:
    """One case."""
    rng, some = np.random.default_rng(seed), random.Random(seed)
    name = some.choice([*PLANTS])
    p = PLANTS[name]
    section = {"kind": "equations", **{k: dict(v) if isinstance(v, dict) else v for k, v in p.section.items()}}
    if p.discrete or some.random() < 0.3:
        section["period"] = f"{p.period} s"
    logs, odd = {}, []
    for k in range(some.choice([1, 1, 1, 2, 4])):
        columns = played(p, some.choice([150, 300, 400, 600]), rng)
        names = [n for n in columns if n != "t"]
        for spoil in some.sample(LOGS, some.choice([0, 0, 1, 1, 1, 2, 3])) if k == 0 or some.random() < 0.3 else ():
            if len(columns["t"]) > 1:
                with np.errstate(all="ignore"):
                    spoil(columns, names, rng)
                odd.append(spoil.__name__)
        logs[f"log{k}.csv"] = text(columns, some.choice(["", "", "bool", "whole", "empty"]))
    effects = some.sample(EFFECTS, some.choice([1, 2, 3, 6])) if some.random() < 0.85 else "all"
    recording = {"kind": "csv", "files": [*logs], "time": "t", "columns": {n: n for n in columns if n != "t"}}
    spec = {"version": 1, "name": f"odd-{seed}", "model": section, "recording": recording, "diagnose": {"effects": effects}}
    spec["report"] = {"rerun": False}
    for change in some.sample(SPECS, some.choice([0, 0, 0, 0, 1, 1, 2])):
        change(spec, some, [*logs])
        odd.append(change.__name__)
    return {"spec": spec, "logs": logs, "command": some.choice(["diagnose", "diagnose", "inspect"]), "odd": [name, *odd]}
