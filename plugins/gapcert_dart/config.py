"""Options of backend `dart`; what a spec leaves out is the file's, and where the file is silent DART's own default."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import Field, FiniteFloat

from gapcert_engines import Coefficient, EngineConfig

_COARSE = 1e-3
DETECTORS = ("fcl", "dart", "bullet", "ode")
SOLVERS = ("dantzig", "pgs", "nsgs", "fbf")


@final
class DartConfig(EngineConfig):
    """The options of every engine, and DART's own. `robot` is a URDF file, or an SDF file whose first model, or the one named
    `model`, is taken.

    DART has one integrator, semi-implicit Euler with implicit joint damping. `joint_limits` (DART: as its readers say, off for
    URDF and on for SDF), `coulomb_friction` of all joints (the file's), `friction` (1) and `restitution` (0) of all shapes; a
    contact has the smaller friction of its two shapes. `collision_detector` (fcl), `lcp_solver` (dantzig; nsgs and fbf have a
    round friction cone) and `split_impulse` (off: a penetration is pushed out through the velocity) decide contacts.
    `self_collision` lets the robot touch itself.
    """

    kind: Literal["dart"] = "dart"
    model: str | None = Field(None, description="of an SDF file, the model that is the robot; default: the first")
    joint_limits: bool | None = Field(
        None, description="do joints stop at the file's limits? default: no for URDF, yes for SDF"
    )
    coulomb_friction: Coefficient | None = Field(
        None, description="dry friction of all joints, in N·m or N; default: the file's"
    )
    friction: Coefficient | None = Field(None, description="coefficient of all shapes; default: the file's, or 1")
    restitution: Annotated[FiniteFloat, Field(ge=0, le=1)] | None = Field(
        None, description="of all shapes; default: the file's, or 0"
    )
    collision_detector: Literal["fcl", "dart", "bullet", "ode"] = Field("fcl", description="what finds contacts")
    lcp_solver: Literal["dantzig", "pgs", "nsgs", "fbf"] = Field(
        "dantzig", description="what solves contacts; nsgs and fbf have a round friction cone"
    )
    lcp_tolerance: Annotated[FiniteFloat, Field(gt=0)] = Field(
        1e-5, description="relative error at which nsgs and fbf stop; DART's own"
    )
    split_impulse: bool = Field(False, description="is a penetration pushed out beside the velocity?")
    self_collision: bool = Field(False, description="may the robot touch itself?")
    tiles: int = Field(default=128, ge=1, description="copies that are stepped at once; never changes an answer")

    @property
    def touches(self) -> bool:
        """Can the robot touch anything?"""
        return self.self_collision or self.ground is not None

    def unsaid(self) -> set[str]:
        return {"lcp_tolerance"} if self.lcp_tolerance == 1e-5 else set()

    def coarse(self) -> dict[str, Any]:
        """Where a contact slides, nsgs and fbf take ten times as long for the last two digits."""
        return {"lcp_tolerance": _COARSE} if self.lcp_solver in ("nsgs", "fbf") and self.lcp_tolerance < _COARSE else {}

    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Sub-steps, damping, dry friction and limits of the joints, and what decides contacts where there can be any."""
        candidates: dict[str, tuple[Any, ...]] = {
            "joint_damping": (0.0,),
            "coulomb_friction": (0.0,),
            "joint_limits": (False, True),
        }
        if self.touches:
            candidates |= {
                "friction": (0.5, 1.0),
                "restitution": (0.0, 0.5),
                "collision_detector": DETECTORS,
                "lcp_solver": SOLVERS,
                "split_impulse": (False, True),
            }
        return super().settings() | self.others(candidates)
