"""Options of backend `pybullet`; the defaults are PyBullet's own physics, with its default velocity motors off."""

from __future__ import annotations

from typing import Any, Literal, final

from pydantic import Field, FiniteFloat

from gapcert_engines import Coefficient, EngineConfig

BY_DEFAULT = 0.04  # 1/s: Bullet's drag where nothing is said


@final
class PyBulletConfig(EngineConfig):
    """Besides what every engine understands: Bullet's drag on every link (`linear_damping`, `angular_damping`), whether the
    file's inertia is used, whether joints stop at the file's limits (`joint_limits`), contacts of the robot with itself,
    `friction` of all its links (the ground's is multiplied by it), iterations of the solver and the residual at which it stops.
    """

    kind: Literal["pybullet"] = "pybullet"
    linear_damping: Coefficient = Field(BY_DEFAULT, description="Bullet's drag on every link, in 1/s")
    angular_damping: Coefficient = Field(BY_DEFAULT, description="the same for rotations, in 1/s")
    use_inertia_from_file: bool = Field(True, description="or that of the collision shapes?")
    joint_limits: bool = Field(True, description="do joints stop at the file's limits?")
    gravity: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field((0.0, 0.0, -9.81), description="[x, y, z] in m/s²")
    tiles: int = Field(default=16, ge=1, le=120, description="copies that are stepped at once; never changes an answer")
    self_collision: bool = Field(False, description="may the robot touch itself?")
    friction: Coefficient | None = Field(
        None, description="coefficient of all links; the ground's is multiplied by it; default: the file's, or 0.5"
    )
    solver_iterations: int = Field(default=50, ge=1, description="of constraints, at most")
    solver_residual: Coefficient = Field(1e-7, description="at which the solver stops")

    @property
    def touches(self) -> bool:
        """Can the robot touch anything?"""
        return self.self_collision or self.ground is not None

    def settings(self) -> dict[str, tuple[Any, ...]]:
        drag = {"linear_damping": 0.0, "angular_damping": 0.0}
        return {
            **super().settings(),
            "damping": (drag if self.linear_damping or self.angular_damping else dict.fromkeys(drag, BY_DEFAULT),),
            "joint_damping": (0.0,) if self.joint_damping != 0.0 else (),
            "use_inertia_from_file": (not self.use_inertia_from_file,),
            **({"solver_iterations": (10, 200), "friction": (0.5, 1.0)} if self.touches else {}),
        }
