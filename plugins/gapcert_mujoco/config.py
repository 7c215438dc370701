"""Options of backend `mujoco`; what a spec leaves out is the file's, and where the file is silent MuJoCo's own default."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import Field, FiniteFloat

from gapcert_engines import Coefficient, EngineConfig

Positive = Annotated[FiniteFloat, Field(gt=0)]


@final
class MuJoCoConfig(EngineConfig):
    """The options of every engine, and MuJoCo's own. `robot` is an MJCF or a URDF file.

    `integrator` (MuJoCo: Euler, which is semi-implicit), `euler_damping`: implicit (MuJoCo) or explicit joint damping in Euler.
    `contact: false` lets geoms pass through each other. `solver` (Newton), `iterations` (100), `tolerance` (1e-8), `cone`
    (pyramidal), `impratio` (1) and `noslip_iterations` (0) decide contacts, limits and dry friction. `frictionloss` and
    `armature` replace those of all joints, as `joint_damping` does. `threads` share the rows of a query. Neither `threads` nor
    `tiles` changes an answer. `implementation: mjx` is MuJoCo XLA in place of the C code: `tiles` rows at once, on a GPU where
    JAX finds one, of robots that touch nothing; in the last bits its answers depend on `tiles`.
    """

    kind: Literal["mujoco"] = "mujoco"
    integrator: Literal["Euler", "RK4", "implicit", "implicitfast", "discrete"] | None = Field(
        None, description="default: the file's, or Euler (semi-implicit)"
    )
    euler_damping: Literal["implicit", "explicit"] | None = Field(
        None, description="is joint damping solved with the step? default: implicit"
    )
    contact: bool = Field(True, description="may geoms touch?")
    solver: Literal["PGS", "CG", "Newton"] | None = Field(None, description="of constraints; default: the file's, or Newton")
    iterations: Annotated[int, Field(ge=1)] | None = Field(
        None, description="of the solver, at most; default: the file's, or 100"
    )
    tolerance: Coefficient | None = Field(None, description="at which the solver stops; default: the file's, or 1e-8")
    cone: Literal["pyramidal", "elliptic"] | None = Field(None, description="friction cone; default: the file's, or pyramidal")
    impratio: Positive | None = Field(
        None, description="impedance of friction to that of the normal force; default: the file's, or 1"
    )
    noslip_iterations: Annotated[int, Field(ge=0)] | None = Field(None, description="default: the file's, or 0")
    frictionloss: Coefficient | None = Field(None, description="dry friction of all joints, in N·m or N; default: the file's")
    armature: Coefficient | None = Field(None, description="inertia of all joints, in kg·m² or kg; default: the file's")
    implementation: Literal["c", "mjx"] = Field("c", description="MuJoCo's C code, or MuJoCo XLA")
    tiles: int = Field(default=256, ge=1, description="copies that are stepped at once")
    threads: int = Field(default=1, ge=1, description="threads that share the rows of a query")

    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Integrator, sub-steps, damping, friction and the contact solver: what most often separates MuJoCo from another."""
        return super().settings() | self.others(
            {
                "integrator": ("Euler", "implicitfast", "implicit", "RK4"),
                "euler_damping": ("explicit", "implicit"),
                "joint_damping": (0.0,),
                "frictionloss": (0.0,),
                "armature": (0.0,),
                "cone": ("elliptic", "pyramidal"),
                "impratio": (1.0, 10.0, 100.0),
                "noslip_iterations": (0, 5),
            }
        )
