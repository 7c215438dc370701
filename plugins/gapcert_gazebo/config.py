"""Options of backend `gazebo`; what a spec leaves out is the world's, and where that is silent Gazebo's own default."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import Field, FiniteFloat

from gapcert_engines import EngineConfig

_CANDIDATES: dict[str, tuple[Any, ...]] = {
    "gravity": ((0.0, 0.0, -9.81), (0.0, 0.0, -9.8)),
    "joint_damping": (0.0,),
    "coulomb_friction": (0.0,),
    "collision_detector": ("ode", "bullet", "dart", "fcl"),
    "solver": ("dantzig", "pgs"),
}


@final
class GazeboConfig(EngineConfig):
    """The options of every engine, and Gazebo's own. `robot` is an SDF file with a world, or with one model.

    `model` names the robot where more than one model could be it; everything else in the world is static. `coulomb_friction`
    replaces the dry friction of all joints. `collision_detector` (Gazebo: ode) and `solver` (dantzig) decide contacts.
    """

    kind: Literal["gazebo"] = "gazebo"
    model: str | None = Field(None, description="the robot, where more than one model of the file could be it")
    coulomb_friction: Annotated[FiniteFloat, Field(ge=0)] | None = Field(
        None, description="dry friction of all joints, in N·m or N; default: the file's"
    )
    collision_detector: Literal["ode", "bullet", "dart", "fcl"] | None = Field(
        None, description="what finds contacts; default: ode"
    )
    solver: Literal["dantzig", "pgs"] | None = Field(None, description="what solves contacts; default: dantzig")

    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Sub-steps, gravity (SDF's default is 9.8), damping, friction and the contact solver."""
        return super().settings() | self.others(_CANDIDATES)
