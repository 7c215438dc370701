"""Models drawn so that their arithmetic is hard, and their steps with fifty digits."""

from __future__ import annotations

import operator as op

import mpmath as mp
import numpy as np

from gapcert import UsageError
from gapcert_equations.config import EquationsConfig


def equations_model(config):
    """Imported late: it brings computer algebra, which collecting tests has no use for."""
    from gapcert_equations.model import EquationsModel

    return EquationsModel(config)


def _sign(v):
    return mp.mpf((v > 0) - (v < 0))


def _stop(v, d, k):
    a = d - k * _sign(v)
    if (v + a) * _sign(v) > 0:
        return v + a
    return (d - max(-k, min(d, k))) * (1 + v / (a if a else mp.mpf(1)))


_NAMES = ["sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "atan", "asin", "acos"]
DIGITS = {
    **{name: getattr(mp, name) for name in _NAMES},
    **dict(zip(["add", "sub", "mul", "div", "neg"], [op.add, op.sub, op.mul, op.truediv, op.neg], strict=True)),
    **dict(zip(["abs", "sign", "round", "min", "max"], [abs, _sign, mp.nint, min, max], strict=True)),
    "number": lambda p, q: mp.mpf(p) / q,
    "power": mp.power,
    "pow": lambda a, n: a**n,
    "soft": lambda v, k: v - max(-k, min(v, k)),
    "stop": _stop,
}


def exact(model, z):
    """x⁺ (n, nx) of points z as mpmath numbers, by the same text with fifty digits; an element is None where it is complex."""
    with mp.workdps(50):
        dynamics = model.definition.dynamics
        fixed = dynamics.prepare(DIGITS, [mp.mpf(p.value) for p in model.parameters])
        rows = []
        for row in z.tolist():
            columns = [mp.mpf(v) for v in row]
            past = [mp.mpf(v) for v in model.hidden_default] if model.hidden else None
            acting, _, known = model._acting(model._stated, columns[model.nx :], past)
            after = dynamics.step(DIGITS, fixed, columns[: model.nx], acting, known)[0]
            rows.append([None if isinstance(v, mp.mpc) else mp.mpf(v) for v in after])
        return rows


def missed(model, z, after):
    """|computed − exact| (n, nx) of steps `after`, NaN where either is no number."""
    with mp.workdps(50):
        each = zip(exact(model, z), after.tolist(), strict=True)
        far = [
            [float(abs(mp.mpf(v) - w)) if w is not None and np.isfinite(v) else np.nan for w, v in zip(*row, strict=True)]
            for row in each
        ]
    return np.array(far)


class Draw:
    """Texts with cancellation of 1e12, steep waves, poles, powers at 0, scales from 1e-8 to 1e8, sub-steps and masses."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)

    def number(self):
        r = self.rng
        size = 10.0 ** (r.uniform(-8, 8) if r.random() < 0.3 else r.uniform(-1.5, 1.5))
        value = float(f"{size * r.choice([-1, 1]):.{r.integers(1, 17)}g}")
        return repr(value) if r.random() < 0.8 else repr(int(value) or 3)

    def text(self, names, depth):
        r = self.rng
        if depth == 0 or r.random() < 0.1:
            return str(r.choice(names)) if r.random() < 0.7 else self.number()
        a, b = self.text(names, depth - 1), self.text(names, depth - 1)
        big = repr(10.0 ** r.integers(3, 13))
        texts = (
            f"({a} + {b})", f"({a} - {b})", f"({a})*({b})", f"({a})/(2 + ({b})**2)", f"sin({r.choice([1, 9, 300, 1e5])}*({a}))",
            f"cos({a})", f"tanh({a})", f"exp(-({a})**2)", f"sqrt(abs({a}))", f"abs({a})**{r.choice([0.3, 1.5, 2.7, 0.9])}",
            f"({a})**{r.integers(2, 7)}", f"(max({a}, -1e30) + {big}) - max({big} - ({b}), 1e-30)", f"min({a}, {b})",
            f"max({a}, {b})", f"log(1e-3 + ({a})**2)", f"atan({a})", f"asin(tanh({a}))", f"acos(cos({a})*0.999)",
            f"tan(tanh({a}))", f"({self.number()}/({a} + 1e-3*(2 + cos({b}))))", f"exp(tanh({a})*{r.choice([1, 20])})",
        )  # fmt: skip
        return texts[r.integers(len(texts))]

    def model(self):
        """(model, low, high): None in place of the model where the text simplifies to none."""
        r, nx, nu = self.rng, int(self.rng.integers(1, 4)), int(self.rng.integers(0, 3))
        states, inputs = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]
        parameters = {"a": float(self.number()), "b": float(10.0 ** r.uniform(-2, 2)), "T": "1 s"}
        given = {"kind": "equations", "inputs": dict.fromkeys(inputs, "1"), "parameters": parameters}
        given |= {"period": float(f"{10.0 ** r.uniform(-3, 0):.3g}")}
        kind, depth = r.choice(["next", "derivative", "mechanical"]), int(r.integers(1, 5))
        given |= getattr(self, f"_{kind}")(states, [*states, *inputs, "a", "b"], depth)
        try:
            model = equations_model(EquationsConfig(**given))
        except UsageError:
            return None, None, None
        nz = model.nx + model.nu
        far = 10.0 ** r.uniform(0, 4, nz) * r.choice([-1, 1], nz)
        middle = np.where(r.random(nz) < 0.3, far, r.normal(size=nz) * (r.random(nz) < 0.7))
        half = 10.0 ** r.uniform(-6, 1, nz)
        if r.random() < 0.5:
            half = 10.0 ** r.uniform(-14, -6, nz) * np.maximum(np.abs(middle), 1)
        return model, middle - half, middle + half

    def points(self, low, high, n=24):
        """Of the box: its ends, some corners, what is nearest to 0, the rest uniform."""
        z = low + (high - low) * self.rng.random((n, len(low)))
        z[0], z[1], z[2] = low, high, 0.0
        z[3:6] = np.where(self.rng.random((3, len(low))) < 0.5, low, high)
        return np.clip(z, low, high)

    def _next(self, states, names, depth):
        return {"states": dict.fromkeys(states, "1"), "next": {x: self.text(names, depth) for x in states}}

    def _stepped(self):
        return {
            "integrator": str(self.rng.choice(["euler", "semi_implicit", "rk4"])),
            "substeps": int(self.rng.choice([1, 1, 2, 7])),
        }

    def _derivative(self, states, names, depth):
        friction = {"dry_friction": {states[0]: "abs(a)/T"}} if self.rng.random() < 0.3 else {}
        rates = {x: f"({self.text(names, depth)})/T" for x in states}
        return {"states": dict.fromkeys(states, "1"), "derivative": rates, **self._stepped(), **friction}

    def _mechanical(self, states, names, depth):
        names, n = [*names, *(f"{x}_dot*T" for x in states)], len(states)
        mass = [[f"b*cos({p} - {q})" for q in states] for p in states]
        for i, x in enumerate(states):
            mass[i][i] = f"b*({n + 1} + tanh({self.text([x, 'a'], 2)}))"
            for j in range(i):
                mass[j][i] = mass[i][j]
        forces = {x: f"({self.text(names, depth)})/T**2" for x in states}
        friction = {"dry_friction": {states[0]: "abs(a)/T**2"}} if n == 1 and self.rng.random() < 0.4 else {}
        return {"coordinates": dict.fromkeys(states, "1"), "mass_matrix": mass, "forces": forces, **self._stepped(), **friction}
