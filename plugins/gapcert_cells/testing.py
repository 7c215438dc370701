"""The contract of synthesizers, and the plant that it is checked on."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import numpy as np

from gapcert.plugin import (
    Array,
    Box,
    Controller,
    Domain,
    GapFunction,
    Goal,
    Interval,
    Model,
    Region,
    StateSpec,
    SynthesisProblem,
    Synthesizer,
    UsageError,
)

from .load import load_controller


@final
class Rod(Model):
    """A uniform rod on a hinge, one explicit Euler step: θ⁺ = θ + τω, ω⁺ = ω + τ(−(3g/2l) sin θ + 3u/(ml²)), m = l = 1."""

    def __init__(self, period: float = 0.005) -> None:
        self.states = (StateSpec("theta", "rad", "angle"), StateSpec("omega", "rad/s"))
        self.inputs = (StateSpec("torque", "N*m"),)
        self.outputs = self.states
        self.period = period

    def _step(self, x: Array, u: Array, **options: Any) -> Array:
        theta, omega = x[:, 0], x[:, 1]
        pull = 3 * u[:, 0] - 1.5 * 9.81 * np.sin(theta)
        return np.stack([theta + self.period * omega, omega + self.period * pull], axis=1)

    def jacobian(self, x: Array, u: Array) -> Array:
        return self._slope(Interval.exact(x[:, 0])).lo

    def enclosure(self, z: Interval) -> Interval:
        theta, omega, torque = z[:, 0], z[:, 1], z[:, 2]
        pull = torque * 3.0 - theta.sin() * (Interval.exact(9.81) * 1.5)
        return Interval.stack([theta + omega * self.period, omega + pull * self.period], axis=1)

    def jacobian_enclosure(self, z: Interval) -> Interval:
        return self._slope(z[:, 0])

    def _slope(self, theta: Interval) -> Interval:
        one, zero = np.ones(len(theta)), np.zeros(len(theta))
        sway = theta.cos() * (Interval.exact(9.81) * -1.5) * self.period
        rows: list[list[Any]] = [[one, one * self.period, zero], [sway, one, Interval.exact(one) * 3.0 * self.period]]
        return Interval.stack([Interval.stack(row, axis=1) for row in rows], axis=1)

    def equations(self) -> str:
        return f"theta⁺ = theta + {self.period:g} omega\nomega⁺ = omega + {self.period:g} (3 torque − 14.715 sin(theta))"

    def to_spec(self) -> dict[str, Any]:
        raise UsageError("Rod: a toy without a spec; use an equations model")


@final
class Band(GapFunction):
    """The same signed interval [low_i, high_i] for state i everywhere."""

    family = "band"

    def __init__(self, low: Sequence[float], high: Sequence[float]) -> None:
        self.low, self.high = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)

    def interval(self, z: Array) -> tuple[Array, Array]:
        return np.tile(self.low, (len(z), 1)), np.tile(self.high, (len(z), 1))

    def interval_over(self, boxes: Interval) -> Interval:
        return Interval(*self.interval(boxes.lo))

    def arrays(self) -> dict[str, Array]:
        return {"low": self.low, "high": self.high}

    @property
    def form(self) -> Mapping[str, Any]:
        return {"form": "constant"}

    def lipschitz(self, boxes: Interval) -> Array:
        return np.zeros((len(boxes), len(self.low), boxes.shape[1]))


def rod_problem(goal: Goal | None = None, gap: GapFunction | None = None) -> SynthesisProblem:
    """Keep a Rod in θ ∈ [0, 0.2], ω ∈ [−0.25, 0.25], or any other goal within θ ± 0.2."""
    model = Rod()
    domain = Domain.of(model, {"theta": (-0.2, 0.2), "omega": (-0.25, 0.25), "torque": (-1.0, 1.0)})
    stay = Box(model.states, (0.0, -0.25), (0.2, 0.25))
    return SynthesisProblem(model, gap, domain, goal or Goal("invariance", stay))


def rod_reach_avoid() -> Goal:
    """Reach θ ∈ [0.05, 0.15] slowly, without an overspeed to the right."""

    def box(low: tuple[float, ...], high: tuple[float, ...]) -> Box:
        return Box(Rod().states, low, high)

    return Goal(
        "reach_avoid",
        box((-0.2, -0.25), (0.2, 0.25)),
        Region((box((0.05, -0.1), (0.15, 0.1)),)),
        Region((box((-0.2, 0.2), (0.0, 0.25)),)),
    )


class SynthesizerContract(ABC):
    """What every synthesizer must do. Subclass it in a test, implement `synthesizer`, and pytest runs the checks.

    The problems are those of `rod_problem`: states theta and omega, input torque.
    """

    gap = Band((-1.5e-4, -6e-5), (1.5e-4, 6e-5))
    hopeless = Band((-1.0, -1.0), (1.0, 1.0))
    states = 1000

    @abstractmethod
    def synthesizer(self) -> Synthesizer:
        """A new synthesizer, able to hold a Rod under the gap of this contract."""

    def controller(self, goal: Goal | None = None, gap: GapFunction | None = None) -> Controller:
        """Made against the contract's gap unless another is given."""
        return self.synthesizer().synthesize(rod_problem(goal, gap or self.gap))

    def test_invariance_is_sound(self) -> None:
        """Under every policy and the worst disturbances, winning states lead to winning states, 200 times over."""
        controller = self.controller()
        for policy in controller.policies:
            x = self._drawn(controller)
            for k in range(200):
                after = self._disturbed(x, controller.act(x, policy, k=k), k)
                bad = ~controller.contains(after)
                assert not bad.any(), f"policy {policy}: {x[bad][0]} has the successor {after[bad][0]}, outside the domain"
                x = after

    def test_reach_avoid_is_sound(self) -> None:
        """Under every policy and the worst disturbances, every run arrives, and touches no obstacle on its way."""
        controller = self.controller(rod_reach_avoid())
        for policy in controller.policies:
            x = self._drawn(controller)
            for k in range(1000):
                x = x[~controller.goal.reached(x)]
                if not len(x):
                    break
                assert controller.goal.holds(x).all(), f"policy {policy}: a run left `stay` or touched an obstacle"
                assert controller.contains(x).all(), f"policy {policy}: a run left the controller's domain"
                x = self._disturbed(x, controller.act(x, policy, k=k), k)
            assert not len(x), f"policy {policy}: {len(x)} runs have not reached the target after 1000 steps"

    def test_domain_keeps_to_the_goal(self) -> None:
        for goal in (None, rod_reach_avoid()):
            controller = self.controller(goal)
            x = rod_problem().domain.states
            points = np.random.default_rng(1).uniform(np.multiply(x.low, 1.5), np.multiply(x.high, 1.5), (self.states, 2))
            bad = controller.contains(points) & ~controller.goal.holds(points)
            assert not bad.any(), f"{points[bad][0]} is in the controller's domain and violates the goal"

    def test_inputs_keep_to_the_domain(self) -> None:
        controller = self.controller()
        x = self._drawn(controller)
        for policy in controller.policies:
            u = controller.act(x, policy)
            assert rod_problem().domain.inputs.contains(u).all(), f"policy {policy}: an input is outside its range"

    def test_outside_is_an_error(self) -> None:
        controller = self.controller()
        low, high = np.asarray(controller.goal.stay.low), np.asarray(controller.goal.stay.high)
        for x in (np.nextafter(low, -np.inf), np.nextafter(high, np.inf), high + 0.01, np.full(2, np.nan)):
            assert not controller.contains(x[None])[0], f"{x} is outside `stay`, but the controller claims it"
            try:
                controller.act(x[None], "first")
            except UsageError:
                continue
            raise AssertionError(f"act({x}) gave an input outside the controller's domain")

    def test_nothing_wins_with_a_reason(self) -> None:
        controller = self.controller(gap=self.hopeless)
        box = controller.goal.stay
        points = np.random.default_rng(2).uniform(box.low, box.high, (self.states, 2))
        assert not controller.contains(points).any(), "a state wins against a gap larger than the goal"
        assert str(controller.evidence.get("reason", "")).strip(), "nothing wins, and `evidence` has no reason"

    def test_deterministic(self) -> None:
        one, two = self.controller(), self.controller()
        x = self._drawn(one)
        for policy in one.policies:
            assert np.array_equal(one.act(x, policy), two.act(x, policy)), f"policy {policy}: two syntheses differ"
            assert np.array_equal(one.act(x, policy), one.act(x, policy)), f"policy {policy}: act is not pure"

    def test_gap_shrinks_the_domain(self) -> None:
        trusting, careful = self.synthesizer().synthesize(rod_problem()), self.controller()
        bad = ~trusting.contains(self._drawn(careful))
        assert not bad.any(), "a state wins against the gap and loses without it"
        assert not careful.contains(self._drawn(trusting)).all(), "the gap costs nothing: is it used?"

    def test_saved_and_loaded(self) -> None:
        """A saved controller is found again by its kind, and answers the same."""
        controller = self.controller()
        with tempfile.TemporaryDirectory() as folder:
            controller.save(Path(folder))
            loaded: Controller = load_controller(folder)
        x = self._drawn(controller)
        both: tuple[Any, Any] = controller, loaded
        if all(hasattr(c, "digest") for c in both):
            assert both[0].digest() == both[1].digest(), "the loaded controller differs"
        assert dict(loaded.evidence) == dict(controller.evidence), "the evidence differs after loading"
        points = np.random.default_rng(3).uniform(controller.goal.stay.low, controller.goal.stay.high, (self.states, 2))
        assert np.array_equal(loaded.contains(points), controller.contains(points)), "the domain differs after loading"
        assert all(np.array_equal(loaded.act(x, p), controller.act(x, p)) for p in controller.policies), "loaded inputs differ"

    def test_says_what_it_rests_on(self) -> None:
        """The certificate of the problem is in the controller's evidence, so that it is saved, and that of each step."""
        certified = replace(rod_problem(gap=self.gap), certificate="5a" * 32)
        controller = self.synthesizer().synthesize(certified)
        assert controller.evidence.get("certificate") == certified.certificate, "the evidence leaves out `problem.basis`"

    def test_steps_online(self) -> None:
        """`step` gives inputs of the domain whose tube holds the next state, and none outside the controller's domain."""
        controller, rng = self.controller(), np.random.default_rng(4)
        for x in self._drawn(controller)[:20]:
            u, info = controller.step(x)
            assert u is not None, f"no input at {x}, which is in the controller's domain"
            assert info.feasible, f"an input at {x}, and it is said not to be feasible"
            assert rod_problem().domain.inputs.contains(u[None]).all(), "an input is outside its range"
            if info.tube is None:
                continue
            r = self.gap.low + (self.gap.high - self.gap.low) * rng.random((64, 2))
            after = rod_problem().model.step(np.tile(x, (64, 1)), np.tile(u, (64, 1))).x + r
            bad = ((after < info.tube[0, :, 0]) | (after > info.tube[0, :, 1])).any(axis=1)
            assert not bad.any(), f"from {x} the next state may be {after[bad][0]}, outside the tube"
        u, info = controller.step(np.asarray(controller.goal.stay.high) + 0.01)
        assert u is None, "`step` gave an input outside the controller's domain"
        assert not info.feasible, "`step` says that a state outside the controller's domain is feasible"

    def _drawn(self, controller: Controller) -> Array:
        x = controller.draw(self.states, np.random.default_rng(0))
        assert len(x), "the controller's domain is empty, or `draw` finds nothing in it"
        return x

    def _disturbed(self, x: Array, u: Array, k: int) -> Array:
        """f plus the gap: a quarter of the rows anywhere in its interval, the others for ever at one corner of it."""
        corners = np.random.default_rng(100).random((self.states, x.shape[1]))[: len(x)]
        anywhere = np.random.default_rng(101 + k).random(x.shape)
        share = np.where(np.arange(len(x))[:, None] % 4 == 0, anywhere, np.round(corners))
        r = np.clip(self.gap.low + (self.gap.high - self.gap.low) * share, self.gap.low, self.gap.high)
        return np.asarray(rod_problem().model.step(x, u).x + r)
