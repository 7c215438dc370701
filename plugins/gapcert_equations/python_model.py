"""The `python` model: a user's NumPy function as x⁺ = f(x, u, **parameters)."""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, final

import numpy as np

from gapcert import Array, Context, Interval, Model, UsageError
from gapcert.plugin import Extension

from .build import declared
from .config import PythonConfig

_CUBE_ROOT = float(np.finfo(np.float64).eps) ** (1 / 3)


@final
class PythonModel(Model):
    """f from `module:function`, looked up beside the spec first, then among the installed modules.

    `jacobian` is the user's, else central differences with an error of order h² = (eps^⅓ max(1, |z|))². Enclosures need
    `intervals: true`, which says that the functions take and return Intervals as well.
    """

    def __init__(self, config: PythonConfig, folder: Path) -> None:
        self.config, self.folder = config, folder
        self.states, self.inputs, self.parameters, self.period = declared(config)
        self.outputs = self.states
        self.capabilities = frozenset({"parameters"})
        self._function = _look_up(config.function, folder)
        self._jacobian = None if config.jacobian is None else _look_up(config.jacobian, folder)

    @classmethod
    def from_config(cls, config: PythonConfig, context: Context) -> PythonModel:
        """UsageError unless the user allowed code."""
        if not context.allow_code:
            raise UsageError(
                f"model.function: '{config.function}' is code, which a spec may not run by itself; "
                "read it, and pass --allow-code if you trust it"
            )
        return cls(config, context.folder)

    def __reduce__(self) -> tuple[Any, ...]:
        return PythonModel, (self.config, self.folder)

    def digest(self) -> str:
        """Of the config and of the source files of the functions."""
        sources = [inspect.getsource(inspect.getmodule(f) or f) for f in (self._function, self._jacobian) if f is not None]
        return hashlib.sha256("\n".join([json.dumps(self.to_spec()), *sources]).encode()).hexdigest()

    @property
    def _values(self) -> dict[str, float]:
        return {p.name: p.value for p in self.parameters}

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        overrides = options.get("parameters")
        if not overrides:
            return self._call(x, u, {})
        # One call per distinct set of values: the user's function sees plain numbers.
        sets, which = np.unique(np.stack(list(overrides.values()), axis=1), axis=0, return_inverse=True)
        out = np.empty_like(x)
        for k, values in enumerate(sets):
            rows = which.reshape(-1) == k
            out[rows] = self._call(x[rows], u[rows], dict(zip(overrides, map(float, values), strict=True)))
        return out

    def _call(self, x: Array, u: Array, overrides: dict[str, float]) -> Array:
        try:
            new = np.asarray(self._function(x.copy(), u.copy(), **self._values | overrides), dtype=np.float64)
        except Exception as error:  # the user's function may fail in any way, and the fault is not ours
            raise UsageError(
                f"{self.config.function}: raised {type(error).__name__}: {error}; it gets x {x.shape}, u {u.shape} and the "
                f"parameters by name, and returns the next x"
            ) from error
        if new.shape != x.shape:
            raise UsageError(f"{self.config.function}: returned shape {new.shape}; expected {x.shape}, one row per state")
        return new

    def jacobian(self, x: Array, u: Array) -> Array:
        """The given Jacobian, else central differences."""
        z = np.concatenate([self._batch("x", x, self.nx), self._batch("u", u, self.nu)], axis=1)
        if self._jacobian is not None:
            return np.asarray(self._jacobian(z[:, : self.nx], z[:, self.nx :], **self._values), dtype=np.float64)
        columns = []
        for j in range(z.shape[1]):
            high, low = z.copy(), z.copy()
            reach = _CUBE_ROOT * np.maximum(1.0, np.abs(z[:, j]))
            high[:, j] += reach
            low[:, j] -= reach
            rise = self._call(high[:, : self.nx], high[:, self.nx :], {}) - self._call(low[:, : self.nx], low[:, self.nx :], {})
            columns.append(rise / (high[:, j] - low[:, j])[:, None])
        return np.stack(columns, axis=-1)

    def enclosure(self, z: Interval) -> Interval:
        """The function itself on Intervals, where the section says that it takes them."""
        return self._over_boxes(self._function, "function", z, (len(z), self.nx))

    def jacobian_enclosure(self, z: Interval) -> Interval:
        """The given Jacobian on Intervals."""
        return self._over_boxes(self._jacobian, "jacobian", z, (len(z), self.nx, self.nx + self.nu))

    def _over_boxes(self, function: Callable[..., Any] | None, name: str, z: Interval, shape: tuple[int, ...]) -> Interval:
        if function is None or not self.config.intervals:
            raise UsageError(
                f"model.{name}: a Python function says nothing about its range over a box; use kind: equations, "
                f"or give {name} in a form that takes Intervals, with intervals: true"
            )
        out = function(z[:, : self.nx], z[:, self.nx :], **self._values)
        if not isinstance(out, Interval) or out.shape != shape:
            found = f"an Interval of shape {out.shape}" if isinstance(out, Interval) else type(out).__name__
            raise UsageError(f"model.{name}: returned {found} for Intervals; expected an Interval of shape {shape}")
        return out

    def extend(self, extensions: Sequence[Extension]) -> Model:
        """UsageError: code has no expressions that an effect could be written into."""
        if not extensions:
            return self
        raise UsageError(f"effect '{extensions[0].effect}': a Python function cannot be extended; use kind: equations")

    def sites(self, kind: str) -> tuple[str, ...]:
        """Its parameters."""
        return tuple(p.name for p in self.parameters) if kind == "parameter" else ()

    def equations(self) -> str:
        """The source of the function."""
        return inspect.getsource(self._function)

    def to_spec(self) -> dict[str, Any]:
        """The section, without defaults."""
        return self.config.model_dump(mode="json", exclude_defaults=True)


def _look_up(target: str, folder: Path) -> Callable[..., Any]:
    module, _, name = target.partition(":")
    beside = folder.joinpath(*module.split(".")).with_suffix(".py").resolve()
    try:
        found: object = getattr(_from_file(beside) if beside.is_file() else importlib.import_module(module), name, None)
    except ImportError as error:
        raise UsageError(
            f"model: cannot import '{module}' ({error}); expected {beside.name} beside the spec, or an installed module"
        ) from None
    if not callable(found):
        raise UsageError(f"model: '{module}' has no function '{name}'; define it, or correct the name")
    return found


def _from_file(path: Path) -> ModuleType:
    """A module under a name of its own, so that a user's `math.py` shadows nobody's."""
    name = "gapcert_user_" + hashlib.sha256(str(path).encode()).hexdigest()[:12] + "_" + path.stem
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    finally:
        sys.path.remove(str(path.parent))
    return module
