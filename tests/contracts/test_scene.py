"""Shapes and playback as data: boxes of inertia, coarse meshes, which states of a run are drawn, and runs with hidden state."""

import json
from dataclasses import replace

import numpy as np
import pytest

import gapcert as gc
import gapcert_figures
from gapcert.contracts.systems.scene import FACES, Shape
from gapcert.testing import ToyOscillator
from gapcert_closed_loop.closed_loop import ClosedLoop, Trace
from gapcert_figures.data import Figures, LoopFigure
from gapcert_figures.playback import FRAMES, Motion, Playback, channel_playback, loop_playback


def test_the_box_of_an_inertia_is_the_uniform_box():
    mass, half = 3.0, np.array([0.2, 0.5, 0.1])
    square = (2 * half) ** 2
    moments = mass / 12 * (square.sum() - square)
    assert np.allclose(Shape.of_inertia(0, mass, moments, np.zeros(7)).size, half)
    rod = Shape.of_inertia(0, 1.0, np.array([1 / 12, 1 / 12, 0.0]), np.zeros(7))
    assert np.allclose(rod.size, [0.01, 0.01, 0.5]), "a rod without thickness is seen all the same"
    assert Shape.of_inertia(0, 0.0, moments, np.zeros(7)) is None
    assert Shape.of_inertia(0, 1.0, np.zeros(3), np.zeros(7)) is None


def test_a_mesh_is_bounded_and_stays_where_it_is():
    """A sphere of 20,000 triangles."""
    n = 100
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, n + 1), indexing="ij"))
    vertices = np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], axis=1)
    k = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + n + 1], 1), np.stack([k + 1, k + n + 2, k + n + 1], 1)])
    fine = Shape(0, "mesh", np.empty(0), vertices=vertices, faces=faces)
    coarse = fine.bounded()
    assert 1000 < len(coarse.faces) <= FACES < len(faces)
    assert np.allclose(np.linalg.norm(coarse.vertices, axis=1), 1)
    small = replace(fine, faces=faces[:10])
    assert small.bounded() is small


class Bodied(ToyOscillator):
    """An oscillator with a body: a ball at x, on a shelf at the height of the hidden state."""

    def scene(self, x, hidden=None):
        poses = np.zeros((len(x), 1, 7))
        poses[:, 0, 0], poses[:, 0, 3] = x[:, 0], 1.0
        if hidden is not None and self.hidden:
            poses[:, 0, 2] = hidden[:, 0]
        return gc.plugin.Scene(("ball",), (Shape(0, "sphere", np.array([0.1])),), poses)


def trace(x, u, violation):
    flags = np.array([violation])
    none = np.zeros(1, dtype=bool)
    return Trace(x, u, flags, none, none, np.zeros(1, dtype=np.int64), np.zeros(u.shape[:2], dtype=bool))


def test_a_run_is_played_as_far_as_it_went():
    system = Bodied()
    steps = round(2 * FRAMES)
    u = np.zeros((1, steps, system.nu))
    x = system.rollout(np.ones((1, system.nx)), u).x
    broken = np.where(np.arange(steps + 1)[None, :, None] <= 503, x, np.nan)
    loop = ClosedLoop("first", (), trace(x, u, False), trace(broken, u, True))
    played = loop_playback(loop, system, 0)
    without, with_gamma = played.motions
    assert (without.name, with_gamma.name) == ("without γ", "with γ")
    assert without.ended == pytest.approx(503 * system.period)
    assert with_gamma.ended == -1
    assert without.t[-1] == pytest.approx(503 * system.period)
    assert len(with_gamma.t) <= FRAMES + 1
    assert np.diff(with_gamma.t)[:-1].min() >= 1 / 60 - 1e-9
    at = np.round(with_gamma.t / system.period).astype(int)
    assert np.allclose(with_gamma.poses[:, 0, 0], x[0, at, 0], atol=1e-6)


def test_no_body_no_playback():
    system = ToyOscillator()
    u = np.zeros((1, 3, system.nu))
    x = system.rollout(np.ones((1, system.nx)), u).x
    assert loop_playback(ClosedLoop("first", (), trace(x, u, False), trace(x, u, False)), system, 0) is None
    assert channel_playback((), (system,)) is None


def test_channels_are_motions_where_they_say_where_links_are():
    t = np.linspace(0, 1, 11)
    system = Bodied()
    first = system.states[0].name
    channel = gapcert_figures.Channel(first, "m", t, t, 2 * t, 3 * t)
    played = channel_playback((channel,), (ToyOscillator(), system))
    assert [m.name for m in played.motions] == ["measured", "before", "after"]
    assert [m.poses[-1, 0, 0] for m in played.motions] == [1, 2, 3]


def test_playback_is_kept_in_the_run_folder(tmp_path):
    shape = Shape(0, "mesh", np.empty(0), vertices=np.eye(3), faces=np.array([[0, 1, 2]]))
    played = Playback(("a",), (shape,), (Motion("with γ", np.arange(2.0), np.ones((2, 1, 7))),))
    loop = LoopFigure((), 0.1, np.zeros((0, 2)), (), playback=played)
    Figures(loop=loop).save(tmp_path)
    assert json.loads((tmp_path / "figures.json").read_text())["loop"]["playback"]["links"] == ["a"]
    back = Figures.load(tmp_path).loop.playback
    assert np.array_equal(back.shapes[0].faces, shape.faces)
    assert back.motions[0].ended == -1
    assert np.array_equal(back.motions[0].poses, played.motions[0].poses)
