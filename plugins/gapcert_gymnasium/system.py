"""Backend `gymnasium`: an environment asked one step at a time as a function of its state."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import threading
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, final

import gymnasium
import numpy as np

from gapcert import Array, Backend, Context, StateSpec, System, UsageError
from gapcert.plugin import Step, magnitude
from gapcert_engines import check_ranges, muted

from .adapters import CLASSIC, OURS, Adapter, Attribute, MuJoCo, own
from .config import GymnasiumConfig, Levels

_Option = Literal["hidden", "parameters"]


@final
class GymnasiumBackend(Backend):
    """x⁺ of the numbers that `states` names, after one step of the bare environment.

    The wrappers that `gymnasium.make` adds count steps and end episodes, so they are taken off; where an episode would end, the
    environment goes on. Numbers of the state that no name stands for are hidden state.
    """

    def __init__(self, config: GymnasiumConfig, folder: Path | None = None, *, model: System | None = None) -> None:
        self.config, self._lock = config, threading.Lock()
        self._adapter: Adapter | None = None
        adapter = self._made()
        self.period = self._period(adapter, model)
        self.single, self.parameters = adapter.single, adapter.parameters
        self._nominal = {p.name: p.value for p in adapter.parameters}
        self._wire(adapter, model)

    @classmethod
    def from_config(cls, config: GymnasiumConfig, context: Context) -> GymnasiumBackend:
        """UsageError where the spec names a module and the user has not allowed code."""
        if ":" in config.env and not context.allow_code:
            raise UsageError(
                f"backend.env: '{config.env}' imports a module, which a spec may not do by itself; read it, and pass "
                f"--allow-code if you trust it"
            )
        return cls(config, context.folder, model=context.model)

    def digest(self) -> str:
        versions = [gymnasium.__version__]
        if "mujoco" in self._class:
            versions.append(importlib.metadata.version("mujoco"))
        axes = [[s.name, s.unit, s.kind] for s in (*self.states, *self.inputs)]
        parts = [*versions, self._class, self.config.model_dump(mode="json", exclude={"period"}), self.period, axes]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def resolution(self, magnitude: Array) -> Array:
        """4 ulp, of single precision where the environment keeps its state so."""
        if not self.single:
            return super().resolution(magnitude)
        return np.asarray(4 * np.spacing(np.maximum(np.abs(magnitude), 1e-30).astype(np.float32)).astype(np.float64))

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k not in ("_adapter", "_lock")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._adapter, self._lock = None, threading.Lock()

    # What there is

    def _made(self) -> Adapter:
        """The bare environment, with what is known of it."""
        config = self.config
        try:
            with warnings.catch_warnings(), muted():
                warnings.simplefilter("ignore")
                env: Any = gymnasium.make(config.env, **config.options).unwrapped
        except (gymnasium.error.Error, ImportError, TypeError, OSError) as error:
            reason = " ".join(str(error).split())
            raise UsageError(f"backend.env: '{config.env}' cannot be made: {reason}; see gymnasium.pprint_registry()") from None
        self._class = f"{type(env).__module__}.{type(env).__qualname__}"
        if (config.state is None) != (config.action is None):
            raise UsageError("backend.state: it goes with action; give both for an environment of your own, or none")
        if config.state is not None and config.action is not None:
            state, action = ([StateSpec(n, c.unit, c.kind) for n, c in part.items()] for part in (config.state, config.action))
            return own(env, config.attribute, state, action, config.single)
        if self._class.startswith(OURS) and type(env).__name__ in CLASSIC:
            return Attribute(env, CLASSIC[type(env).__name__])
        if hasattr(env, "set_state") and hasattr(env, "model") and hasattr(env, "data"):
            return MuJoCo(env)
        raise UsageError(
            f"backend.env: gapcert does not know what is the state of {self._class}; expected classic control or MuJoCo; say "
            f"so with state: {{NAME: {{unit: …}}}}, action and attribute"
        )

    def _period(self, adapter: Adapter, model: System | None) -> float:
        if self.config.period is not None:
            period = magnitude(self.config.period, "s")
        elif model is not None:
            period = model.period
        elif adapter.period is not None:
            period = adapter.period
        else:
            raise UsageError(
                "backend.period: there is neither a model nor an environment to take it from; add for instance period: 1 s"
            )
        adapter.set_period(period)
        return period

    def _wire(self, adapter: Adapter, model: System | None) -> None:
        """The names of the spec looked up in the environment."""
        config, known = self.config, {s.name: s for s in adapter.state}
        starts = dict(zip(known, np.cumsum([0, *(s.size for s in adapter.state)])[:-1].tolist(), strict=True))
        for name, target in config.states.items():
            if target not in known or known[target].kind == "quaternion":
                has = ", ".join(n for n, s in known.items() if s.kind != "quaternion")
                raise UsageError(f"backend.states.{name}: {config.env} has no '{target}'; it has {has}")
        order = (
            list(config.states) if model is None else self._order("states", list(config.states), [s.name for s in model.states])
        )
        self.states = self._axes("states", order, {n: known[t] for n, t in config.states.items()}, model)
        self._seen = np.array([starts[config.states[n]] for n in order], dtype=np.intp)
        others = [s for s in adapter.state if s.name not in config.states.values()]
        self._unseen = np.array([starts[s.name] + k for s in others for k in range(s.size)], dtype=np.intp)
        self.hidden, self.hidden_default = tuple(others), tuple(adapter.rest[k] for k in self._unseen)
        self._wire_inputs(adapter, model)
        able: dict[_Option, object] = {"hidden": self.hidden, "parameters": self.parameters}
        self.capabilities = frozenset(name for name, what in able.items() if what)

    def _wire_inputs(self, adapter: Adapter, model: System | None) -> None:
        config, known = self.config, {s.name: s for s in adapter.action}
        named = {n: t.action if isinstance(t, Levels) else t for n, t in config.inputs.items()}
        for name, target in named.items():
            if target not in known:
                raise UsageError(f"backend.inputs.{name}: {config.env} has no action '{target}'; it has {', '.join(known)}")
            if isinstance(config.inputs[name], Levels) and adapter.levels is None:
                raise UsageError(f"backend.inputs.{name}: '{target}' is continuous; expected its name alone; leave out levels")
        order = list(named) if model is None else self._order("inputs", list(named), [s.name for s in model.inputs])
        self.inputs = self._axes("inputs", order, {n: known[t] for n, t in named.items()}, model)
        if adapter.levels is not None and len(order) != 1:
            raise UsageError(
                f"backend.inputs: the actions of {config.env} are numbered; expected one input, {', '.join(known)}"
            )
        places = list(known)
        self._acts = np.array([places.index(named[n]) for n in order], dtype=np.intp)
        self._width = len(places)
        self._levels: dict[int, float] | None = None
        if adapter.levels is not None:
            asked = config.inputs[order[0]]
            given = dict(adapter.levels)
            if isinstance(asked, Levels):
                if extra := sorted(set(asked.levels) - set(given)):
                    raise UsageError(
                        f"backend.inputs.{order[0]}.levels: there is no action {extra[0]}; expected some of {sorted(given)}"
                    )
                given = dict(asked.levels)
            self._levels = dict(sorted(given.items(), key=lambda item: item[1]))

    def _order(self, section: str, given: list[str], wanted: list[str]) -> list[str]:
        if extra := [n for n in given if n not in wanted]:
            raise UsageError(f"backend.{section}: the model has no '{extra[0]}'; it has {', '.join(wanted) or 'none'}")
        if missing := [n for n in wanted if n not in given]:
            raise UsageError(f"backend.{section}: '{missing[0]}' of the model is missing; add it")
        return wanted

    def _axes(
        self, section: str, order: list[str], own: Mapping[str, StateSpec], model: System | None
    ) -> tuple[StateSpec, ...]:
        """The model's axes, whose units must be the environment's, or the environment's own; a unit of 1 says nothing."""
        if model is None:
            return tuple(StateSpec(n, own[n].unit, own[n].kind) for n in order)
        axes = model.states if section == "states" else model.inputs
        for spec in axes:
            unit = own[spec.name].unit
            try:
                same = unit == "1" or abs(magnitude(f"1 {spec.unit}", unit) - 1) <= 1e-12
            except ValueError:
                same = False
            if not same:
                raise UsageError(
                    f"backend.{section}.{spec.name}: the model gives it in {spec.unit}, but {own[spec.name].name} of "
                    f"{self.config.env} is in {unit}; use {unit} in the model"
                )
        return axes

    # Steps

    def _step(self, x: Array, u: Array, **options: Any) -> Step:
        full = np.empty((len(x), len(self._seen) + len(self._unseen)))
        full[:, self._seen] = x
        full[:, self._unseen] = options.get("hidden", 0.0)
        given: dict[str, Array] = dict(options.get("parameters", {}))
        check_ranges(type(self).__name__, self.parameters, given)
        rows = np.stack(list(given.values()), axis=1) if given else None
        out, actions = np.empty_like(full), self._actions(u)
        with self._lock:
            adapter = self._ready()
            adapter.adjust(self._nominal)
            for k in range(len(full)):
                if rows is not None and (k == 0 or (rows[k] != rows[k - 1]).any()):
                    adapter.adjust(self._nominal | dict(zip(given, rows[k].tolist(), strict=True)))
                out[k] = adapter.step(full[k], actions[k])
        return Step(out[:, self._seen], out[:, self._unseen] if self.hidden else None)

    def _actions(self, u: Array) -> list[Any]:
        """Inputs (n, nu) as the environment's actions."""
        if self._levels is not None:
            levels, numbers = np.array(list(self._levels.values())), list(self._levels)
            nearest = np.argmin(np.abs(u - levels), axis=1)
            return [numbers[k] for k in nearest]
        actions = np.zeros((len(u), self._width))
        actions[:, self._acts] = u
        return list(actions)

    def _ready(self) -> Adapter:
        if self._adapter is None:
            self._adapter = self._made()
            self._adapter.set_period(self.period)
        return self._adapter
