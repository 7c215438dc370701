"""Options of backend `drake`; what a spec leaves out is the file's, and where the file is silent Drake's own default."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import Field, FiniteFloat, model_validator

from gapcert_engines import Coefficient, EngineConfig

FIXED_STEP = ("explicit_euler", "semi_explicit_euler", "runge_kutta2")
"""Integrators without control of their error: one step per sub-step."""
APPROXIMATIONS = ("lagged", "similar", "sap", "tamsi")


@final
class DrakeConfig(EngineConfig):
    """The options of every engine, and Drake's own. `robot` is a URDF, SDF or MJCF file; `model` names one of an SDF's.

    `integrator: discrete` steps the plant's own discrete update, semi-implicit Euler with implicit joint damping, once per
    sub-step; any other integrates the continuous plant, `explicit_euler`, `semi_explicit_euler` and `runge_kutta2` with one
    step per sub-step, `runge_kutta3`, `bogacki_shampine3`, `runge_kutta5`, `implicit_euler` and `radau3` to an `accuracy`,
    with no step longer than a sub-step. `joint_limits` (on where the file has them) need the discrete plant. Drake has no dry
    friction in joints: `coulomb_friction: 0` says that the file's is to be left out. Contacts: `contact_model`,
    `contact_approximation` (of the discrete plant) and `friction` of all shapes of the robot; Drake combines two coefficients
    to 2 a b / (a + b). `self_collision` lets the robot touch itself.
    """

    kind: Literal["drake"] = "drake"
    model: str | None = Field(None, description="which model of an SDF; default: its only one")
    integrator: Literal[
        "discrete",
        "explicit_euler",
        "semi_explicit_euler",
        "runge_kutta2",
        "runge_kutta3",
        "bogacki_shampine3",
        "runge_kutta5",
        "implicit_euler",
        "radau3",
    ] = Field("discrete", description="the plant's own discrete update, or an integrator of the continuous plant")
    accuracy: Annotated[FiniteFloat, Field(gt=0, le=0.1)] = Field(
        1e-10, description="of an integrator that controls its error, relative"
    )
    joint_limits: bool = Field(True, description="those of the file; the discrete plant alone has them")
    coulomb_friction: Annotated[FiniteFloat, Field(ge=0, le=0)] | None = Field(
        None, description="0: leave out the dry friction of the file's joints, which Drake does not have"
    )
    friction: Coefficient | None = Field(None, description="coefficient of all shapes of the robot; default: the file's")
    contact_model: Literal["point", "hydroelastic", "hydroelastic_with_fallback"] = Field(
        "hydroelastic_with_fallback", description="how contact forces come about"
    )
    contact_approximation: Literal["lagged", "similar", "sap", "tamsi"] = Field(
        "lagged", description="how the discrete plant solves contacts"
    )
    self_collision: bool = Field(False, description="may the robot touch itself?")
    tiles: int = Field(default=64, ge=1, description="copies that are stepped at once; never changes an answer")

    @model_validator(mode="after")
    def _discrete_alone(self) -> DrakeConfig:
        if not self.discrete and "contact_approximation" in self.model_fields_set:
            raise ValueError("contact_approximation is of the discrete plant; leave it out, or integrator")
        if not self.discrete and "joint_limits" in self.model_fields_set and self.joint_limits:
            raise ValueError("joint_limits need the discrete plant: the continuous one has none; leave out integrator")
        return self

    @property
    def discrete(self) -> bool:
        return self.integrator == "discrete"

    @property
    def touches(self) -> bool:
        """Can the robot touch anything?"""
        return self.self_collision or self.ground is not None

    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Sub-steps, integrator, damping and limits of the joints, and what decides contacts where there can be any."""
        candidates: dict[str, tuple[Any, ...]] = {"joint_damping": (0.0,), "integrator": ("discrete", "runge_kutta3")}
        if self.discrete:
            candidates["joint_limits"] = (False, True)
        if self.touches:
            candidates |= {"friction": (0.5, 1.0), "contact_model": ("point", "hydroelastic_with_fallback")}
            candidates |= {"contact_approximation": APPROXIMATIONS} if self.discrete else {}
        return super().settings() | self.others(candidates)
