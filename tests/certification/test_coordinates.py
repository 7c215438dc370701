"""Inputs measured relative to the states: the map and its inverse, the domain, models and gap functions behind it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gapcert as gc
from gapcert.certification.coordinates import Coordinates, RelativeGap, RelativeModel, RelativeSystem
from gapcert.testing import SystemContract, ToyOscillator

SPEC = {
    "kind": "equations",
    "states": {"p": "m", "v": "m/s"},
    "inputs": {"u": "m/s"},
    "parameters": {"c": "1 m/s", "T": "0.3 s"},
    "derivative": {"p": "v + 0.2*c*sin(u/c)", "v": "(u - v)/T"},
    "integrator": "euler",
    "period": "100 ms",
}


@pytest.fixture(scope="module")
def model():
    return gc.registry().build("model", "equations", gc.registry().config("model", "equations").model_validate(SPEC))


@pytest.fixture(scope="module")
def domain(model):
    return gc.Domain.of(model, {"p": (0, 3), "v": (-1, 1), "u": (-1, 1)}, ["abs(u - v) <= 0.5 m/s"])


class Lagging(gc.Backend):
    """p⁺ = p + τ v + d |d| / 10 with d = u − v, v⁺ = u − d³ / 20: its gap against the model below depends on d alone."""

    def __init__(self):
        self.states = (gc.StateSpec("p", "m"), gc.StateSpec("v", "m/s"))
        self.inputs, self.period = (gc.StateSpec("u", "m/s"),), 0.1

    def _step(self, x, u):
        d = u[:, 0] - x[:, 1]
        return np.stack([x[:, 0] + 0.1 * x[:, 1] + d * np.abs(d) / 10, u[:, 0] - d**3 / 20], axis=1)


def simple():
    spec = SPEC | {"parameters": {"T": "0.1 s"}, "derivative": {"p": "v", "v": "(u - v)/T"}}
    return gc.registry().build("model", "equations", gc.registry().config("model", "equations").model_validate(spec))


class TestRelativeSystem(SystemContract):
    def system(self):
        return RelativeSystem(ToyOscillator(), Coordinates.of(ToyOscillator(), {"d": "2*torque"}))


class Counting(Lagging):
    """Keeps count of its queries, which is no physics, and says so."""

    def __init__(self):
        super().__init__()
        self.asked = 0

    def _step(self, x, u):
        self.asked += len(x)
        return super()._step(x, u)

    def digest(self):
        return "counting"


def test_the_digest_is_what_the_system_says_of_itself(model):
    c, other = (Coordinates.of(model, {"d": text}) for text in ("u - v", "2*u"))
    system = RelativeSystem(Counting(), c)
    before = system.digest()
    system.step(np.zeros((3, 2)), np.zeros((3, 1)))
    assert system.digest() == before
    assert len({before, RelativeSystem(Counting(), other).digest(), RelativeSystem(Lagging(), c).digest()}) == 3
    assert len({RelativeModel(model, k).digest() for k in (c, other)} | {model.digest()}) == 3


def test_domain_is_the_same_set_of_points(model, domain):
    c = Coordinates.of(model, {"d": "u - v"})
    other = c.domain(domain)
    assert (other.inputs.low, other.inputs.high) == ((-0.5,), (0.5,))
    assert len(other.relations) == 2, "the relation on u − v has become the box; the range of u has become relations"
    rng = np.random.default_rng(0)
    w = other.draw(5000, rng)
    z = np.concatenate([w[:, :2], c.inputs(w[:, :2], w[:, 2:])], axis=1)
    assert (domain.zone.dots(z) <= domain.zone.bounds + 1e-15).all()
    assert (np.abs(z[:, 2]) <= 1 + 1e-15).all()
    z = domain.draw(5000, rng)
    w = np.concatenate([z[:, :2], z[:, 2:] - z[:, 1:2]], axis=1)
    assert ((np.abs(w[:, 2]) <= 0.5 + 1e-15) & (other.zone.dots(w) <= other.zone.bounds + 1e-15).all(axis=1)).all()
    assert other.volume == pytest.approx(domain.volume, rel=0.02)


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3), st.lists(st.floats(0, 0.3), min_size=3, max_size=3))
def test_boxes_contain_their_points(middle, half):
    c = Coordinates.of(Lagging(), {"d": "2*u - 0.3*v"})
    low, high = np.array([middle]) - half, np.array([middle]) + half
    boxes = gc.Interval(low, high)
    for share in np.random.default_rng(0).random((20, 3)):
        z = low + (high - low) * share
        w = np.concatenate([z[:, :2], 2 * z[:, 2:] - 0.3 * z[:, 1:2]], axis=1)
        over = c.over(boxes)
        assert ((over.lo <= w + 1e-15) & (w - 1e-15 <= over.hi)).all()
        back = c.inputs_over(gc.Interval(w, w))
        assert ((back.lo <= z + 1e-15) & (z - 1e-15 <= back.hi)).all()


def test_model_is_enclosed_and_differentiated(model):
    c = Coordinates.of(model, {"d": "2*u - 0.3*v"})
    relative, rng = RelativeModel(model, c), np.random.default_rng(0)
    x, w, h = rng.uniform(-1, 1, (40, 2)), rng.uniform(-1, 1, (40, 1)), 1e-6
    j = relative.jacobian(x, w)
    for k in range(3):
        step = np.eye(3)[k] * h
        ends = [relative.step(x + s * step[:2], w + s * step[2:]).x for s in (1, -1)]
        assert np.abs((ends[0] - ends[1]) / (2 * h) - j[:, :, k]).max() < 1e-8
    z = np.concatenate([x, w], axis=1)
    boxes = gc.Interval(z - 0.05, z + 0.05)
    inner = z + 0.05 * rng.uniform(-1, 1, z.shape)
    y, slopes = relative.step(inner[:, :2], inner[:, 2:]).x, relative.jacobian(inner[:, :2], inner[:, 2:])
    f, over = relative.enclosure(boxes), relative.jacobian_enclosure(boxes)
    assert ((f.lo <= y) & (y <= f.hi)).all()
    assert ((over.lo <= slopes + 1e-12) & (slopes <= over.hi + 1e-12)).all()


@pytest.mark.exam
def test_gap_is_tighter_for_the_same_samples_and_holds_at_fresh_points(tmp_path):
    backend, nominal = Lagging(), simple()
    domain = gc.Domain.of(nominal, {"p": (0, 3), "v": (-1, 1), "u": (-1, 1)}, ["abs(u - v) <= 0.5 m/s"])
    c = Coordinates.of(nominal, {"d": "u - v"})
    common = {"sampling": gc.AdaptiveSampling(300), "request": gc.Request("statistical"), "symmetries": ["p"]}
    plain = gc.certify(nominal, backend, domain, folder=tmp_path / "plain", **common)
    relative = gc.certify(
        RelativeModel(nominal, c), RelativeSystem(backend, c), c.domain(domain), folder=tmp_path / "relative", **common
    )
    gap = RelativeGap(relative.gap, c)
    z = domain.draw(50_000, np.random.default_rng(9))
    r = gc.plugin.Residual(backend, nominal)(z)
    low, high = gap.interval(z)
    assert ((low <= r) & (r <= high)).all()
    mean = [np.abs(np.concatenate([g.interval(z)])).max(axis=0).mean(axis=0) for g in (gap, plain.gap)]
    assert (mean[0] < 0.8 * mean[1]).all(), "one of two charges has gone"
    boxes = gc.Interval(z[:500] - 0.01, z[:500] + 0.01)
    over = gap.interval_over(boxes)
    assert ((over.lo <= low[:500]) & (high[:500] <= over.hi)).all()


EXACT = {"kind": "equations", "states": {"p": "m"}, "inputs": {"u": "m"}, "period": "100 ms"}


def test_two_models_are_compared_with_proved_constants(tmp_path):
    """Equations on both sides stay white boxes in other coordinates: a proof needs no estimate."""
    spec = {
        "version": 1,
        "name": "both",
        "model": EXACT | {"next": {"p": "p + 0.1*u"}},
        "backend": EXACT | {"next": {"p": "p + 0.1*u + 0.02*(u - p)"}},
        "domain": {"p": [-1, 1], "u": [-1, 1]},
        "coordinates": {"d": "u - p"},
        "lipschitz": {"residual": {"kind": "interval"}},
        "gap": {"kind": "constant"},
        "certificate": {"claim": "deterministic"},
    }
    made = gc.run(spec, out=tmp_path)
    assert made.summary["verdict"] == "holds"
    assert made.certificate.claim.kind == "deterministic"
    assert np.allclose(made.certificate.lipschitz.value, [[0, 0.02]], atol=1e-12)
    assert made.certificate.states["p"].gamma_max == pytest.approx(0.04, rel=2e-3)


MISTAKES = [
    ({"u": "u - v"}, "coordinates.u: 'u' cannot be its name"),
    ({}, "expected one new name for each input"),
    ({"d": "v"}, "found no input in it; expected a sum of one input and states"),
    ({"d": "abs(u - v)"}, "a constant or abs"),
    ({"d": "u - v + 1"}, "a constant or abs"),
    ({"d": "u - q"}, "coordinates.d: unknown name 'q'"),
    ({"d": "u - v", "e": "2*u"}, "coordinates.e: u stands in d already"),
]


class Crossed(gc.Backend):
    """Two inputs; nothing else about it matters."""

    def __init__(self):
        self.states = (gc.StateSpec("p", "m"), gc.StateSpec("v", "m/s"))
        self.inputs, self.period = (gc.StateSpec("u", "m/s"), gc.StateSpec("w", "m/s")), 0.1

    def _step(self, x, u):
        return x.copy()


def test_the_order_in_which_they_are_written_does_not_matter():
    d, e = {"d": "u - v"}, {"e": "3 s^-1*p - 2*w"}
    c = Coordinates.of(Crossed(), d | e)
    assert c == Coordinates.of(Crossed(), e | d)
    assert [(a.name, a.unit) for a in c.axes] == [("d", "m/s"), ("e", "m/s")]
    assert (c.slope, c.scale) == (((0.0, -1.0), (3.0, 0.0)), (1.0, -2.0))
    assert Coordinates.of(Lagging(), {"d": "p + 0.3 s*u"}).axes[0].unit == "m"


@pytest.mark.parametrize(("given", "message"), MISTAKES)
def test_mistakes(given, message):
    with pytest.raises(gc.UsageError, match=message):
        Coordinates.of(Lagging(), given)
