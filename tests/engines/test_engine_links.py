"""Robots in DART, PyBullet and Gazebo as the simulation: their own steps, causes in their terms, files written back."""

import difflib
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

import gapcert as gc
import gapcert_engines
from gapcert.testing import multisine

pytestmark = pytest.mark.contract

MODELS = Path(__file__).parents[2] / "specs" / "models"
ARM = (Path(__file__).parents[1] / "data" / "arm.urdf").read_text()
SPHERE = "<geometry><sphere><radius>0.1</radius></sphere></geometry>"


def text(vector):
    return " ".join(repr(float(v)) for v in vector)


def chain(damping=0.0, dry=0.0, seed=1):
    """Eight links: joints 2 and 5 are welds, 3 slides, link 4 hangs on link 1; all axes, centres and inertias are askew."""
    rng, out = np.random.default_rng(seed), '<robot name="chain"><link name="world"/>\n'
    for k in range(8):
        kind = "fixed" if k in (2, 5) else "prismatic" if k == 3 else "continuous"
        points, mass, axis = 0.1 * rng.normal(size=(20, 3)), 0.5 + rng.random(), rng.normal(size=3)
        inertia = mass / 20 * ((points**2).sum() * np.eye(3) - points.T @ points)
        entries = " ".join(f'i{"xyz"[i]}{"xyz"[j]}="{float(inertia[i, j])!r}"' for i in range(3) for j in range(i, 3))
        out += (
            f'<link name="l{k}"><inertial><origin xyz="{text(0.2 * rng.normal(size=3))}" rpy="{text(rng.uniform(-1, 1, 3))}"/>'
        )
        out += f'<mass value="{float(mass)!r}"/><inertia {entries}/></inertial></link>\n'
        parent = "l1" if k == 4 else f"l{k - 1}" if k else "world"
        out += f'<joint name="j{k}" type="{kind}"><parent link="{parent}"/><child link="l{k}"/>'
        out += f'<origin xyz="{text(0.3 * rng.normal(size=3))}" rpy="{text(rng.uniform(-1, 1, 3))}"/>'
        if kind != "fixed":
            out += f'<axis xyz="{text(axis / np.linalg.norm(axis))}"/>'
            out += f'<dynamics damping="{damping * (k + 1)!r}" friction="{dry * (k + 1)!r}"/>'
            # No limits, in Bullet's way of saying so.
            out += '<limit lower="1" upper="-1" effort="1000" velocity="1000"/>' if kind == "prismatic" else ""
        out += "</joint>\n"
    return out + "</robot>\n"


def sdf(urdf):
    """The same robot in a world."""
    root, out = ET.fromstring(urdf), ""
    links = {link.get("name"): link.find("inertial") for link in root.findall("link")}
    for joint in root.findall("joint"):
        name, parent = (joint.find(end).get("link") for end in ("child", "parent"))
        parent, world = ("world", "") if links[parent] is None else (parent, f' relative_to="{parent}"')
        poses = [(p.get("xyz", "0 0 0"), p.get("rpy", "0 0 0")) for p in (_origin(joint), _origin(links[name]))]
        moments = "".join(f"<{k}>{v}</{k}>" for k, v in links[name].find("inertia").attrib.items())
        out += f'<link name="{name}"><pose{world}>{" ".join(poses[0])}</pose>\n<inertial><pose>{" ".join(poses[1])}</pose>'
        out += f"<mass>{links[name].find('mass').get('value')}</mass>\n<inertia>{moments}</inertia></inertial></link>\n"
        kind = joint.get("type").replace("continuous", "revolute")
        out += f'<joint name="{joint.get("name")}" type="{kind}"><parent>{parent}</parent><child>{name}</child>\n'
        if kind != "fixed":
            given = joint.find("dynamics").attrib if joint.find("dynamics") is not None else {}
            dynamics = "".join(f"<{k}>{v}</{k}>" for k, v in given.items())
            ends = joint.find("limit").attrib if joint.find("limit") is not None and kind == "revolute" else {}
            limit = "".join(f"<{k}>{v}</{k}>" for k, v in ends.items())
            axis = f"<xyz>{joint.find('axis').get('xyz')}</xyz>\n<dynamics>{dynamics}</dynamics><limit>{limit}</limit>"
            out += f"<axis>{axis}</axis>\n"
        out += "</joint>\n"
    head = '<sdf version="1.9"><world name="w"> <!-- a world -->\n<gravity>0 0 -9.81</gravity>\n<model name="robot">\n'
    return f"{head}{out}</model></world></sdf>\n"


def _origin(element):
    found = element.find("origin")
    return ET.Element("origin") if found is None else found


def movable(urdf):
    return [name for name, kind in re.findall(r'<joint name="(\w+)" type="(\w+)"', urdf) if kind != "fixed"]


def backend(kind, folder, urdf, joints=None, **options):
    """The robot in an engine; `urdf` may be a path."""
    if isinstance(urdf, Path):
        path = urdf
    else:
        path = folder / ("robot.sdf" if kind == "gazebo" else "robot.urdf")
        path.write_text(sdf(urdf) if kind == "gazebo" and "<robot" in urdf else urdf)
    joints = joints or movable(urdf)
    states = {f"{j}{end}": f"{j}.{what}" for what, end in (("position", ""), ("velocity", "_dot")) for j in joints}
    section = {"kind": kind, "robot": str(path), "states": states, "inputs": {"u": joints[0]}, "period": "5 ms", **options}
    return gc.registry().build("backend", kind, gc.registry().config("backend", kind).model_validate(section))


def simulation(system, **values):
    """`values`: of native parameters that are free, and None for their stated value."""
    known = {p.name: p for p in system.parameters}
    named = {n.replace("__", "."): v for n, v in values.items()}
    assert set(named) <= set(known), sorted(known)
    loose = [gc.Parameter(n, known[n].value if v is None else v, known[n].unit, 0.02) for n, v in named.items()]
    return gapcert_engines.EngineModel(system, loose)


def assert_same(system, model, speed=1.0, steps=40, within=1e-9, **natives):
    rng = np.random.default_rng(5)
    x, u = rng.normal(size=(8, model.nx)), 0.3 * rng.normal(size=(8, steps, model.nu))
    x[:, model.nx // 2 :] *= speed
    order = [[s.name for s in system.states].index(s.name) for s in model.states]
    at = np.empty_like(x)
    at[:, order] = x
    given = {n.replace("__", "."): np.full(8, v) for n, v in natives.items()} or None
    engine = system.rollout(at, u, parameters=given).x[:, :, order]
    np.testing.assert_allclose(model.fast_rollout(x, u).x, engine, rtol=0, atol=within)


@pytest.fixture(params=["dart", "pybullet", pytest.param("gazebo", marks=pytest.mark.outside("gazebo"))])
def engine(request):
    if (missing := gc.registry().get("backend", request.param).missing()) is not None:
        pytest.skip(f"{missing} is not installed")
    return request.param


@pytest.mark.exam
@pytest.mark.parametrize("substeps", [1, 5])
@pytest.mark.parametrize("damping", [0.0, 0.2])
@pytest.mark.parametrize("robot", ["pendulum", "arm", "chain"])
def test_a_robot_moves_as_in_its_engine(engine, tmp_path, robot, damping, substeps):
    if robot == "pendulum":
        suffix = "sdf" if engine == "gazebo" else "urdf"
        system = backend(engine, tmp_path, MODELS / f"pendulum.{suffix}", ["hinge"], substeps=substeps, joint_damping=damping)
    else:
        urdf = chain(damping) if robot == "chain" else ARM.replace('damping="0.02"', f'damping="{damping}"')
        system = backend(engine, tmp_path, urdf, substeps=substeps)
    assert_same(system, simulation(system), steps=10 if robot == "chain" else 40)


@pytest.mark.exam
@pytest.mark.parametrize("damping", [0.0, 0.5])
@pytest.mark.parametrize("robot", [ARM, chain()], ids=["arm", "chain"])
def test_dry_friction_holds_as_in_the_engine(engine, tmp_path, robot, damping):
    # Bullet solves its motors by sweeps, which end early unless they are told not to.
    options = {"solver_residual": 0, "solver_iterations": 500} if engine == "pybullet" else {}
    system = backend(engine, tmp_path, robot, joint_damping=damping, **options)
    dry = {f"coulomb_friction__{j}": 0.4 + 0.2 * k for k, j in enumerate(movable(robot))}
    model = simulation(system, **dry)
    assert_same(system, model, speed=0.02, steps=5, **dry)
    still = np.full((1, model.nx), 0.1), np.zeros((1, 1))
    assert np.abs(simulation(system).step(*still).x - model.step(*still).x).max() > 1e-3


def test_what_is_free_moves_the_engine_alike(engine, tmp_path):
    system = backend(engine, tmp_path, ARM)
    values = {"mass__lower": 0.9, "damping__shoulder": 0.1, "damping__elbow": 0.3, "gravity_x": 0.7, "gravity_z": -9.0}
    model = simulation(system, **values)
    assert model.natives() == {n.replace("__", "."): v for n, v in values.items()}
    assert_same(system, model, **values)


def body(engine, link):
    values = {f"mass__{link}": 0.9, f"inertia__{link}": 0.05}
    return values | ({} if engine == "pybullet" else {f"com_x__{link}": 0.04, f"com_y__{link}": -0.03, f"com_z__{link}": -0.25})


@pytest.mark.exam
@pytest.mark.parametrize("engine", ["dart", "pybullet"], indirect=True)
@pytest.mark.parametrize("tiles", [1, 3])
def test_centres_and_moments_are_numbers_of_their_own(engine, tmp_path, tiles):
    system = backend(engine, tmp_path, chain(), tiles=tiles)
    values = body(engine, "l4") | body(engine, "l1")
    assert_same(system, simulation(system, **values), steps=5, **values)
    model, stated = simulation(system, **dict.fromkeys(values)), simulation(system)
    named = {n.replace("__", "_"): np.full(8, v) for n, v in values.items()}
    rng = np.random.default_rng(2)
    x, u = rng.normal(size=(8, model.nx)), rng.normal(size=(8, 1))
    after = system.step(x, u, parameters={n.replace("__", "."): np.full(8, v) for n, v in values.items()}).x
    np.testing.assert_allclose(model.step(x, u, parameters=named).x, after, rtol=0, atol=1e-9)
    assert np.abs(stated.step(x, u).x - after).max() > 1e-4
    np.testing.assert_array_equal(system.step(x, u).x, backend(engine, tmp_path, chain(), tiles=tiles).step(x, u).x)


@pytest.mark.parametrize("engine", ["dart", "pybullet"], indirect=True)
def test_centres_and_moments_go_into_the_file(engine, tmp_path):
    bare = ARM.replace('<inertial><origin xyz="0 0 -0.3"/>', "<inertial>")
    values = body(engine, "lower") | body(engine, "upper")
    model = simulation(backend(engine, tmp_path, bare), **values)
    (patched,) = model.files().values()
    folder = tmp_path / "patched"
    folder.mkdir()
    assert_same(backend(engine, folder, patched), model)


def test_a_dart_robot_of_sdf_is_changed_by_code(tmp_path, monkeypatch):
    pytest.importorskip("dartpy", reason="dartpy is not installed")
    robot = sdf(ARM).replace(' version="1.9"', ' version="1.6"').replace(' relative_to="upper"', "")
    robot = re.sub(r"<world.*?</gravity>|</world>", "", robot, flags=re.DOTALL)
    (tmp_path / "robot.sdf").write_text(robot)
    model = simulation(backend("dart", tmp_path, tmp_path / "robot.sdf", movable(ARM)), **body("dart", "lower"))
    for name, content in model.files().items():
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile((tmp_path / "extended.py").read_text(), "extended.py", "exec"), names)
    x, u = np.array([[0.4, -0.7, 0.2, 0.03]]), np.array([[0.3]])
    np.testing.assert_allclose(_one_step("dart", names, x[0], u[0]), model.step(x, u).x[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("engine", ["dart", pytest.param("gazebo", marks=pytest.mark.outside("gazebo"))], indirect=True)
def test_springs_of_an_sdf_file_pull_as_in_the_engine(engine, tmp_path):
    spring = "<spring_stiffness>3</spring_stiffness><spring_reference>0.4</spring_reference>"
    robot = sdf(ARM).replace("<damping>0.02</damping>", f"<damping>0.02</damping><friction>0.05</friction>{spring}")
    if engine == "dart":
        # The SDF of DART's reader has places in the frame of the model alone.
        robot = robot.replace(' version="1.9"', ' version="1.6"').replace(' relative_to="upper"', "")
        (tmp_path / "robot.sdf").write_text(robot)
        system = backend(engine, tmp_path, tmp_path / "robot.sdf", movable(ARM))
    else:
        system = backend(engine, tmp_path, robot, movable(ARM))
    model = simulation(system)
    assert "stiffness_1" in {p.name for p in model.parameters}
    assert_same(system, model)


def test_a_coordinate_may_have_the_name_of_the_substep(engine, tmp_path):
    path = MODELS / f"pendulum.{'sdf' if engine == 'gazebo' else 'urdf'}"
    states = {"h": "hinge.position", "h_dot": "hinge.velocity"}
    system = backend(engine, tmp_path, path, ["hinge"], states=states, joint_damping=0.3)
    assert_same(system, simulation(system))


LIMITS = '<limit lower="-1" upper="1" effort="9" velocity="9"/>'
LIMITED = ARM.replace('type="continuous"><parent link="upper"', f'type="revolute">{LIMITS}<parent link="upper"')


@pytest.mark.parametrize("ends", [(-1.0, 1.0), (0.5, 0.54)])
def test_between_its_ends_a_joint_moves_as_in_the_engine(engine, tmp_path, ends):
    options = {"joint_limits": True} if engine == "dart" else {}
    limited = LIMITED.replace('lower="-1" upper="1"', 'lower="{}" upper="{}"'.format(*ends))
    system = backend(engine, tmp_path, limited, inputs={"u": "shoulder", "w": "elbow"}, **options)
    model = simulation(system)  # whose steps are checked between the ends
    assert model.within["elbow"] == pytest.approx(ends)
    assert ("elbow_dot" in model.within, "w" in model.within) == (engine != "pybullet", engine == "gazebo")
    x, u = np.array([[0.2, sum(ends) / 2, 0.3, 0.1]]), np.array([[0.5, -0.2]])
    np.testing.assert_allclose(model.step(x, u).x, system.step(x, u).x, rtol=0, atol=1e-9)
    x = np.array([[0.2, ends[1] - 1e-3, 0.0, 4.0]])
    stopped, gone = system.rollout(x, np.zeros((1, 2, 2))).x[0, -1], model.rollout(x, np.zeros((1, 2, 2))).x[0, -1]
    assert stopped[1] < ends[1] + 0.02 < gone[1]


def test_limits_that_leave_no_room_are_told(engine, tmp_path):
    options = {"joint_limits": True} if engine == "dart" else {}
    limited = LIMITED.replace('lower="-1" upper="1"', 'lower="0.5" upper="0.50001"')
    with pytest.raises(gc.UsageError, match=r"one step takes elbow out of 0\.5 to 0\.50001"):
        simulation(backend(engine, tmp_path, limited, **options))


@pytest.mark.parametrize("engine", ["dart", "pybullet"], indirect=True)
def test_ends_may_be_left_out(engine, tmp_path):
    system = backend(engine, tmp_path, LIMITED, joint_limits=False)
    assert_same(system, simulation(system))
    assert "copies" in system.tiling


@pytest.mark.parametrize("engine", ["dart", "pybullet"], indirect=True)
def test_an_arm_that_is_sold_moves_as_in_the_engine(engine, tmp_path):
    """Seven joints with limits and meshes."""
    data = pytest.importorskip("pybullet_data", reason="pybullet's robots are not installed")
    path = Path(data.getDataPath()) / "kuka_iiwa" / "model.urdf"
    joints = re.findall(r'<joint name="(\w+)" type="revolute"', path.read_text())
    assert len(joints) == 7
    system = backend(engine, tmp_path, path, joints, joint_limits=False)
    assert_same(system, simulation(system), steps=5)


@pytest.mark.parametrize("engine", ["dart", pytest.param("gazebo", marks=pytest.mark.outside("gazebo"))], indirect=True)
def test_friction_that_nothing_overcomes(engine, tmp_path):
    system = backend(engine, tmp_path, ARM, coulomb_friction=1e3)
    assert np.abs(system.step(np.ones((1, 4)), np.ones((1, 1))).x[0, 2:]).max() < 1e-6
    # DART's constraints give way by 1e-9 of an impulse, so that the joint goes on at 5e-9 rad/s.
    assert_same(system, simulation(system), steps=1, within=2e-8)


def test_a_robot_on_a_ground_is_refused(engine, tmp_path):
    shape = '<collision><geometry><box size="0.1 0.2 0.4"/></geometry></collision></link>'
    arm = ARM.replace("</inertial></link>", "</inertial>" + shape)
    robot = sdf(arm).replace("</inertial></link>", '</inertial><collision name="c">' + SPHERE + "</collision></link>")
    with pytest.raises(gc.UsageError, match="more than a tree of bodies"):
        simulation(backend(engine, tmp_path, robot if engine == "gazebo" else arm, movable(ARM), ground=1.0))


def recorded(system, noise=0.01, **natives):
    u = multisine(6.0, system.period, 2.0, (0.1, 3.0), 3)
    given = {n.replace("__", "."): np.array([v]) for n, v in natives.items()} or None
    x = system.rollout(np.array([[0.3, 0.0]]), u[None], parameters=given).x[0, :-1]
    y = x[:, 0] + noise * np.std(x[:, 0]) * np.random.default_rng(0).standard_normal(len(x))
    return gc.Recording.of(np.arange(len(u)) * system.period, {"hinge": y, "u": u[:, 0]})


@pytest.mark.exam
def test_causes_have_the_engines_names_and_go_back_into_its_file(engine, tmp_path):
    suffix = "sdf" if engine == "gazebo" else "urdf"
    path = MODELS / f"pendulum.{suffix}"
    system = backend(engine, tmp_path, path, ["hinge"])
    model = simulation(system, mass__rod=None)
    assert gc.diagnose(model, recorded(system), horizons=[0.5]).verdict == "nothing"
    found = gc.diagnose(model, recorded(system, damping__hinge=0.05, mass__rod=1.2), horizons=[0.5])
    assert {(c.effect, c.native) for c in found.causes} == {("viscous-friction", "damping.hinge"), ("parameter", "mass.rod")}
    extended = found.extended_model
    assert extended.natives() == pytest.approx({"damping.hinge": 0.05, "mass.rod": 1.2}, rel=0.05)
    ((name, patched),) = extended.files().items()
    assert name == f"extended.{suffix}"
    original = path.read_text()
    lost = [line for line in difflib.ndiff(original.splitlines(), patched.splitlines()) if line.startswith("- ")]
    assert len(lost) <= 3
    assert re.findall("<!--.*?-->", original) == re.findall("<!--.*?-->", patched)
    again = tmp_path / name
    again.write_text(patched)
    assert_same(backend(engine, tmp_path, again, ["hinge"]), extended)


@pytest.mark.exam
def test_dry_friction_has_the_engines_name(engine, tmp_path):
    suffix = "sdf" if engine == "gazebo" else "urdf"
    system = backend(engine, tmp_path, MODELS / f"pendulum.{suffix}", ["hinge"])
    found = gc.diagnose(simulation(system), recorded(system, coulomb_friction__hinge=0.2), horizons=[0.5])
    assert [(c.effect, c.native) for c in found.causes] == [("coulomb-friction", "coulomb_friction.hinge")]
    extended = found.extended_model
    assert extended.natives() == pytest.approx({"coulomb_friction.hinge": 0.2}, rel=0.05)
    assert_same(system, extended, **extended.natives())


def test_numbers_of_an_arm_go_into_its_file(engine, tmp_path):
    system = backend(engine, tmp_path, ARM, substeps=2)
    values = {"damping__shoulder": 0.1, "damping__elbow": 0.3, "mass__lower": 0.9}
    values |= {} if engine == "pybullet" else {"coulomb_friction__elbow": 0.05}
    values |= {"gravity_x": 0.5} if engine == "gazebo" else {}
    model = simulation(system, **values)
    (patched,) = model.files().values()
    folder = tmp_path / "patched"
    folder.mkdir()
    assert "<!--" in patched
    assert_same(backend(engine, folder, patched, movable(ARM), substeps=2), model)


@pytest.mark.parametrize("engine", ["dart", "pybullet"], indirect=True)
def test_what_a_urdf_cannot_say_becomes_code(engine, tmp_path, monkeypatch):
    system = backend(engine, tmp_path, ARM)
    values = {"damping__elbow": 0.3, "gravity_x": 0.5, "coulomb_friction__elbow": 0.05, "mass__lower": 0.9}
    model = simulation(system, **values)
    files = model.files()
    assert sorted(files) == ["extended.py", "extended.urdf"]
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    exec(compile(files["extended.py"], "extended.py", "exec"), names)
    x, u = np.array([[0.4, -0.7, 0.2, 0.03]]), np.array([[0.3]])
    np.testing.assert_allclose(_one_step(engine, names, x[0], u[0]), model.step(x, u).x[0], rtol=0, atol=1e-9)


def _one_step(engine, names, x, u):
    """5 ms of what the code has made."""
    robot = names["robot"]
    if engine == "dart":
        names["world"].setTimeStep(0.005)
        robot.setPositions(x[:2])
        robot.setVelocities(x[2:])
        robot.setForces([u[0], 0.0])
        names["world"].step()
        return np.concatenate([robot.getPositions(), robot.getVelocities()])
    bullet = names["pybullet"]
    bullet.setTimeStep(0.005)
    # With this time step a motor's strength becomes an impulse.
    bullet.setJointMotorControl2(robot, names["joints"]["elbow"], bullet.VELOCITY_CONTROL, targetVelocity=0, force=0.05)
    for k in (0, 1):
        bullet.resetJointState(robot, k, x[k], x[2 + k])
    bullet.setJointMotorControl2(robot, 0, bullet.TORQUE_CONTROL, force=u[0])
    bullet.stepSimulation()
    states = bullet.getJointStates(robot, [0, 1])
    bullet.disconnect()
    return np.array([s[0] for s in states] + [s[1] for s in states])


# --- Bullet's own


@pytest.mark.parametrize("engine", ["pybullet"], indirect=True)
def test_bullets_drag_is_part_of_the_equations_and_may_be_free(engine, tmp_path):
    system = backend("pybullet", tmp_path, chain(), linear_damping=0.3, angular_damping=0.5)
    drag = {"linear_damping": 0.7, "angular_damping": 0.1}
    assert_same(system, simulation(system), steps=10)
    assert_same(system, simulation(system, **drag), steps=10, **drag)


@pytest.mark.parametrize("engine", ["pybullet"], indirect=True)
def test_an_inertia_that_bullet_takes_from_shapes_is_read_from_bullet(engine, tmp_path):
    shape = '<collision><origin xyz="0 0 -0.2" rpy="0.3 0 0"/><geometry><box size="0.1 0.2 0.4"/></geometry></collision></link>'
    system = backend(
        "pybullet", tmp_path, ARM.replace("</inertial></link>", "</inertial>" + shape), use_inertia_from_file=False
    )
    assert_same(system, simulation(system))


@pytest.mark.parametrize("engine", ["pybullet"], indirect=True)
def test_an_axis_that_is_no_unit_vector_is_told(engine, tmp_path):
    with pytest.raises(gc.UsageError, match=r"axis of joint 'shoulder' is 1\.001 long"):
        simulation(backend("pybullet", tmp_path, ARM.replace('<axis xyz="0 1 0"/></joint>', '<axis xyz="0 1.001 0"/></joint>')))
