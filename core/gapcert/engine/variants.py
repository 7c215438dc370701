"""An engine model under other settings: of the engine itself, and of how its equations are stepped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from gapcert.components import Context, registry
from gapcert.errors import UsageError
from gapcert.options import changed, declared, flat, short
from gapcert.system import Variant

if TYPE_CHECKING:
    from gapcert.engine.simulation import EngineModel

PHYSICAL = {"joint_damping", "coulomb_friction", "frictionloss", "armature", "gravity", "friction", "restitution"}
"""Options that are native parameters of joints and contacts: causes of their own."""
SUBSTEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20)
SCHEMES = ("semi_implicit", "euler", "rk4")
STEPS = (1 / 240, 0.002, 0.001)
"""s: what PyBullet, MuJoCo, and DART and Gazebo step by where nothing is said."""


def variants(model: EngineModel) -> Sequence[Variant]:
    """Each declared option of the engine's that changes its motion, the sub-steps, and what no option of it says: other
    integrators, and a step of another length taken for the period."""
    return [*_options(model), *_schemes(model)]


def _options(model: EngineModel) -> Iterator[Variant]:
    config: Any = model.backend.config
    have, own = flat(config), model.text()
    options = [(name, o) for name, o in declared(config) if name not in PHYSICAL | {"substeps"}]
    options += [("substeps", {"substeps": k}) for k in SUBSTEPS if k != config.substeps]
    here = {"robot": model.backend.engine.file, "period": f"{model.period!r} s"}
    for name, new in options:
        try:
            # One copy: to see whether more would give the same bits costs more than they would gain here.
            section = changed(config, {**new, **here, "tiles": 1})
            backend = registry().build("backend", config.kind, section, Context())
            known = {p.name for p in backend.parameters}
            # What an option sets anew is not what the spec has stated of it.
            other = type(model)(backend, [p for p in model.stated() if p.name in known], otherwise=model.otherwise)
        except UsageError:
            continue
        if other.text() != own:
            yield Variant(name, short(new), short({k: have.get(k) for k in new}), other)


def _schemes(model: EngineModel) -> Iterator[Variant]:
    config: Any = model.backend.config
    now = model.text()
    changes: list[tuple[str, Any, Any, dict[str, Any]]] = []
    if "integrator" not in type(config).model_fields:
        was = now["integrator"]
        changes += [("integrator", s, was, {"integrator": s}) for s in SCHEMES if s != was]
    if "period" not in model.otherwise:
        step = model.period / config.substeps
        changes += [
            ("time_step", s, step, {"period": f"{s * config.substeps!r} s"}) for s in STEPS if abs(s - step) > 1e-9 * step
        ]
    for name, value, was, otherwise in changes:
        other = type(model)(model.backend, model.stated(), otherwise={**model.otherwise, **otherwise})
        yield Variant(name, value, was, other)
