"""Where Z spans a turn of an angle, f and f̂ repeat with it: proved, probed, or refused with the reason."""

from typing import Any

import numpy as np
import pytest

import gapcert as gc
from gapcert import Backend, Domain, StateSpec
from gapcert.certification.gates.augment import Augmented, AugmentedModel
from gapcert.certification.gates.circle import repeating
from gapcert.plugin import Coordinates, RelativeModel
from gapcert.testing.toys import Opaque

FULL = {"h": (-np.pi, np.pi), "w": (-1.0, 1.0), "u": (-1.0, 1.0)}
PART = FULL | {"h": (-0.4, 0.4)}


def text(h: str = "h + 0.05*w", w: str = "w - 0.2*sin(h) + 0.05*u", **more: Any) -> gc.Model:
    section = {"kind": "equations", "states": {"h": {"unit": "rad", "kind": "angle"}, "w": "1"}, "inputs": {"u": "1"}}
    section |= {"next": {"h": h, "w": w}, "period": "50 ms"} | more
    return gc.load_spec({"version": 1, "name": "circle", "model": section}).build("model")


class Engine(Backend):
    """A pendulum that only answers: on a spring, wound up by a cable, in the answers of a sensor, or in float32."""

    def __init__(self, kind: str = "", said: str | None = None) -> None:
        self.states, self.inputs = (StateSpec("h", "rad", "angle"), StateSpec("w")), (StateSpec("u"),)
        self.period, self.kind, self.said = 0.05, kind, said

    def repeats(self, angle: str) -> str | None:
        return self.said

    def resolution(self, magnitude: np.ndarray) -> np.ndarray:
        single = 4 * np.spacing(np.abs(magnitude).astype(np.float32)).astype(np.float64)
        return single if self.kind == "float32" else super().resolution(magnitude)

    def _step(self, x: np.ndarray, u: np.ndarray, **options: Any) -> np.ndarray:
        h, w = x.T
        pull = {"spring": 1e-4 * h, "cable": 1e-6 * np.floor(h / np.pi), "steep": np.tanh(50 * np.sin(40 * h))}
        new = np.column_stack([h + 0.05 * w, w - 0.21 * np.sin(h) + 0.05 * u[:, 0] - pull.get(self.kind, 0.0)])
        if self.kind == "sensor":
            new[:, 0] = np.arctan2(np.sin(new[:, 0]), np.cos(new[:, 0]))
        return new.astype(np.float32).astype(np.float64) if self.kind == "float32" else new


def told(model: gc.Model, backend: gc.System, ranges: Any = None) -> tuple[str, ...]:
    return repeating(model, backend, Domain.of(model, ranges or FULL), 3)


def test_a_proof_of_both_texts() -> None:
    assert told(text(), text(w="w - 0.19*sin(h) + 0.05*u")) == (
        "h closes on itself (the domain spans a turn); that f repeats with it was proved by its equations, that f̂ does was "
        "proved by its equations.",
    )
    assert told(text(), text(), PART) == ()


@pytest.mark.parametrize("kind", ["", "sensor", "float32", "steep"])
def test_an_engine_is_probed(kind: str) -> None:
    assert "that f̂ does was probed at 64 states, not proved" in told(text(), Engine(kind))[0]
    assert "that f repeats with it was probed" in told(Opaque(text()), Engine(kind))[0]


@pytest.mark.parametrize("kind", ["spring", "cable"])
@pytest.mark.parametrize("said", [None, "", "its cable winds up"])
def test_an_engine_that_winds_up_is_refused_with_both_numbers(kind: str, said: str | None) -> None:
    with pytest.raises(gc.UsageError, match=r"but the backend does not repeat with it: .*it steps to w = .* turn on to") as e:
        told(text(), Engine(kind, said))
    assert (said or "") in str(e.value)
    assert told(text(), Engine(kind, said), PART) == (), "on a part of the turn it is a number"


@pytest.mark.parametrize(("h", "w"), [("0.9*h + 0.05*w", "w"), ("h", "w - 0.2*h"), ("h", "w + exp(-((h - 1)/1e-4)**2)")])
def test_a_text_without_a_proof_is_refused(h: str, w: str) -> None:
    for pair, role in (((text(h, w), text()), "model"), ((text(), text(h, w)), "backend")):
        with pytest.raises(gc.UsageError, match=rf"h closes on itself .*, but the {role} does not repeat with it"):
            told(*pair)
    assert told(text(h, w), text(h, w), PART) == ()


def test_turns_that_only_one_of_both_makes_close_the_circle() -> None:
    """A residual on the circle forgets whole turns; where f̂ makes one, its next step begins there."""
    ahead = text("0.5*h + 0.05*w + 6.283185307179586")
    with pytest.raises(gc.UsageError, match=r"f and f̂ are whole turns apart\), but the model does not repeat"):
        told(text("0.5*h + 0.05*w"), ahead, PART)
    assert "whole turns apart" in told(text(), text("h + 0.05*w + 6.283185307179586"), PART)[0]
    assert told(text(), Engine("sensor"), FULL | {"h": (3.0, 3.4)})[0].startswith("h closes on itself (f and f̂ are whole turns")


def test_what_wraps_a_system_hands_its_proof_on() -> None:
    late = text(input_delay={"u": "50 ms"})
    assert late.repeats("h") == ""
    assert Augmented(late, [late.hidden[0].name]).repeats("h") == ""
    held = AugmentedModel(text(), [StateSpec("turn", "rad", "angle")])
    assert (held.repeats("h"), held.repeats("turn")) == ("", "")
    relative = RelativeModel(text(), Coordinates.of(text(), {"d": "u - w"}))
    assert relative.repeats("h") == ""


def test_a_goal_over_a_turn_needs_a_model_that_repeats() -> None:
    for model, ranges, fits in (
        (text(), FULL, True),
        (text("0.9*h + 0.05*w"), FULL, False),
        (text("0.9*h + 0.05*w"), PART, True),
    ):
        domain = Domain.of(model, ranges)
        goal = gc.Goal("invariance", domain.states)
        if fits:
            goal.check(domain, model)
        else:
            with pytest.raises(gc.UsageError, match=r"the model does not repeat there: a turn of h moves h by 0\.9 turns"):
                goal.check(domain, model)


def test_a_certificate_says_so(tmp_path) -> None:
    options = {"lipschitz": gc.registry().build("lipschitz", "interval"), "sampling": gc.AdaptiveSampling(40)}
    f, fhat = text(), text(w="w - 0.19*sin(h) + 0.05*u")
    made = gc.certify(
        f, fhat, Domain.of(f, FULL), request=gc.Request("deterministic", 0.1, 0.1), folder=tmp_path / "a", **options
    )
    assert made.claim.kind == "deterministic"
    assert sum("h closes on itself" in s for s in made.assumptions) == 1
    with pytest.raises(gc.UsageError, match="does not repeat with it"):
        gc.certify(f, text(w="w - 0.19*h"), Domain.of(f, FULL), folder=tmp_path / "b", **options)
