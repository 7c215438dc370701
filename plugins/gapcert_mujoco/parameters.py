"""Native parameters as numbers in a model, and the models that differ in them."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, final

import mujoco
import numpy as np

from gapcert import Parameter
from gapcert_engines import Engine, Joint

from .robot import joint_name, scalar, touches

_FRICTION = {"friction": 1, "spinning_friction": 4, "rolling_friction": 6}
"""Factors on the friction of all contacts, in the order of MuJoCo's columns, and the least `condim` that has it."""
_KEPT = 16
"""Models with other parameters that are kept."""


@final
class Natives:
    """Where the native parameters of `one` robot stand in a model of `copies` of it.

    Gravity; of each hinge and slide the damping (its linear part), dry friction and armature; of each body that moves its
    mass, with the inertia in proportion, the place of its centre of mass in its frame, and the largest principal moment about
    it at the stated mass, with the others in proportion, so that every value is some body's; and, where bodies may touch, a
    factor on the sliding friction of all contacts (on the spinning and rolling one, where the file has such), and the time
    constant and damping ratio of all contacts, where one pair of positive numbers holds for all geoms. MuJoCo takes no time
    constant below two time steps.
    """

    def __init__(self, one: Any, copies: int = 1) -> None:
        self.parameters = list(Engine.gravity_parameters(one.opt.gravity.tolist()))
        self._places: list[tuple[str, str, Any]] = []
        again = np.arange(copies)
        for k in np.flatnonzero(scalar(one)).tolist():
            dof, slides = int(one.jnt_dofadr[k]), one.jnt_type[k] == mujoco.mjtJoint.mjJNT_SLIDE
            joint = Joint(joint_name(one, k), "prismatic" if slides else "revolute")
            for what in ("damping", "frictionloss", "armature"):
                own = float(getattr(one, f"dof_{what}")[dof])
                self._add(Engine.joint_parameter(what, joint, own), f"dof_{what}", dof + one.nv * again)
        for k in range(1, one.nbody):
            # A body that is welded to the world has no part in the motion.
            if one.body_mass[k] > 0 and one.body_weldid[k]:
                mass, name = float(one.body_mass[k]), one.body(k).name or f"body{k}"
                places = k + (one.nbody - 1) * again
                self._add(Parameter(f"mass.{name}", mass, "kg", low=1e-3 * mass, high=1e3 * mass), "body_mass", places)
                # Of a simple body MuJoCo takes for granted that the centre of mass is its origin.
                for axis, a in enumerate("" if one.body_simple[k] else "xyz"):
                    self._add(Parameter(f"com_{a}.{name}", float(one.body_ipos[k, axis]), "m"), "body_ipos", (places, axis))
                moment = float(one.body_inertia[k].max())
                least, most = 1e-3 * moment, 1e3 * moment
                self._add(Parameter(f"inertia.{name}", moment, "kg*m^2", low=least, high=most), "body_inertia", places)
        self.frictional = touches(one)
        if self.frictional:
            self.parameters += [
                Parameter(name, 1.0, low=0.0) for name, size in _FRICTION.items() if one.geom_condim.max() >= size
            ]
            springs = np.unique(np.concatenate([one.geom_solref, one.pair_solref.reshape(-1, 2)]), axis=0)
            if len(springs) == 1 and (springs > 0).all():
                time, ratio = springs[0].tolist()
                self.parameters += [
                    Parameter("contact_time", time, "s", low=1e-6),
                    Parameter("contact_damping", ratio, low=1e-3),
                ]
        self._stated = {p.name: p.value for p in self.parameters}
        self._made: dict[tuple[float, ...], tuple[Any, Any]] = {}

    def _add(self, parameter: Parameter, field: str, places: Any) -> None:
        self.parameters.append(parameter)
        self._places.append((parameter.name, field, places))

    @staticmethod
    def dry(values: Mapping[str, float]) -> bool:
        """Has any joint dry friction?"""
        return any(v > 0 for name, v in values.items() if name.startswith("frictionloss."))

    def varied(self, model: Any, values: Mapping[str, float]) -> Any:
        """A copy of the model, as it was compiled, with these values; the last few are kept, for runs ask at every step."""
        key = tuple(values[p.name] for p in self.parameters)
        of, made = self._made.get(key, (None, None))
        if of is not model:
            made = self._changed(model, values)
            if len(self._made) == _KEPT:
                del self._made[next(iter(self._made))]
            self._made[key] = model, made
        return made

    def _changed(self, model: Any, values: Mapping[str, float]) -> Any:
        model = copy.copy(model)
        model.opt.gravity = [values[f"gravity_{a}"] for a in "xyz"]
        derived = False
        for name, field, places in self._places:
            if values[name] == self._stated[name]:
                continue
            if field in ("body_mass", "body_inertia"):
                model.body_inertia[places] *= values[name] / self._stated[name]
            if field != "body_inertia":
                getattr(model, field)[places] = values[name]
            if field == "body_ipos":
                self._unframe(model, places[0])
            derived |= field.startswith("body_") or field == "dof_armature"
        if self.frictional:
            self._touch(model, values)
        if derived:
            mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    @staticmethod
    def _unframe(model: Any, bodies: Any) -> None:
        """What MuJoCo takes to be where a centre of mass is, and need not be any more, is computed."""
        model.body_sameframe[bodies] = 0
        model.geom_sameframe[np.isin(model.geom_bodyid, bodies)] = 0
        model.site_sameframe[np.isin(model.site_bodyid, bodies)] = 0

    def _touch(self, model: Any, values: Mapping[str, float]) -> None:
        """What decides contacts."""
        for k, (name, pair) in enumerate(zip(_FRICTION, (slice(0, 2), 2, slice(3, 5)), strict=True)):
            if name in values:
                model.geom_friction[:, k] *= values[name]
                model.pair_friction[:, pair] *= values[name]
        for k, name in enumerate(("contact_time", "contact_damping")):
            if name in values and values[name] != self._stated[name]:
                model.geom_solref[:, k] = model.pair_solref[:, k] = values[name]
