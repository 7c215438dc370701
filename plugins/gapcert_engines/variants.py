"""An engine model under other settings: of the engine itself, and of how its equations are stepped."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from gapcert.plugin import Context, UsageError, Variant, registry

from .settings import changed, declared, flat, short
from .uncertain_parameters import DAMPING, felt, known

if TYPE_CHECKING:
    from .equations_model import EngineModel

PHYSICAL = {"joint_damping", "coulomb_friction", "frictionloss", "armature", "gravity", "friction", "restitution"}
"""Options that are native parameters of joints and contacts: causes of their own."""
SUBSTEPS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20)
SCHEMES = ("semi_implicit", "euler", "rk4")
STEPS = (1 / 240, 0.002, 0.001)
"""s: what PyBullet, MuJoCo, and DART and Gazebo step by where nothing is said."""
POINT = 2e-6 / 3
"""m²: inertia per mass that Bullet gives a link without shapes, a box of 2 mm."""
DRAG = 0.04
"""1/s: by which Bullet damps every link, linearly and by the square, where nothing is said."""
IMPEDANCE, STIFFEST, CONSTANT = 0.9, 0.95, 0.02
"""Of MuJoCo's constraints where nothing is said: at rest, at most, and their time constant in s."""


def variants(model: EngineModel) -> Sequence[Variant]:
    """Each declared option of the engine's that changes its motion, the sub-steps, and what no option of it says: other
    integrators, a step of another length taken for the period, the drag of links, and dry friction that gives way or holds."""
    return [*_options(model), *_otherwise(model)]


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
            there = known(backend)
            # What an option sets anew is not what the spec has stated of it.
            other = model.beside(backend, [p for p in model.stated() if p.name in there])
            different = other.text() != own
            if different and not model.otherwise:
                other.confirm()
        except UsageError:
            continue
        if different:
            yield _variant(model, name, short(new), short({k: have.get(k) for k in new}), other, name)


def _otherwise(model: EngineModel) -> Iterator[Variant]:
    config: Any = model.backend.config
    now = model.text()
    for name, value, was, otherwise in [*_stepped(model, now), *_held(model, now)]:
        if name not in type(config).model_fields and not otherwise.keys() & model.otherwise.keys():
            other = model.beside(model.backend, model.stated(), {**model.otherwise, **otherwise})
            yield _variant(model, name, value, was, other)


def _variant(model: EngineModel, name: str, value: Any, was: Any, other: EngineModel, native: str | None = None) -> Variant:
    other.changed = (*model.changed, (name, value, was))
    return Variant(name, value, was, other, native)


def _stepped(model: EngineModel, now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any, dict[str, Any]]]:
    substeps, was = model.backend.substeps, now["integrator"]
    yield from (("integrator", s, was, {"integrator": s}) for s in SCHEMES if s != was)
    step = model.period / substeps
    yield from (("time_step", s, step, {"period": f"{s * substeps!r} s"}) for s in STEPS if abs(s - step) > 1e-9 * step)


def _held(model: EngineModel, now: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any, dict[str, Any]]]:
    """Bullet's drag of links, and friction solved as a soft constraint, as MuJoCo does, or as a hard one."""
    bodies = now["bodies"]
    fields = type(model.backend.config).model_fields
    if not any(b.get("drag") for b in bodies.values()) and "linear_damping" not in fields:
        drag = {"linear": [DRAG, DRAG], "angular": [DRAG, DRAG]}
        yield "damping", DRAG, 0.0, {"bodies": {name: {**b, "drag": drag} for name, b in bodies.items()}}
    if "use_inertia_from_file" not in fields:
        # The masses are parameters, or nothing.
        points = {n: {**b, "inertia": [f"{POINT!r}*{b['mass']}*metre**2"] * 3} for n, b in bodies.items() if _heavy(b)}
        yield "use_inertia_from_file", False, True, {"bodies": bodies | points}
    if not any("_dot" in text for text in now.get("forces", {}).values()):
        # Of damping that a diagnosis finds; what the file states is solved as the engine does it.
        yield DAMPING, not model.implicit(), model.implicit(), {DAMPING: not model.implicit()}
    if now.get("soft_friction"):
        yield "dry_friction", "hard", "soft", {"soft_friction": {}}
    else:
        rate = 2 / (STIFFEST * CONSTANT)
        soft = {
            q: {"compliance": (1 - IMPEDANCE) / IMPEDANCE / felt(model.inner, q), "rate": rate}
            for q in model.backend.coordinates
        }
        yield "dry_friction", "soft", "hard", {"soft_friction": soft}


def _heavy(body: Mapping[str, Any]) -> bool:
    """Is its mass a parameter? Of what moves it is."""
    return str(body.get("mass", "0")).isidentifier()
