"""The mecanum base: one description, every engine; and a certificate of its position alone is refuted in motion."""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from ruamel.yaml import YAML

import gapcert as gc
from gapcert.cli.main import main
from gapcert.contracts.plugins.events import silent
from gapcert.run.build import Build
from gapcert.spec.expect import evaluate_expectations

pytestmark = pytest.mark.contract

ROOT = Path(__file__).parents[2]
MODELS = ROOT / "specs/models/mecanum"
POSITION_ONLY = ROOT / "specs/paper/mecanum_position_only.yaml"
STATES = {"px": "base.x", "py": "base.y", "vx": "base.vx", "vy": "base.vy"}
MASS = 4 + 4 * (0.3 + 12 * 0.02)
TAU = 0.3
ENGINES = ROOT / "specs/mecanum_engines.yaml"
GAZEBO = pytest.param("gazebo-spheres", marks=pytest.mark.outside("gazebo"))
NAMES = [GAZEBO if "gazebo" in n else n for n in YAML().load(ENGINES)["compare"]["backends"]]
SMOOTH = ["mujoco-surface", GAZEBO]


@pytest.fixture(scope="module")
def generate():
    found = importlib.util.spec_from_file_location("mecanum_generate", MODELS / "generate.py")
    module = importlib.util.module_from_spec(found)
    sys.modules["mecanum_generate"] = module  # dataclasses look their module up
    found.loader.exec_module(module)
    yield module
    del sys.modules["mecanum_generate"]


@cache
def compared():
    return gc.load_spec(ENGINES).config.sections["compare"]


def base(name, **changes):
    if name in compared().unavailable:
        pytest.skip(compared().unavailable[name])
    config = compared().backends[name]
    config = type(config).model_validate(config.model_dump(exclude_unset=True) | {"states": STATES} | changes)
    return gc.registry().build("backend", config.kind, config, gc.Context(folder=ROOT / "specs"))


def columns(system, name):
    ends = np.cumsum([0, *(s.size for s in system.hidden)])
    k = [s.name for s in system.hidden].index(name)
    return slice(ends[k], ends[k + 1])


def heading(system, hidden):
    w, _, _, z = hidden[:, columns(system, "base.rotation")].T
    return 2 * np.arctan2(z, w)


def turned(system, n, yaw):
    """The hidden state at rest, with the base turned by yaw."""
    hidden = np.tile(np.array(system.hidden_default), (n, 1))
    hidden[:, columns(system, "base.rotation")] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
    return hidden


# The description


def test_the_files_are_what_the_description_generates(generate):
    for name, write in generate.FILES.items():
        assert write(generate.Mecanum()) == (MODELS / name).read_text(), f"run {MODELS / 'generate.py'}"
    assert generate.Mecanum().mass == pytest.approx(MASS) == 6.16


@pytest.mark.parametrize(("name", "fall"), [("rollers", 1.36e-3), ("barrels", 0.16e-3)])
def test_how_far_the_rim_falls_between_two_spheres(name, fall):
    robot = ElementTree.parse(MODELS / f"{name}.urdf").getroot()
    at = {j.find("child").get("link"): _numbers(j.find("origin")) for j in robot.iter("joint")}
    spheres = [
        (at[link.get("name")] + _numbers(c.find("origin")), float(c.find("geometry/sphere").get("radius")))
        for link in robot.iter("link")
        if link.get("name").startswith("front_left_")
        for c in link.iter("collision")
    ]
    turned = np.linspace(0, 2 * np.pi, 3601)
    down = np.stack([np.sin(turned), 0 * turned, -np.cos(turned)])
    reach = np.max([place @ down + radius for place, radius in spheres], axis=0)
    assert np.abs([reach.max() - 0.05, reach.max() - reach.min() - fall]).max() < 1e-5
    assert sum(float(m.get("value")) for m in robot.iter("mass")) == pytest.approx(MASS)


def _numbers(origin):
    return np.zeros(3) if origin is None else np.array(origin.get("xyz").split(), dtype=float)


@pytest.mark.parametrize("name", NAMES)
def test_wheels_turn_as_the_geometry_of_the_base_asks(generate, name):
    """v · (1, s) / √2 of the wheel's place is its roller's direction; a surface moves so fast, a rim as fast / (1 / √2) / R."""
    m, elements = generate.Mecanum(), base(name).config.drive.elements
    for w in m.wheels:
        found = elements.get(w.name) or elements[f"{w.name}_axle"]
        scale = np.sqrt(0.5) if name == "mujoco-surface" else 1 / m.radius
        turning = scale * (-w.y + w.sign * w.x)
        stiffness = 6 if name == "mujoco-surface" else 12
        wanted = {"ux": scale, "uy": scale * w.sign, "yaw": -stiffness * turning, "yaw_rate": -turning}
        assert found == pytest.approx(wanted, rel=1e-8)
    assert len(elements) == len(m.wheels)


@pytest.mark.parametrize("name", NAMES)
def test_every_engine_keeps_the_whole_mass(name):
    system = base(name)
    masses = [p.value for p in system.parameters if p.name.startswith("mass.")]
    if compared().backends[name].kind == "pybullet":
        masses = _bullet_masses()
    assert sum(masses) == pytest.approx(MASS, rel=1e-12)


def _bullet_masses():
    import pybullet

    client = pybullet.connect(pybullet.DIRECT)
    try:
        body = pybullet.loadURDF(str(MODELS / "rollers.urdf"), physicsClientId=client)
        links = range(-1, pybullet.getNumJoints(body, physicsClientId=client))
        return [pybullet.getDynamicsInfo(body, k, physicsClientId=client)[0] for k in links]
    finally:
        pybullet.disconnect(client)


# What it does


@pytest.mark.parametrize("name", NAMES)
def test_it_stands_still_goes_where_it_is_told_and_holds_its_heading(name):
    system = base(name)
    u = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    out = system.rollout(np.zeros((3, 4)), np.repeat(u[:, None], 2, axis=1), hidden=turned(system, 3, 0.05))
    x, yaw = out.x[:, -1], heading(system, out.hidden)
    assert np.abs(x[0]).max() < 5e-3
    # No engine is ahead of the command; the roughest, on rollers that are no round wheels, falls 0.2 m behind.
    along = np.array([x[1, 0], x[2, 1]])
    assert ((along > 2 * TAU - 0.25) & (along < 2 * TAU)).all()
    assert np.abs([x[1, 1], x[2, 0]]).max() < 0.05
    assert np.abs(yaw).max() < 0.015


def test_without_its_heading_loop_it_stays_turned():
    elements = compared().backends["mujoco-surface"].drive.elements
    blind = {k: {q: c for q, c in row.items() if q[0] == "u"} for k, row in elements.items()}
    system = base("mujoco-surface", drive={"elements": blind})
    out = system.rollout(np.zeros((1, 4)), np.zeros((1, 2, 2)), hidden=turned(system, 1, 0.05))
    assert heading(system, out.hidden)[0] == pytest.approx(0.05, abs=0.005)


@pytest.mark.outside("gazebo")
def test_in_gazebo_the_gap_from_rest_is_friction():
    """Along (1, ±1) / √2 two wheels pull with μ m g / 2 at most: the base falls behind by w² / (2 a) with a = μ g / 2."""
    system = base("gazebo-spheres")
    u = np.array([[1.0, 0.0], [1.0, 1.0], [-0.5, 1.0], [0.25, -0.75]])
    towards = np.array([[1.0, 1.0], [1.0, -1.0]]) / np.sqrt(2)
    w = u @ towards.T
    gap = system.step(np.zeros((4, 4)), u).x[:, :2] - TAU * u
    assert gap == pytest.approx(-(w * np.abs(w)) @ towards / (2 * 9.81 / 2), abs=1.5e-3)


@pytest.mark.parametrize("name", SMOOTH)
def test_a_reversal_falls_further_behind_than_any_start_from_rest(name):
    system = base(name)
    u = np.array([[1.0, a] for a in (0.0, 0.5, 1.0)])
    rest = np.abs(system.step(np.zeros((3, 4)), u).x[:, :2] - TAU * u).max()
    x = system.rollout(np.zeros((2, 4)), np.array([[[-1, -1], [-1, -1], [1, 1]], [[1, 1], [1, 1], [1, 1]]], dtype=float)).x
    behind = np.abs(x[:, 3, :2] - x[:, 2, :2] - TAU).max(axis=1)
    assert behind[0] > 2 * rest
    assert behind[1] < 0.05 * rest


@pytest.mark.outside("gazebo")
def test_dart_and_the_dart_in_gazebo_share_a_process():
    """Both libraries define the same symbols, and the loader makes one of those that must be unique."""
    dart, u = base("dart-rollers"), np.array([[1.0, 0.5]])
    before = dart.step(np.zeros((1, 4)), u).x
    base("gazebo-spheres").step(np.zeros((1, 4)), u)
    assert dart.step(np.zeros((1, 4)), u).x.tobytes() == before.tobytes()
    assert base("dart-rollers").step(np.zeros((1, 4)), u).x.tobytes() == before.tobytes()


def shifted(system, n, seed=1):
    """|difference| of what n commands from rest do at two places (n,), both within X."""
    rng = np.random.default_rng(seed)
    u, x = rng.uniform(-1, 1, (n, 2)), np.zeros((2 * n, 4))
    x[:, :2] = rng.uniform(0, 3, (2 * n, 2))
    moved = system.step(x, np.vstack([u, u])).x - x
    return np.abs(moved[:n] - moved[n:]).max(axis=1)


@pytest.mark.parametrize(
    ("name", "n"),
    [("mujoco-surface", 20), ("mujoco-rollers", 4), pytest.param("gazebo-spheres", 8, marks=pytest.mark.outside("gazebo"))],
)
def test_where_it_stands_does_not_matter(name, n):
    system = base(name)
    assert shifted(system, n).max() <= 2 * system.resolution(np.full(4, 3.0)).max()


def test_where_it_stands_seldom_matters_to_dart():
    # A contact that is found one step later is a jump, rare enough that most pairs agree to rounding.
    assert np.median(shifted(base("dart-rollers"), 5)) < 1e-9


@pytest.mark.exam
def test_where_it_stands_matters_to_pybullet_until_its_solver_converges():
    rough, careful = base("pybullet-rollers"), base("pybullet-rollers", solver_iterations=400, solver_residual=0.0)
    assert shifted(rough, 3).max() > 1e-4
    assert shifted(careful, 3).max() < 1e-5


# The published question


@pytest.mark.exam
def test_position_alone_is_refused_with_two_velocities_and_two_answers(tmp_path, capsys):
    assert main(["run", str(POSITION_ONLY), "--set", "hidden=refuse", "--executor", "threads", "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "depends on hidden state" in told
    for what in ("base.vx moves px by", "as visited in rollouts they move px by", "From (x, u) = ", "hidden: augment"):
        assert what in told


@pytest.mark.exam
def test_a_certificate_of_position_alone_holds_from_rest_and_is_refuted_in_motion(tmp_path):
    spec = gc.load_spec(POSITION_ONLY)
    build = Build(spec, "threads", tmp_path, False)
    model = build.make("model")
    system, domain = build.against(model)
    certificate = build.certify(model, system, domain, tmp_path, silent)
    summary = certificate.summary()
    assert not certificate.holds
    asked = {k: v for k, v in spec.config.expect.items() if k != "verdict"}
    answers = evaluate_expectations(asked, {"certificate": summary})
    assert len(answers) == 5
    assert all(a["met"] for a in answers), answers
    # The witness is true, and its base is in motion.
    witness = summary["hidden"]["attack"]["witness"]
    x, u, hidden = (np.array([part]) for part in (witness["z"][:2], witness["z"][2:], witness["hidden"]))
    residual = (system.step(x, u, hidden=hidden).x - x - TAU * u)[0, ["px", "py"].index(witness["state"])]
    assert residual == pytest.approx(witness["residual"], abs=1e-12)
    assert abs(residual) > witness["gamma"]
    assert np.abs([hidden[0, columns(system, f"base.{v}")] for v in ("vx", "vy")]).max() > 0.1
