"""The contract that every Model keeps beyond that of Systems: slopes, ranges over boxes, and a spec that builds it again."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np

from gapcert.contracts.plugins.component import Context
from gapcert.contracts.plugins.registry import registry
from gapcert.contracts.systems.extension import Extension
from gapcert.contracts.systems.system import Model
from gapcert.numerics import circle
from gapcert.numerics.arrays import Array, Bools
from gapcert.numerics.errors import GapcertError, UsageError
from gapcert.numerics.intervals import Interval
from gapcert.spec.spec import load_spec
from gapcert.testing.checks import expect
from gapcert.testing.systems import SystemContract

_STEP = float(np.finfo(np.float64).eps) ** (1 / 3)


class ModelContract(SystemContract):
    """Subclass in a test module as `Test…` and supply `system`: pytest then runs every `test_…` below, and those of
    `SystemContract`, on it.

    `context` is what the model is built again in from its own `to_spec`. Boxes lie in `domain`.
    """

    boxes = 60
    context = Context()

    @abstractmethod
    def system(self) -> Model:
        """A new Model, built as a user would build it."""

    def test_outputs_have_columns(self) -> None:
        m, x, u = self._rows()
        y = m.output(x, u)
        shape = (len(x), sum(s.size for s in m.outputs))
        expect(y.shape == shape, f"output has shape {y.shape}; expected {shape}, a column per output")

    def test_jacobian_is_the_slope(self) -> None:
        """Against central differences of the step."""
        m, x, u = self._rows()
        z, found = np.hstack([x, u]), m.jacobian(x, u)
        shape = (len(z), m.nx, z.shape[1])
        expect(found.shape == shape, f"jacobian has shape {found.shape}; expected {shape}")
        for j in range(z.shape[1]):
            reach = np.zeros(z.shape[1])
            reach[j] = _STEP
            slope = self._change(m, z - reach, z + reach) / (2 * _STEP)
            off = np.abs(found[:, :, j] - slope)
            expect(
                bool((off <= 1e-5 * (1 + np.abs(slope))).all()),
                f"∂x⁺/∂{self._axis(m, j)} is off by {off.max():.3g} from central differences",
            )

    def test_enclosure_holds(self) -> None:
        m = self.system()
        boxes = self._boxes(m)
        out = m.enclosure(boxes)
        shape = (len(boxes), m.nx)
        expect(out.shape == shape, f"enclosure has shape {out.shape}; expected {shape}")
        e = m.resolution(np.asarray(out.mag.max(axis=0)))
        for z in _inside(boxes):
            after = self._after(m, z)
            # An angle may come back from the other side of its circle.
            after = circle.near(after, out.mid, self._angles(m))
            bad = (after < out.lo - e) | (after > out.hi + e)
            expect(not bad.any(), f"the next state of a point of a box lies outside its enclosure, {self._worst(m, bad)}")

    def test_enclosure_closes_in(self) -> None:
        """Over a point hardly anything is left: a wide constant is no enclosure."""
        m = self.system()
        points = Interval.exact(self.domain(m).draw(self.boxes, np.random.default_rng(12)))
        out = m.enclosure(points)
        expect(bool((out.width <= 1e-9 * (1 + out.mag)).all()), f"over points the enclosure is {out.width.max():.3g} wide")

    def test_jacobian_enclosure_holds(self) -> None:
        m = self.system()
        boxes = self._boxes(m)
        out = m.jacobian_enclosure(boxes)
        shape = (len(boxes), m.nx, boxes.shape[1])
        expect(out.shape == shape, f"jacobian_enclosure has shape {out.shape}; expected {shape}")
        for z in _inside(boxes):
            slope = m.jacobian(z[:, : m.nx], z[:, m.nx :])
            slack = 1e-9 * (1 + np.abs(slope))
            bad = ((slope < out.lo - slack) | (slope > out.hi + slack)).any(axis=1)
            expect(not bad.any(), "a slope in a box lies outside its enclosure")

    def test_slopes_hold_between_points(self) -> None:
        """f(b) − f(a) ∈ J(box) (b − a) for a, b in the box: what constants are proved with."""
        m = self.system()
        boxes = self._boxes(m)
        out, e = m.jacobian_enclosure(boxes), 2 * m.resolution(np.asarray(m.enclosure(boxes).mag.max(axis=0)))
        change = self._change(m, boxes.lo, boxes.hi)
        most = (out * Interval.exact(boxes.hi - boxes.lo)[:, None, :]).sum(-1)
        bad = (change < most.lo - e) | (change > most.hi + e)
        expect(not bad.any(), f"two points of a box differ by more than its slopes allow, {self._worst(m, bad)}")

    def test_curvature_holds(self) -> None:
        """|Δ²f| along an axis lies within h² times its enclosure, where there is one."""
        m = self.system()
        boxes = self._boxes(m)
        for j in range(boxes.shape[1]):
            out = m.curvature_enclosure(boxes, j)
            low, high = boxes.mid, boxes.mid
            low[:, j], high[:, j] = boxes.lo[:, j], boxes.hi[:, j]
            bend = self._change(m, boxes.mid, high) - self._change(m, low, boxes.mid)
            h2 = ((boxes.hi[:, j] - boxes.lo[:, j]) / 2)[:, None] ** 2
            # Over narrow boxes differences of rounded middles say nothing, and ∞ is no bound.
            known = np.isfinite(out.lo) & np.isfinite(out.hi) & (h2 > 1e-8)
            least, most = (np.where(known, end, 0.0) * h2 for end in (out.lo, out.hi))
            slack = 1e-9 * (1 + np.abs(bend))
            bad = known & ((bend < least - slack) | (bend > most + slack))
            expect(not bad.any(), f"along {self._axis(m, j)} it bends by more than its curvature allows, {self._worst(m, bad)}")

    def test_what_is_said_not_to_move_stays(self) -> None:
        m, x, u = self._rows()
        kept = m.unmoved(u)
        expect(kept.shape == x.shape, f"unmoved has shape {kept.shape}; expected {x.shape}")
        bad = kept & (m.step(x, u).x != x)
        expect(not bad.any(), f"a state that `unmoved` says to stay moves, {self._worst(m, bad)}")

    def test_fast_rollout_is_a_rollout(self) -> None:
        m, x, u = self._rows()
        sequence = np.stack([np.roll(u, k, axis=0) for k in range(4)], axis=1)
        slow, fast = m.rollout(x, sequence).x, m.fast_rollout(x, sequence).x
        expect(slow.shape == fast.shape, f"fast_rollout has shape {fast.shape}; expected {slow.shape}")
        expect(bool(np.allclose(slow, fast, rtol=1e-9, atol=1e-12)), "fast_rollout differs from rollout by more than rounding")

    def test_unknown_sites_are_refused(self) -> None:
        m = self.system()
        try:
            m.extend([Extension("viscous-friction", "no such site", (), force="0")])
        except UsageError:
            return
        raise AssertionError("an effect at a site that does not exist was accepted; expected UsageError")

    def test_equations_are_text(self) -> None:
        m = self.system()
        text, names = m.equations(), [s.name for s in m.states]
        expect(any(name in text for name in names), f"equations are {text[:100]!r}, without any of {', '.join(names)}")

    def test_spec_builds_it_again(self) -> None:
        m, x, u = self._rows()
        section = m.to_spec()
        kind = section.get("kind")
        expect(isinstance(kind, str), f"to_spec has kind {kind!r}; expected the name of a component")
        try:
            # A spec checks more than the component does: units, for one.
            load_spec({"version": 1, "name": "again", "model": section}, folder=self.context.folder)
        except GapcertError as error:
            raise AssertionError(f"a spec with what to_spec says is refused: {error}") from None
        config = registry().config("model", str(kind))
        again: Model = registry().build("model", str(kind), config and config.model_validate(section), self.context)
        expect(np.array_equal(again.step(x, u).x, m.step(x, u).x), "the model that its own spec describes steps elsewhere")

    def _rows(self) -> tuple[Model, Array, Array]:
        m = self.system()
        return m, *self.points(m)

    def _after(self, m: Model, z: Array) -> Array:
        return m.step(z[:, : m.nx], z[:, m.nx :]).x

    def _change(self, m: Model, start: Array, end: Array) -> Array:
        """f(end) − f(start); angles by the shorter way, since a step may wrap them."""
        return circle.near(self._after(m, end) - self._after(m, start), 0.0, self._angles(m))

    def _angles(self, m: Model) -> Bools:
        return np.repeat([s.kind == "angle" for s in m.states], [s.size for s in m.states])

    def _axis(self, m: Model, j: int) -> str:
        return [a.name for a in (*m.states, *m.inputs) for _ in range(a.size)][j]

    def _worst(self, m: Model, bad: Bools) -> str:
        return f"state {self._axis(m, int(np.argwhere(bad)[0][1]))}" if bad.any() else ""

    def _boxes(self, m: Model) -> Interval:
        """Random boxes inside the domain, from half as wide to points."""
        rng, domain = np.random.default_rng(13), self.domain(m)
        low = domain.draw(self.boxes, rng)
        size = np.repeat([0.5, 0.05, 0.001, 0.0], -(-self.boxes // 4))[: self.boxes, None]
        return Interval(low, np.minimum(low + domain.width * rng.random(low.shape) * size, domain.high))


def _inside(boxes: Interval) -> list[Array]:
    """Corners, middles and random points, one of each box at a time."""
    rng = np.random.default_rng(14)
    some = [boxes.lo + rng.random(boxes.shape) * (boxes.hi - boxes.lo) for _ in range(4)]
    return [np.clip(z, boxes.lo, boxes.hi) for z in (boxes.lo, boxes.hi, boxes.mid, *some)]
