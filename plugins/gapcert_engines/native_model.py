"""A physics engine as the simulation where no equations stand in for it: its own steps, under its own parameters."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partialmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, final

import numpy as np

from gapcert import Array, Context, Model, Parameter, StateSpec, UsageError, registry
from gapcert.plugin import Scene, Step, cross

from .backend import EngineBackend

if TYPE_CHECKING:
    from .config import EngineConfig

ROTATION = "base.rotation"
_RATES = tuple(f"base.w{a}" for a in "xyz")
_BODY = {f"{r}_body": r for r in _RATES}
_GROUPS = {
    "position": tuple(f"base.{a}" for a in "xyz"),
    "rotation": (ROTATION,),
    "velocity": tuple(f"base.v{a}" for a in "xyz"),
    "rate": _RATES,
}
"""What belongs together of a base that floats."""


@final
@dataclass(frozen=True)
class Group:
    """States that are compared as one: the length of the difference of a vector, the angle of a relative rotation."""

    output: StateSpec
    specs: tuple[StateSpec, ...]
    columns: tuple[int, ...]

    def error(self, a: Array, b: Array) -> Array:
        """|a − b| (…,) of states (…, nx)."""
        parts, at = [], 0
        for s in self.specs:
            columns = list(self.columns[at : at + s.size])
            d = s.difference(a[..., columns], b[..., columns])
            parts.append(d if s.kind == "quaternion" else d.reshape(*d.shape[:-1], -1))
            at += s.size
        return np.asarray(np.linalg.norm(np.concatenate(parts, axis=-1), axis=-1))


@final
class NativeModel(Model):
    """x⁺ of a robot in a physics engine, by its own steps; `values` are native parameters that differ from the stated ones.

    States are all numbers of the robot, named by `of.states`; beside a backend's fields there are `base.rotation`, a unit
    quaternion (w, x, y, z) from the body to the world, and `base.wx_body`, `_wy_`, `_wz_`, the rate in the body's own frame.
    It can be rolled out under other native parameters and under other settings; it has no equations.
    """

    def __init__(
        self,
        of: EngineConfig,
        context: Context,
        parameters: Sequence[Parameter] = (),
        values: Any = None,
        *,
        backend: EngineBackend | None = None,
    ) -> None:
        self.of, self.context = of, replace(context, model=None)
        self.backend = _backend(of, self.context) if backend is None else backend
        stated = {p.name: p for p in self.backend.parameters}
        self.stated = {p.name: p for p in parameters}
        self.values = {n: float(v) for n, v in (values or {n: p.value for n, p in self.stated.items()}).items()}
        self.parameters = tuple(replace(p, value=self.values.get(n, p.value)) for n, p in (stated | self.stated).items())
        self.inputs, self.period, self.substeps = self.backend.inputs, self.backend.period, self.backend.substeps
        self.capabilities = frozenset(c for c in self.backend.capabilities if c == "parameters")
        self._coarse: list[NativeModel] = []
        self._wire()

    def _wire(self) -> None:
        """Columns of x, and where the backend has them."""
        known = {self.backend.config.states[s.name]: s for s in self.backend.states}
        known |= {h.name: h for h in self.backend.hidden}
        order = [*(self.backend.config.states[s.name] for s in self.backend.states), *(h.name for h in self.backend.hidden)]
        starts = dict(zip(order, np.cumsum([0, *(known[t].size for t in order)]).tolist(), strict=False))
        targets = {name: _BODY.get(t, t) for name, t in self.of.states.items()}
        self.states = tuple(replace(known[t], name=name) for name, t in targets.items())
        if left := [t for t in order if t not in targets.values()]:
            raise UsageError(
                f"model.of.states: {', '.join(left)} {'is' if len(left) == 1 else 'are'} in no state; rollouts start from "
                f"measured states, so that all of the robot's have to be named and measured"
            )
        self._width = sum(s.size for s in self.backend.states)
        self._place = np.concatenate([np.arange(starts[t], starts[t] + known[t].size) for t in targets.values()])
        own = dict(zip(targets.values(), np.cumsum([0, *(s.size for s in self.states)]).tolist(), strict=False))
        body = [t in _BODY for t in self.of.states.values()]
        if any(body) and sum(body) < len(_BODY):
            raise UsageError(f"model.of.states: the rate is in the body's frame in part; expected all of {', '.join(_BODY)}")
        self._turn = (own[ROTATION], np.array([own[r] for r in _RATES])) if any(body) else None
        self.groups = tuple(_groups(self.states, targets, own))
        self.outputs = tuple(g.output for g in self.groups)

    # Steps

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        full = np.empty_like(x)
        full[:, self._place] = self.turned(x, back=False)
        given = {n: np.full(len(x), v) for n, v in self.values.items()} | dict(options.get("parameters") or {})
        hidden = np.ascontiguousarray(full[:, self._width :]) if self.backend.hidden else None
        after = self.backend.step(full[:, : self._width], u, hidden=hidden, parameters=given or None)
        out = after.x if after.hidden is None else np.concatenate([after.x, after.hidden], axis=1)
        return Step(self.turned(out[:, self._place], back=True))

    def scene(self, x: Array, hidden: Array | None = None) -> Scene | None:
        full = np.empty_like(x)
        full[:, self._place] = x
        return self.backend.scene(full[:, : self._width], full[:, self._width :] if self.backend.hidden else None)

    def turned(self, x: Array, back: bool) -> Array:
        """With the rate in the world's frame, or back in the body's."""
        if self._turn is None:
            return x
        q, columns = self._turn
        w, v = x[:, q : q + 1], x[:, q + 1 : q + 4] * (-1.0 if back else 1.0)
        length = w**2 + np.sum(v**2, axis=1, keepdims=True)
        out, rate = x.copy(), x[:, columns]
        out[:, columns] = rate + 2 * cross(v, cross(v, rate) + w * rate) / length
        return out

    # What it is

    def restated(self, values: Mapping[str, float]) -> NativeModel:
        """With native parameters at these values; those not named keep theirs."""
        new: NativeModel = object.__new__(NativeModel)
        new.__dict__.update(self.__dict__)
        new.values = {**self.values, **values}
        new.parameters = tuple(replace(p, value=new.values.get(p.name, p.value)) for p in self.parameters)
        return new

    def set(self, options: Mapping[str, Any]) -> NativeModel:
        """With options of the engine's section at other values; UsageError where it refuses them."""
        return NativeModel(self.of.model_copy(update=dict(options)), self.context, tuple(self.stated.values()), self.values)

    def coarse(self) -> NativeModel:
        """Nearly the same, and faster where the engine offers that."""
        if not (options := self.of.coarse()):
            return self
        if not self._coarse:
            self._coarse.append(self.set(options))
        return self._coarse[0].restated(self.values)

    def close(self) -> None:
        """Disconnects from the engine; the next step connects again."""
        for backend in (self.backend, *(m.backend for m in self._coarse)):
            backend.close()

    def natives(self) -> dict[str, float]:
        """Native parameters that differ from the robot file's."""
        stated = {p.name: p.value for p in self.backend.parameters}
        return {n: v for n, v in self.values.items() if v != stated[n]}

    def files(self) -> dict[str, str]:
        """The robot file with these native parameters; where the engine writes none, code that loads the model with them."""
        values = self.natives()
        said = ", ".join(f"{n} = {v!r}" for n, v in values.items())
        load = f'import gapcert\n\n# With {said}.\nmodel = gapcert.load_spec("extended.yaml").build("model")\n'
        return (self.backend.engine.patched(values) or {"extended.py": load}) if values else {}

    def digest(self) -> str:
        parts = [self.backend.digest(), sorted(self.values.items()), list(self.of.states.items())]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def resolution(self, magnitude: Array) -> Array:
        return np.full(self.nx, float(np.max(self.backend.resolution(np.full(self._width, magnitude.max())))))

    def sites(self, kind: str) -> tuple[str, ...]:
        found = {"contact": ("ground",), "parameter": tuple(p.name for p in self.parameters)}
        return found.get(kind, tuple(s.name for s in self.outputs) if kind == "output" else ())

    def equations(self) -> str:
        robot, engine = Path(self.of.robot).name, type(self.backend.engine).__name__.removesuffix("Engine")
        lines = [f"x(t + {self.period:.6g} s) = {engine}({robot}), {self.substeps} sub-steps"]
        units = {p.name: "" if p.unit == "1" else f" {p.unit}" for p in self.parameters}
        return "\n".join([*lines, *(f"{n} = {v:.6g}{units[n]}" for n, v in self.natives().items())])

    def to_spec(self) -> dict[str, Any]:
        of = self.of.model_dump(mode="json", exclude_defaults=True) | {"kind": getattr(self.of, "kind", "")}
        of |= {"robot": os.path.abspath(self.context.folder / self.of.robot), "period": f"{self.period!r} s"}
        return {"kind": "engine", "of": of} | (
            {"parameters": {n: {"value": v} for n, v in self.values.items()}} if self.values else {}
        )

    def _without(self, what: str, *asked: object) -> NoReturn:
        more = ", ".join(self.backend.engine.beyond())
        raise UsageError(f"model.of: {self.backend.engine.file} ({more}) is known by its steps alone, without {what}; "
                         f"use it as a backend, or in a diagnosis")  # fmt: skip

    extend: Any = partialmethod(_without, "equations to extend")
    jacobian: Any = partialmethod(_without, "derivatives")
    enclosure: Any = partialmethod(_without, "enclosure")
    jacobian_enclosure: Any = partialmethod(_without, "derivatives")


def in_contact(of: EngineConfig) -> bool:
    """Is there a base that floats, a ground, or a rotation?"""
    return not of.fixed_base or of.ground is not None or any(t.endswith(".rotation") for t in of.states.values())


def refuse_driven(of: EngineConfig) -> None:
    if of.drive is not None:
        raise UsageError("model.of.drive: a diagnosis by rollouts knows no drive; give efforts at joints as inputs")


def _backend(of: EngineConfig, context: Context) -> EngineBackend:
    """The engine, with states that it knows; what none of them says is hidden state there."""
    refuse_driven(of)
    own = {n: t for n, t in of.states.items() if not t.endswith(".rotation") and t not in _BODY}
    if not own:
        raise UsageError("model.of.states: there is no position in it; expected all numbers of the robot, such as x: base.x")
    kind = getattr(of, "kind", "")
    if of.rotation != "quaternion":
        raise UsageError("model.of.rotation: found 'euler'; expected quaternion, the state base.rotation")
    backend: EngineBackend = registry().build("backend", kind, of.model_copy(update={"states": own}), context)
    return backend


def _groups(states: Sequence[StateSpec], targets: Mapping[str, str], own: Mapping[str, int]) -> list[Group]:
    spec = dict(zip(targets.values(), states, strict=True))
    out = []
    for name, members in _GROUPS.items():
        if found := [t for t in members if t in spec]:
            columns = [own[t] + k for t in found for k in range(spec[t].size)]
            unit = "rad" if name == "rotation" else spec[found[0]].unit
            out.append(Group(StateSpec(name, unit), tuple(spec[t] for t in found), tuple(columns)))
    for t, s in spec.items():
        if not t.startswith("base."):
            out.append(Group(StateSpec(s.name, s.unit), (s,), (own[t],)))
    return out
