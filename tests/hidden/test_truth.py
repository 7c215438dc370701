"""What the exam holds to be the same: computed for every case, and right where it is known."""

import pytest
from exams.hidden import draw
from exams.hidden.laws import Hidden
from exams.hidden.refit import SEEN


def drawn(plant, effect, seed):
    names = [e for e in draw.NAMES if draw.sites(draw.PLANTS[plant], e)]
    return draw.single("truth", seed, names.index(effect), (plant,))


@pytest.mark.exam
def test_a_voltage_that_is_off_is_a_constant_push_on_the_current():
    # L di/dt = V + V₀ − R i − k ω: the same as a rate V₀/L of i, however large beside what else moves it.
    (alike,) = drawn("motor", "input-offset", 5).classes()
    assert alike[0] == ("input-offset", "V")
    assert ("constant-force", "i") in alike
    assert ("coulomb-friction", "w") not in alike


def test_what_only_the_held_out_part_shows_does_not_count():
    case = drawn("pendulum", "input-saturation", 3)
    data = draw.Truth(case.rig, case.hidden, case.noise.sigma).data
    assert 0.6 < len(data.resets) * data.length / len(case.rig.u) <= SEEN
    assert data.rows.max() < SEEN * len(case.rig.u)


def test_what_is_not_there_has_no_evidence_however_far_parameters_are_off():
    case = drawn("pendulum", "viscous-friction", 3)
    assert draw.Truth(case.rig, (), case.noise.sigma).evidence() <= 1e-9
    assert draw.Truth(case.rig, case.hidden, case.noise.sigma).evidence() > 9


def test_a_misfit_is_told_in_noise():
    case = drawn("pendulum", "viscous-friction", 3)
    found = []
    for factor in (1.0, 2.0):
        data = draw.Truth(case.rig, case.hidden, {name: factor * s for name, s in case.noise.sigma.items()}).data
        found.append(data.misfit((), case.rig.parameters, data.starts))
    assert abs(found[0]).max() > 1
    assert found[0] == pytest.approx(2 * found[1])


@pytest.mark.exam
def test_two_laws_that_are_one_written_otherwise_stand_for_it():
    # Friction of unequal levels is their mean and a constant force of half their difference, wherever a fit begins.
    case = draw.single("unknown", 201, 7)
    (hidden,) = case.hidden
    assert hidden.key == ("asymmetric-coulomb-friction", "i")
    judge = draw.Truth(case.rig, case.hidden, case.noise.sigma)
    level, force = Hidden("coulomb-friction", "i", {"level": 41.1}), Hidden("constant-force", "i", {"force": -22.1})
    assert judge.stands((level, force))
    assert not judge.stands((level,))


@pytest.mark.exam
def test_what_another_effect_holds_still_is_not_clear_beside_it():
    case = drawn("drive", "linear-spring", 4)
    held, damped = Hidden("coulomb-friction", "q", {"level": 1e4}), Hidden("viscous-friction", "q", {"coefficient": 5.0})
    alone, stuck, moving = (draw.Truth(case.rig, (*case.hidden, *h), case.noise.sigma) for h in ((), (held,), (damped,)))
    assert alone.remains() >= draw.LEFT
    assert stuck.beside() < draw.LEFT <= moving.beside()
