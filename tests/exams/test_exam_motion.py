"""The generator of the exams against the equations that a user would write: two programs that share nothing, one physics."""

from dataclasses import replace

import numpy as np
import pytest
from exams.hidden.laws import KIND, KNOWN, Hidden, shape, sites
from exams.hidden.plants import PLANTS
from exams.hidden.rig import rig

import gapcert as gc
from gapcert_diagnosis.testing import equations

PERIOD = 0.005
SIX = [name for name in PLANTS if name != "chain"]
# One plant for every effect, so that all six are met.
PLACES = {"wheel-slip": "drive", "payload": "cartpole", "joint-coupling": "arm", "gravity-tilt": "arm", "supply-sag": "motor"}
OUTPUTS = ("sensor-delay", "sensor-quantisation")  # seen in what is logged, not in the motion


@pytest.fixture(scope="module")
def played():
    """plant → (rig with the stated parameters, its model, motion without effects)."""
    kept = {}

    def play(name):
        if name not in kept:
            made = rig(name, "multisine", PERIOD, 2.0, np.random.default_rng(5))
            made = replace(made, parameters=np.array([v for v, _ in made.plant.stated.values()]))
            kept[name] = made, equations(made.plant.section(PERIOD)), made.play()
        return kept[name]

    return play


def simulated(model, motion, made, values=None):
    """Outputs of the model from where the motion began, and the columns of the motion that they belong to."""
    names = (*made.plant.positions, *made.plant.velocities)
    columns = [names.index(s.name) for s in model.states]
    x = model.rollout(motion.x[:1, columns], motion.u[None, :-1], parameters=values).x[0]
    return model.output(x, motion.u), columns


@pytest.mark.parametrize("name", [*SIX, pytest.param("chain", marks=pytest.mark.exam)])
def test_plants_move_as_their_equations_say(played, name):
    made, model, motion = played(name)
    y, columns = simulated(model, motion, made)
    assert np.abs(y - motion.x[:, columns]).max() < 1e-4 * np.std(motion.x[:, columns], axis=0).min()


@pytest.mark.exam
@pytest.mark.parametrize("effect", [n for n in KNOWN if n not in OUTPUTS])
def test_effects_act_as_the_library_writes_them(played, effect):
    made, model, still = played(PLACES.get(effect, ("pendulum", "base")[len(effect) % 2]))
    found = gc.registry().build("effect", effect)
    for site in sites(made.plant, effect)[-1:]:
        drawn = shape(effect, made.scales(still, KIND[effect], site), np.random.default_rng(1))
        hidden = Hidden(effect, site, drawn.at(0.15 * drawn.most))
        motion = made.play((hidden,))
        assert found.applies(site, model)
        extension, values, extended = found.extension(site, model), None, model
        if effect == "parameter":
            values = {site: hidden.numbers["value"]}
        else:
            named = zip(found.named(site, model), found.parameters, strict=True)
            numbers = {p.name: hidden.numbers[short.name] for p, short in named}
            stated = tuple(replace(p, value=numbers[p.name]) for p in extension.parameters)
            extended = model.extend([replace(extension, parameters=stated)])
        y, columns = simulated(extended, motion, made, values)
        changed, error = (np.abs(a - motion.y[:, columns]).max() for a in (still.y[:, columns], y))
        assert error < 0.02 * changed


def test_a_joint_sticks_exactly_and_lets_go_beyond_its_bound():
    made = rig("pendulum", "decay", PERIOD, 1.0, np.random.default_rng(0))
    weight = made.parameters[0] * made.parameters[1] * 9.81 * np.sin(0.5)
    made = replace(made, start=np.array([0.5, 0.0]))
    for share, moves in ((1.01, False), (0.99, True)):
        path = made.play((Hidden("coulomb-friction", "q", {"level": share * weight}),)).x
        assert np.array_equal(path, np.tile(path[0], (len(path), 1))) is not moves


def test_a_pendulum_without_friction_keeps_its_energy():
    made = rig("pendulum", "decay", PERIOD, 5.0, np.random.default_rng(1))
    m, c, J = made.parameters
    x = made.play().x
    energy = 0.5 * (m * c**2 + J) * x[:, 1] ** 2 + m * 9.81 * c * (1 - np.cos(x[:, 0]))
    assert np.ptp(energy) < 1e-6 * energy.mean()


def test_sensors_are_late_and_converters_round_last(played):
    made, _, still = played("pendulum")
    late = made.play((Hidden("sensor-delay", "q", {"delay": 4 * PERIOD}),))
    assert np.array_equal(late.x, still.x)
    assert np.allclose(late.y[4:, 0], still.x[:-4, 0], atol=1e-12)
    assert np.array_equal(late.y[:, 1], still.x[:, 1])


def test_the_controller_tracks_through_its_own_sensors():
    made = rig("drive", "tracking", PERIOD, 4.0, np.random.default_rng(3))
    error = (made.play().x - made.reference)[100:, 0]
    assert np.std(error) < 0.3 * np.std(made.reference[:, 0])
    biased = made.play((Hidden("sensor-bias", "q", {"bias": 0.1}),))
    assert np.mean((biased.x - made.play().x)[:, 0]) == pytest.approx(-0.1, rel=0.05)


def test_inputs_in_straight_lines_are_seen_as_such_by_the_model():
    made = rig("drive", "multisine", 0.01, 2.0, np.random.default_rng(6))
    made = replace(made, parameters=np.array([4.0]))
    held, straight = made.play().x, replace(made, hold="first").play().x
    fine = np.interp(np.arange(0, 2.0 - 0.01, 1e-4) + 5e-5, np.arange(len(made.u)) * 0.01, made.u[:, 0])
    v = made.start[1] + np.concatenate([[0.0], np.cumsum(fine) * 1e-4 / 4.0])[::100]
    assert np.abs(straight[: len(v), 1] - v).max() < 1e-6
    assert np.abs(held[: len(v), 1] - v).max() > 1e-3
