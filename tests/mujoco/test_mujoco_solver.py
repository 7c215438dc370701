"""What MuJoCo's solver leaves where it stops, and whether the resolution covers it."""

import numpy as np
import pytest

from gapcert_engines import EngineBackend
from gapcert_mujoco.config import MuJoCoConfig

pytestmark = [pytest.mark.needs("mujoco"), pytest.mark.contract]


BOX = """<mujoco><worldbody><body name="box" pos="0 0 .1"><freejoint name="root"/>
  <geom type="box" size=".1 .15 .1" mass="2"/></body></worldbody></mujoco>"""


def test_newton_stops_short_where_coupled_joints_rub_and_the_resolution_says_so(tmp_path):
    from gapcert_mujoco.engine import MuJoCoEngine

    link = '<body pos=".3 0 0"><joint name="{}" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>'
    links = f"{link.format('a')}{link.format('b')}</body></body>"
    (tmp_path / "two.xml").write_text(f"<mujoco><worldbody>{links}</worldbody></mujoco>")
    states = {f"{j}{end}": f"{j}.{kind}" for end, kind in (("", "position"), ("_dot", "velocity")) for j in "ab"}
    given = {"robot": tmp_path / "two.xml", "states": states, "inputs": {}, "period": "2 ms", "contact": False}

    def two(**options):
        return EngineBackend(MuJoCoEngine(MuJoCoConfig(**(given | options))))

    x = np.random.default_rng(0).uniform(-1, 1, (40_000, 4)) * [0.5, 0.5, 0.03, 0.03]
    moved, settled = (two(frictionloss=0.3, tolerance=t).step(x, np.empty((40_000, 0))).x for t in (1e-8, 1e-16))
    error, size = np.abs(moved - settled).max(axis=0), np.abs(moved).max(axis=0)
    assert (error <= two(frictionloss=0.3).resolution(size)).all()
    assert (error > two().resolution(size)).any()


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_newton_stops_short_in_contacts_and_the_resolution_says_so(cone, tmp_path):
    from gapcert_mujoco.engine import MuJoCoEngine

    (tmp_path / "box.xml").write_text(BOX)
    names = {
        "z": "base.z",
        "roll": "base.roll",
        "pitch": "base.pitch",
        "yaw": "base.yaw",
        "vx": "base.vx",
        "vy": "base.vy",
        "vz": "base.vz",
    }
    names |= {f"w{a}": f"base.w{a}" for a in "xyz"}
    given = {"robot": tmp_path / "box.xml", "fixed_base": False, "rotation": "euler", "states": names, "inputs": {}}
    given |= {"period": "2 ms", "ground": 1.0, "cone": cone}

    def box(**options):
        return EngineBackend(MuJoCoEngine(MuJoCoConfig(**(given | options))))

    rng, n = np.random.default_rng(0), 20_000
    lean = rng.uniform(-1, 1, (n, 3)) * [0.05, 0.05, 3]
    rate = rng.uniform(-1, 1, (n, 6)) * rng.choice([1, 0.03], (n, 1))
    x = np.hstack([rng.uniform(0.095, 0.105, (n, 1)), lean, rate])
    moved, settled = (box(tolerance=t).step(x, np.empty((n, 0))).x for t in (1e-8, 1e-16))
    error, resolution = np.abs(moved - settled).max(axis=0), box().resolution(np.abs(moved).max(axis=0))
    assert (error <= resolution).all()
    assert error.max() > 1e-8
