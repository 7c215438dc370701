"""MuJoCo's compiled variant: a pure function as any other, the answers of the C code, and what it does not take."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from gapcert import Box, Domain, MissingDependency, Recording, UsageError, diagnose
from gapcert.testing import SystemContract, multisine
from gapcert_engines import EngineBackend, EngineModel
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco", "jax", "trimesh"), pytest.mark.contract]


MODELS = Path(__file__).parents[2] / "specs/models"
# A base that floats, a hinge with a spring, and a slide with ends, a spring and a body that gravity lifts in part.
FLOATING = """<mujoco><worldbody><body name="hull" pos="0 0 1"><freejoint/>
  <inertial pos="0.05 0.02 -0.1" mass="2" diaginertia="0.02 0.03 0.045"/>
  <body name="arm" pos="0.1 0 0"><joint name="h" axis="0 1 0.3" stiffness="3" springref="0.3" damping="0.1" armature="0.01"/>
    <inertial pos="0 0 -0.1" mass="0.5" diaginertia="0.002 0.003 0.004" quat="1 0.2 0.1 0"/>
    <body name="hand" pos="0 0.1 -0.2" gravcomp="0.7">
      <joint name="s" type="slide" axis="1 0 1" stiffness="20" damping="0.4" limited="true" range="-.1 .1" pos="0 0.1 0"/>
      <geom size="0.05" contype="0" conaffinity="0" mass="0.4" pos="0.03 0 0.02"/></body></body></body></worldbody></mujoco>"""
ROD = """<mujoco><option{option}/>{more}<worldbody><body name="rod"><joint name="hinge" axis="0 1 0" {joint}/>
  <inertial pos="0 0 -0.5" mass="1" diaginertia="0.09 0.09 0.01"/>{tip}</body></worldbody></mujoco>"""
# Six legs on a hull: what a step sums over the children of a body.
LEGS = tuple(f"h{k}" for k in range(1, 7))
STAR = """<mujoco><worldbody><body name="hull" pos="0 0 1"><freejoint/>
  <inertial pos="0.05 0.02 -0.1" mass="2" diaginertia="0.02 0.03 0.045"/>{legs}</body></worldbody></mujoco>"""
LEG = """<body name="leg{k}" pos="0.{k} 0 0"><joint name="h{k}" axis="0 1 0.{k}" damping="0.1"/>
  <inertial pos="0 0 -0.{k}" mass="0.5" diaginertia="0.002 0.003 0.004"/></body>"""
BASE = {f: f"base.{f}" for f in ("x", "y", "z", "vx", "vy", "vz", "wx", "wy", "wz")}
BALL = '<geom name="ball" size="0.1" pos="0 0 -1"/>'


def of_joints(joints):
    return {f"{j}{end}": f"{j}.{kind}" for kind, end in (("position", ""), ("velocity", "_dot")) for j in joints}


def backend(robot, joints=(), **options):
    from gapcert_mujoco.engine import MuJoCoEngine

    given = {"robot": robot, "states": of_joints(joints), "inputs": {f"u_{j}": j for j in joints}, "period": "4 ms"}
    return EngineBackend(MuJoCoEngine(MuJoCoConfig(**(given | options))))


def pendulum(**options):
    return backend(MODELS / "pendulum.urdf", ("hinge",), **({"implementation": "mjx", "tiles": 8, "substeps": 2} | options))


def rod(folder, option="", joint="", more="", tip="", **options):
    path = folder / "rod.xml"
    path.write_text(ROD.format(option=option, joint=joint, more=more, tip=tip))
    return backend(path, ("hinge",), **({"implementation": "mjx"} | options))


def star(folder, **options):
    path = folder / "star.xml"
    path.write_text(STAR.format(legs="".join(LEG.format(k=k) for k in range(1, 7))))
    given = {"states": BASE | of_joints(LEGS), "inputs": {"u": "h1"}, "fixed_base": False, "implementation": "mjx", "tiles": 16}
    return backend(path, LEGS, **(given | options))


def query(system, n, steps=1, scale=1.0):
    rng = np.random.default_rng(0)
    return rng.uniform(-scale, scale, (n, system.nx)), rng.uniform(-1, 1, (n, steps, system.nu))


@pytest.mark.exam
class TestPendulum(SystemContract):
    def system(self):
        return pendulum()

    def domain(self, system):
        return Domain(Box(system.states, (-3.0, -2.0), (3.0, 2.0)), Box(system.inputs, (-1.0,), (1.0,)))


# Its answers


def varied(system, n, dry):
    """Other native parameters in every row, with dry friction in the rows of `dry` only."""
    rng = np.random.default_rng(1)
    given = {p.name: (p.value or 0.02) * rng.uniform(0.8, 1.25, n) for p in system.parameters}
    return {k: np.where(dry, v, 0.0) if k.startswith("frictionloss") else v for k, v in given.items()}


@pytest.mark.exam
@pytest.mark.parametrize(
    ("robot", "joints", "rub"),
    [("pendulum.urdf", ("hinge",), 0), pytest.param("arm.xml", ("shoulder", "elbow"), 3, marks=pytest.mark.exam)],
)
def test_rows_with_parameters_of_their_own_are_the_c_codes(robot, joints, rub):
    ours, theirs = (backend(MODELS / robot, joints, implementation=kind, tiles=8, substeps=2) for kind in ("mjx", "c"))
    x, u = query(ours, 11, 200)
    given = varied(ours, 11, np.arange(11) < rub)
    assert {"gravity_x", "gravity_z"} < set(given)
    np.testing.assert_allclose(
        ours.rollout(x, u, parameters=given).x, theirs.rollout(x, u, parameters=given).x, rtol=0, atol=1e-9
    )
    alone = ours.step(x[4:5], u[4:5, 0], parameters={k: v[4:5] for k, v in given.items()}).x
    assert ours.step(x, u[:, 0], parameters=given).x[4].tobytes() == alone.tobytes()
    single = {name: float(value[4]) for name, value in given.items()}
    np.testing.assert_array_equal(ours.step(x[4:5], u[4:5, 0], parameters=single).x, alone)


@pytest.mark.exam
@pytest.mark.parametrize(("integrator", "frictionloss"), [("Euler", None), ("implicitfast", 0.05)])
def test_a_floating_robot_moves_as_in_c(tmp_path, integrator, frictionloss):
    # Where dry friction and ends act at once, C's solver stops up to 3e-7 short of MJX's; at 1e-12 both have converged.
    path = tmp_path / "floating.xml"
    path.write_text(FLOATING)
    options = {"states": BASE | of_joints(("h", "s")), "inputs": {"u": "h", "w": "s"}, "fixed_base": False, "tolerance": 1e-12}
    options |= {"integrator": integrator, "frictionloss": frictionloss, "tiles": 8}
    ours, theirs = (backend(path, **options, implementation=kind) for kind in ("mjx", "c"))
    x, u = query(ours, 5, 200)
    there = theirs.rollout(x, u)
    assert np.abs(there.x[:, :, ours.nx - 3]).max() > 0.1
    np.testing.assert_allclose(ours.rollout(x, u).x, there.x, rtol=0, atol=1e-9)


@pytest.mark.exam
@pytest.mark.parametrize("options", [{}, {"integrator": "RK4"}, {"integrator": "Euler", "frictionloss": 0.2}])
def test_an_arm_of_seven_joints_moves_as_in_c(options):
    joints = [f"j{k}" for k in range(1, 8)]
    ours, theirs = (backend(MODELS / "arm7.xml", joints, implementation=kind, tiles=8, **options) for kind in ("mjx", "c"))
    x, u = query(ours, 8, 300)
    np.testing.assert_allclose(ours.rollout(x, u).x, theirs.rollout(x, u).x, rtol=0, atol=1e-9)


@pytest.mark.exam
def test_many_limbs_move_as_in_c_and_each_time_to_the_same_bits(tmp_path):
    """Threads of a GPU add the legs in the order in which they arrive, if they are let."""
    ours, theirs = star(tmp_path), star(tmp_path, implementation="c")
    x, u = query(ours, 40, 20)
    first = ours.rollout(x, u).x
    np.testing.assert_allclose(first, theirs.rollout(x, u).x, rtol=0, atol=1e-9)
    for _ in range(5):
        assert ours.rollout(x, u).x.tobytes() == first.tobytes()


@pytest.mark.exam
def test_nothing_is_left_to_the_order_in_which_threads_arrive(tmp_path):
    """No floating sum over rows that an index names is left of what MJX does, of which there are some."""
    from gapcert_mujoco import xla

    system = star(tmp_path)
    world = system._world(1)
    world.set({p.name: p.value for p in system.parameters})
    assert any(sums(world._stepper, xla, keep=True))
    assert not any(sums(world._stepper, xla))


def sums(stepper, xla, keep=False):
    """Of both programs of a model, as MJX has them or as they are run: each floating scatter-add."""
    import jax

    def found(jaxpr):
        for equation in jaxpr.eqns:
            if equation.primitive.name == "scatter-add":
                yield np.issubdtype(equation.invars[0].aval.dtype, np.floating)
            for value in equation.params.values():
                for part in value if isinstance(value, list | tuple) else [value]:
                    inner = getattr(part, "jaxpr", part)
                    yield from found(inner) if hasattr(inner, "eqns") else ()

    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(True):
        if keep:
            patch.setattr(xla, "_segments", lambda equation: False)
        for structure in stepper._structures:
            program = xla.program.__wrapped__(structure)
            fields = {name: np.repeat(part, 2, axis=0) for name, part in stepper._fields.items()}
            nq, nv = stepper._model.nq, stepper._model.nv
            yield from found(program.trace(fields, np.zeros((2, 1 + nq + nv)), np.zeros((2, 1, nv))).jaxpr.jaxpr)


@pytest.mark.parametrize("given", [None, "true"])
def test_a_gpu_is_left_to_other_processes_unless_that_is_wished(given, monkeypatch):
    from gapcert_mujoco import xla

    name = "XLA_PYTHON_CLIENT_PREALLOCATE"
    monkeypatch.delenv(name, raising=False)
    if given is not None:
        monkeypatch.setenv(name, given)
    xla._jax()
    assert os.environ[name] == (given or "false")


@pytest.mark.exam
def test_one_compilation_serves_all_queries():
    import jax

    from gapcert_mujoco import xla

    compiled = []

    def told(event, seconds, **more):
        if event.endswith("backend_compile_duration"):
            compiled.append(seconds)

    xla.program.cache_clear()
    jax.monitoring.register_event_duration_secs_listener(told)
    system = pendulum()
    x, u = query(system, 20)
    system.step(x, u[:, 0])
    first = len(compiled)
    system.step(x[:3], u[:3, 0], forces=np.ones((3, 2, 1)))
    system.step(x, u[:, 0], parameters={"mass.rod": np.linspace(0.5, 2, 20), "gravity_x": 1.0})
    assert len(compiled) == first > 0


def test_all_that_parameters_change_is_handed_to_mjx():
    import jax
    import mujoco

    from gapcert_mujoco import xla
    from gapcert_mujoco.parameters import Natives

    model = mujoco.MjModel.from_xml_string(FLOATING)
    natives = Natives(model)
    other = natives.varied(model, {p.name: 1.5 * (p.value or 0.1) for p in natives.parameters})
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    fields = [f.name for f in mjx.Model.fields() if f.type is jax.Array and not f.name.startswith("_")]
    known = {name for name in fields if isinstance(getattr(model, name, None), np.ndarray)}
    changed = {name for name in known if not np.array_equal(getattr(model, name), getattr(other, name))}
    assert changed == {*xla.FIELDS, "dof_M0"}  # the diagonal of the mass matrix, which MJX computes itself


def test_what_becomes_huge_is_told():
    with pytest.raises(UsageError, match=r"became huge or undefined from positions \[0\.0\], velocities \[1000000000000\.0\]"):
        pendulum().step(np.array([[0.1, 0.1], [0.0, 1e12], [0.2, 0.0]]), np.zeros((3, 1)))


def test_it_disturbs_no_other_user_of_jax():
    code = (
        "import sys, jax, numpy\n"
        "from pathlib import Path\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import test_mujoco_xla as t\n"
        "from gapcert_mujoco import xla\n"
        "world = t.pendulum()._world(1)\n"
        "world.set({p.name: p.value for p in t.pendulum().parameters})\n"
        "with jax.enable_x64(True): xla.program(world._stepper._structures[0])\n"
        "print(jax.config.jax_enable_x64, jax.numpy.ones(2).dtype)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "False float32\n"


@pytest.mark.exam
def test_a_diagnosis_with_it_finds_the_same():
    ours, theirs = (backend(MODELS / "pendulum.urdf", ("hinge",), implementation=kind, tiles=8) for kind in ("mjx", "c"))
    u = multisine(5.0, ours.period, 2.0, (0.1, 3.0), 3)
    x = theirs.rollout(np.array([[0.3, 0.0]]), u[None], parameters={"damping.hinge": 0.05}).x[0, :-1]
    y = x[:, 0] + 0.01 * np.std(x[:, 0]) * np.random.default_rng(0).standard_normal(len(x))
    recording = Recording.of(np.arange(len(u)) * ours.period, {"hinge": y, "u_hinge": u[:, 0]})
    found = [diagnose(EngineModel(s), recording, effects=["viscous-friction"], horizons=[0.5]) for s in (ours, theirs)]
    assert [[(c.effect, c.native) for c in f.causes] for f in found] == [[("viscous-friction", "damping.hinge")]] * 2
    (a,), (b,) = (list(f.extended_model.natives().values()) for f in found)
    assert a == pytest.approx(b, rel=1e-9)
    assert a == pytest.approx(0.05, rel=0.05)


# What it does not take


@pytest.mark.parametrize(
    ("robot", "told"),
    [
        ({"tip": BALL, "ground": 0.5}, "bodies that may touch.*set implementation: c, or contact: false"),
        ({"more": '<equality><joint joint1="hinge"/></equality>'}, "an equality constraint"),
        ({"more": '<tendon><fixed><joint joint="hinge" coef="1"/></fixed></tendon>'}, "a tendon"),
        ({"joint": 'damping="0.1 0.2"'}, "a spring or damper that is not linear"),
        ({"option": ' density="1.2"'}, "a medium"),
        ({"joint": 'actuatorgravcomp="true"'}, "gravity compensation by actuators"),
        ({"more": '<option><flag spring="disable"/></option>'}, "springs without dampers"),
        ({"integrator": "implicit"}, "integrator IMPLICIT,"),
        ({"integrator": "discrete"}, "integrator DISCRETE,"),
        ({"solver": "CG"}, "solver CG,"),
        ({"noslip_iterations": 3}, "iterations without slip"),
    ],
)
def test_what_mjx_would_answer_otherwise_is_refused(tmp_path, robot, told):
    with pytest.raises(UsageError, match=rf"backend\.implementation: .*rod\.xml has {told}"):
        rod(tmp_path, **robot)
    assert rod(tmp_path, **robot, implementation="c").states


def test_a_drive_is_refused(tmp_path):
    drive = {"elements": {"hinge": {"u_hinge": 1.0}}}
    with pytest.raises(UsageError, match=r"backend\.implementation: mjx has no drive; .* set implementation: c"):
        rod(tmp_path, drive=drive, inputs={"u_hinge": "drive"})


def test_a_base_that_turns_is_refused_with_rk4(tmp_path):
    path = tmp_path / "floating.xml"
    path.write_text(FLOATING)
    with pytest.raises(UsageError, match="a base that floats, with RK4"):
        backend(path, ("h", "s"), fixed_base=False, integrator="RK4", implementation="mjx")


def test_what_mjx_says_is_handed_on(tmp_path):
    system = rod(tmp_path, more='<option><flag fwdinv="enable"/></option>')
    with pytest.raises(UsageError, match=r"MJX says '.*FWDINV.*'; expected what it implements; set implementation: c"):
        system.step(np.zeros((1, 2)), np.zeros((1, 1)))


def test_without_the_package_the_install_line_is_told(monkeypatch):
    from gapcert_mujoco import xla

    find = xla.importlib.util.find_spec
    monkeypatch.setattr(xla.importlib.util, "find_spec", lambda name: None if name == "mujoco.mjx" else find(name))
    with pytest.raises(
        MissingDependency, match=r"mjx needs mujoco-mjx, which is not installed; run: pip install 'gapcert\[mjx\]'"
    ):
        pendulum()


def test_its_last_bits_are_named_in_the_digest(monkeypatch):
    assert len({pendulum(**o).digest() for o in ({}, {"implementation": "c"}, {"tiles": 16})}) == 3
    import jax

    before = pendulum().digest()
    monkeypatch.setattr(jax, "devices", lambda: [SimpleNamespace(platform="gpu", device_kind="another")])
    assert pendulum().digest() != before
    assert pendulum().tiling == "untiled: MJX takes 8 rows at once"
