"""The `model:` sections of kind `equations` and `python`; light, since listing and validation import it."""

from __future__ import annotations

from typing import Annotated, Any, Literal, final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, WithJsonSchema, model_validator

Problem = tuple[tuple[str | int, ...], str, int | None]


def _text(value: Any) -> Any:
    return repr(value) if isinstance(value, int | float) and not isinstance(value, bool) else value


def _number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"found {value!r}; expected a number or a quantity such as '9.81 m/s^2'")
    return value


def _unit(value: Any) -> Any:
    # YAML reads a bare 1 as a number.
    if isinstance(value, int | float) and not isinstance(value, bool):
        if value != 1:
            raise ValueError(f"found {value!r}; expected a unit such as m/s, or 1 for none")
        return "1"
    return value


Expression = Annotated[str, BeforeValidator(_text, json_schema_input_type=str | float)]
# `quantity` and `unit` tell editors what to offer.
Quantity = Annotated[float | str, BeforeValidator(_number), WithJsonSchema({"type": ["number", "string"], "quantity": ""})]
Period = Annotated[float | str, BeforeValidator(_number), WithJsonSchema({"type": ["number", "string"], "quantity": "s"})]
Unit = Annotated[str, BeforeValidator(_unit), WithJsonSchema({"anyOf": [{"type": "string", "unit": True}, {"const": 1}]})]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


@final
class Axis(_Section):
    """Unit and kind of a state, coordinate or input."""

    unit: Unit = Field("1", description="such as rad/s; 1 for none")
    kind: Literal["real", "angle"] = Field("real", description="an angle is compared modulo a turn")


@final
class ParameterConfig(_Section):
    """A stated value, a tolerance (`10 %` or absolute), and bounds; bare numbers are in the unit of the value."""

    value: Quantity = Field(description="with its unit, such as 95.1 kg")
    tolerance: Quantity | None = Field(None, description="`10 %` or absolute; default: taken at its word")
    low: Quantity | None = Field(None, description="smallest possible value; default: none")
    high: Quantity | None = Field(None, description="largest possible value; default: none")


@final
class OutputConfig(_Section):
    """y = expr; the unit and kind follow from the expression where they are not given."""

    expr: Expression = Field(description="of states, inputs and parameters")
    unit: Unit | None = Field(None, description="default: that of the expression")
    kind: Literal["real", "angle"] | None = Field(None, description="default: that of the expression")


@final
class MemoryConfig(_Section):
    """A hidden state: its unit, its value at the end of a sub-step of `h` seconds, and its value by default."""

    unit: Unit = Field("1", description="such as N")
    next: Expression = Field(description="its value after a sub-step of `h` seconds")
    start: Quantity = Field(0.0, description="its value by default")


Place = list[Expression]
Three = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


Pair = Annotated[list[Expression], Field(min_length=2, max_length=2)]


@final
class DragConfig(_Section):
    """[a, b] each: the force −m v (a + b |v|) on the centre of mass, and the torque −I ω (a + b |ω|) of a body."""

    linear: Pair = Field(["0", "0"], description="[a, b] of −m v (a + b |v|), in 1/s and 1/m")
    angular: Pair = Field(["0", "0"], description="[a, b] of −I ω (a + b |ω|), in 1/s and 1")


@final
class BodyConfig(_Section):
    """A rigid body that the coordinate `joint` turns about `axis` (an angle) or pushes along it (a length); else it is welded.

    Its frame is the joint's: at the place `at` in the frame of the body `on` (by default the world), turned by the quaternion
    `turned` (w, x, y, z). In that frame stand `axis`, `mass`, centre of mass `com`, and `inertia` about it (xx, yy, zz, and
    where they are not zero xy, xz, yz); `armature` is inertia that the joint alone feels; `lifted` is the share of its weight
    that something else carries; `drag` slows the body in the world, in proportion to its mass and inertia. Numbers in SI units,
    or expressions of parameters.
    """

    joint: str | None = Field(None, description="the coordinate that moves it; default: welded")
    on: str | None = Field(None, description="the body that carries it; default: the world")
    at: Place = Field(default=["0", "0", "0"], min_length=3, max_length=3, description="the joint's place on that body, in m")
    turned: tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        (1.0, 0.0, 0.0, 0.0), description="the joint's frame, as a quaternion w, x, y, z"
    )
    axis: Three = Field((0.0, 0.0, 1.0), description="of the joint, in its own frame")
    mass: Expression = Field("0", description="in kg")
    com: Place = Field(
        default=["0", "0", "0"], min_length=3, max_length=3, description="centre of mass in the joint's frame, in m"
    )
    inertia: list[Expression] = Field(
        default=["0", "0", "0"],
        min_length=3,
        max_length=6,
        description="about the centre of mass, xx, yy, zz (and xy, xz, yz), in kg·m²",
    )
    armature: Expression = Field("0", description="inertia that the joint alone feels, in kg·m² or kg")
    lifted: Expression = Field("0", description="share of its weight that something else carries")
    drag: DragConfig = Field(DragConfig(), description="what slows the body in the world")

    @model_validator(mode="after")
    def _directions(self) -> BodyConfig:
        if len(self.inertia) not in (3, 6):
            raise ValueError(f"inertia has {len(self.inertia)} entries; expected xx, yy, zz, or these and xy, xz, yz")
        for name, vector in (("axis", self.axis), ("turned", self.turned)):
            if not any(vector):
                raise ValueError(f"{name} is {list(vector)}; expected a direction")
        return self


@final
class Softness(_Section):
    """Dry friction that gives way: f = −(a₀ + rate·v + Σⱼ (M⁻¹)ᵢⱼ fⱼ) / compliance within its bound, so that it creeps where it
    should rest. a₀: the acceleration without friction; rate in 1/s, compliance in 1 / inertia, as MuJoCo's constraints have it.
    """

    compliance: Annotated[FiniteFloat, Field(gt=0)] = Field(description="in 1 / inertia")
    rate: Annotated[FiniteFloat, Field(gt=0)] = Field(description="in 1/s")


_MECHANICAL = ("points", "gravity", "payload", "tilt", "soft_friction", "implicit", "friction_after_damping")
Axes = dict[str, Unit | Axis]
Parameters = dict[str, Quantity | ParameterConfig]


@final
class EquationsConfig(_Section):
    """A model as text: ẋ = `derivative`, x⁺ = `next`, or M(q) v̇ + bias(q, v) = forces, with M and bias given or of `bodies`.

    Velocities of a mechanical model are named `<coordinate>_dot`. `dry_friction` is a bound F >= 0 on a force |f| <= F that
    opposes the velocity at a coordinate (or a state equation); at the coordinates of `soft_friction` it gives way. `implicit`
    is a damping D that is solved with the sub-step h: (M + h D) (v⁺ − v) = h · (right-hand side and friction); with
    `friction_after_damping` dry friction acts on the velocity that this gives without it, and does not feel h D. `input_delay`
    is a time, or an expression of parameters; so is `output_delay`, by which an output shows the past. `memory` are hidden
    states, advanced once per sub-step; every other expression of the dynamics sees their value at its beginning. `payload` is
    a point mass in kg carried at the coordinate's `points` entry, a place in m; `tilt` an angle by which gravity is turned
    along a coordinate. A derivative without `integrator` is integrated by rk4; without `period`, the period is that of the
    recording.
    """

    kind: Literal["equations"]
    states: Axes = Field(default_factory=dict, description="name → unit, or {unit, kind}, of ẋ = derivative and x⁺ = next")
    coordinates: Axes = Field(default_factory=dict, description="name → unit, or {unit, kind}, of a mechanical model")
    inputs: Axes = Field(default_factory=dict, description="name → unit")
    parameters: Parameters = Field(default_factory=dict, description="name → value with unit, or {value, tolerance, low, high}")
    derivative: dict[str, Expression] | None = Field(None, description="state → its rate")
    next: dict[str, Expression] | None = Field(None, description="state → its value one period later")
    mass_matrix: list[list[Expression]] | None = Field(None, description="M(q), a row per coordinate")
    bodies: dict[str, BodyConfig] | None = Field(None, description="name → rigid body, from the world outwards")
    bias: dict[str, Expression] = Field(default_factory=dict, description="coordinate → what M(q) v̇ is less than the forces by")
    forces: dict[str, Expression] = Field(default_factory=dict, description="coordinate → force or torque on it")
    dry_friction: dict[str, Expression] = Field(
        default_factory=dict, description="coordinate (or state) → level, in the unit of its force (or rate)"
    )
    soft_friction: dict[str, Softness] = Field(default_factory=dict, description="coordinates whose dry friction gives way")
    implicit: dict[str, Expression] = Field(
        default_factory=dict, description="coordinate → damping that is solved with the sub-step"
    )
    friction_after_damping: bool = Field(False, description="does dry friction act on the velocity that all else gives?")
    input_delay: dict[str, Expression] = Field(
        default_factory=dict, description="input → a time, or an expression of parameters"
    )
    memory: dict[str, MemoryConfig] = Field(default_factory=dict, description="hidden states, advanced once per sub-step")
    points: dict[str, list[Expression]] = Field(default_factory=dict, description="coordinate → place of its payload, in m")
    gravity: list[Expression] | None = Field(
        None, description="vector in m/s²; default: straight down, with the size of the parameter g, or 9.80665"
    )
    payload: dict[str, Expression] = Field(
        default_factory=dict, description="coordinate → point mass in kg at its `points` entry"
    )
    tilt: dict[str, Expression] = Field(default_factory=dict, description="coordinate → angle by which gravity is turned")
    outputs: dict[str, Expression | OutputConfig] = Field(
        default_factory=dict, description="y → expression, or {expr, unit, kind}; default: states that can be measured"
    )
    output_delay: dict[str, Expression] = Field(
        default_factory=dict, description="output → a time, or an expression of parameters"
    )
    integrator: Literal["euler", "semi_implicit", "rk4"] | None = Field(None, description="default: rk4")
    substeps: int = Field(default=1, ge=1, le=10_000, description="steps of the integrator per period")
    period: Period | None = Field(None, description="time from x to x⁺, such as 5 ms; default in a diagnosis: the recording's")

    @property
    def form(self) -> Literal["derivative", "next", "mechanical"]:
        """Which of the three forms is given."""
        if self.derivative is not None:
            return "derivative"
        return "next" if self.next is not None else "mechanical"

    @model_validator(mode="after")
    def _one_form(self) -> EquationsConfig:
        given = [n for n in ("derivative", "next", "mass_matrix", "bodies") if getattr(self, n) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise ValueError(f"found {found}; give exactly one of derivative, next, mass_matrix, bodies")
        if self.form == "mechanical":
            if self.states or not self.coordinates:
                raise ValueError(f"{given[0]} needs coordinates: {{q: unit}}, and no states; velocities are named q_dot")
            if self.bodies is not None and (self.bias or self.points or self.payload):
                raise ValueError("bias, points and payload belong to mass_matrix; bodies have their own")
        elif self.coordinates or self.bias or self.forces or not self.states:
            raise ValueError(
                f"{given[0]} needs states: {{x: unit}}; coordinates, bias and forces belong to mass_matrix or bodies"
            )
        elif odd := [n for n in _MECHANICAL if getattr(self, n)]:
            raise ValueError(f"{', '.join(odd)} belong to mass_matrix or bodies")
        if self.form == "next" and (self.integrator or self.dry_friction or self.substeps != 1):
            raise ValueError("next is the map itself; integrator, substeps and dry_friction do not apply")
        return self

    @property
    def scheme(self) -> Literal["euler", "semi_implicit", "rk4"] | None:
        """The integrator in force; None for a map."""
        return None if self.form == "next" else self.integrator or "rk4"

    def untimed(self) -> bool:
        return self.period is None

    def settings(self) -> dict[str, tuple[Any, ...]]:
        """Values worth trying when these equations disagree with another simulator."""
        if self.form == "next":
            return {}
        return {"integrator": ("euler", "semi_implicit", "rk4"), "substeps": (1, 2, 5, 10)}

    def check(self, known: EquationsConfig | None = None) -> list[Problem]:
        """All problems of names, expressions and units: (path in this section, sentence, offset in the text or None).

        known: a section without problems; where all its names mean the same here, texts that both share are not read again.
        """
        from .text.expressions import problems

        return problems(self, known)


@final
class PythonConfig(_Section):
    """x⁺ = function(x, u, **parameters) with x (n, nx), u (n, nu). `jacobian` returns (n, nx, nx + nu).

    `intervals: true` says that both also accept and return Intervals, which is what bounds over boxes need.
    """

    kind: Literal["python"]
    function: str = Field(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$", description="module:function, x⁺ of (x, u, **parameters)")
    jacobian: str | None = Field(
        default=None, pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$", description="module:function; default: differences"
    )
    states: Axes = Field(min_length=1, description="name → unit, or {unit, kind}")
    inputs: Axes = Field(default_factory=dict, description="name → unit")
    parameters: Parameters = Field(default_factory=dict, description="name → value with unit, or {value, tolerance, low, high}")
    period: Period = Field(description="time from x to x⁺, such as 5 ms")
    intervals: bool = Field(False, description="do both take and give Intervals?")

    def check(self) -> list[Problem]:
        """All problems of names and units: (path in this section, sentence, None)."""
        from .text.declarations import python_problems

        return python_problems(self)
