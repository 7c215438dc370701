"""Relations between states and inputs: texts, the set that they leave, samples in it, certificates over it."""

import json
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gapcert as gc
from gapcert.certification.routes import Request
from gapcert.certification.samples.designs import AdaptiveSampling, GridSampling
from gapcert.certification.supremum import supremum
from gapcert.contracts.data.inequality import MalformedError, parse
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.contracts.systems.domain import Box, Cover, Domain, Relation
from gapcert.contracts.systems.system import Backend, StateSpec
from gapcert.numerics.constraint_zone import Zone
from gapcert.numerics.intervals import Interval
from gapcert.testing.toys import Drift
from gapcert_cells.testing import Band
from gapcert_figures.data import gap_figure
from gapcert_verify.verify import verify_run

UNITS = {"px": "m", "vx": "m/s", "vy": "m/s", "ux": "m/s"}


def half_planes(text, units=UNITS):
    return [(dict(zip(units, r.coefficients, strict=True)), r.bound) for r in parse(text, units)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ux + 2*vy <= 1 m/s", [({"vy": 2, "ux": 1}, 1)]),
        ("ux + 2*vy <= 100 cm/s", [({"vy": 2, "ux": 1}, 1)]),
        ("1 >= -ux/4", [({"ux": -0.25}, 1)]),
        ("abs(ux - vx) <= 0.5", [({"vx": -1, "ux": 1}, 0.5), ({"vx": 1, "ux": -1}, 0.5)]),
        ("2*abs(ux - vx) + 1 <= 2", [({"vx": -2, "ux": 2}, 1), ({"vx": 2, "ux": -2}, 1)]),
        ("px + 0.3 s*ux <= 3 m", [({"px": 1, "ux": 0.3}, 3)]),
        ("-(ux - 3) <= (vx + 1)*2", [({"vx": -2, "ux": -1}, -1)]),
        ("px + ux <= 3", [({"px": 1, "ux": 1}, 3)]),
        ("0.5 m*s^-1 >= ux", [({"ux": 1}, 0.5)]),
        ("1e-1*ux <= .5", [({"ux": 0.1}, 0.5)]),
    ],
)
def test_what_a_text_stands_for(text, expected):
    found = half_planes(text)
    assert len(found) == len(expected)
    for (a, b), (c, d) in zip(found, expected, strict=True):
        assert b == pytest.approx(d)
        assert a == pytest.approx(dict.fromkeys(UNITS, 0.0) | c)


def test_two_folds_are_four_half_planes():
    found = half_planes("abs(vx) + abs(vy) <= 1")
    assert {(a["vx"], a["vy"]) for a, _ in found} == set(product((1, -1), repeat=2))


@pytest.mark.parametrize(
    ("text", "says", "at"),
    [
        ("abs(ux - vz) <= 1", "unknown name 'vz'", "vz"),
        ("ux*vx <= 1", "not linear", "vx"),
        ("1/ux <= 1", "not linear", "ux"),
        ("ux <= 1 kg", "unit 'kg' does not fit; expected m/s", "1 kg"),
        ("ux <= 1 blorps", "unknown unit 'blorps'", "1 blorps"),
        ("px + ux <= 3 m", "ux is in m/s, and the relation in m", "ux"),
        ("abs(ux) >= 1", "leaves two pieces", "abs"),
        ("abs(abs(ux)) <= 1", "inside abs", "abs(abs"),
        ("ux < 1", "expected <= or >=", "< 1"),
        ("0 <= ux <= 1", "one comparison", "<= 1"),
        ("ux - ux <= 1", "no state or input", "ux - ux"),
        ("2 ux <= 1", "found ux behind a number", "ux"),
        ("ux <= 1 $", "unexpected '$'", "$"),
        ("ux <= (1", "expected )", ""),
        ("ux/0 <= 1", "division by zero", "0"),
        ("exec(ux) <= 1", "unknown name 'exec'", "exec"),
        ("", "expected a number", ""),
    ],
)
def test_what_is_wrong_with_a_text_and_where(text, says, at):
    with pytest.raises(MalformedError) as caught:
        parse(text, UNITS)
    assert says in str(caught.value)
    assert text[caught.value.offset :].startswith(at)


SPEC = """\
version: 1
name: cut
model: {kind: equations, states: {p: m, v: m/s}, inputs: {u: m/s}, parameters: {T: 1 s}, next: {p: p + T*u, v: u}, period: 1s}
backend: {kind: equations, states: {p: m, v: m/s}, inputs: {u: m/s}, parameters: {T: 1 s}, next: {p: p + T*v, v: u}, period: 1s}
domain: {p: [0, 3], v: [-1, 1], u: [-1, 1]}
"""


@pytest.mark.parametrize(
    ("lines", "place", "says"),
    [
        ("relations: [abs(u - w) <= 0.5 m/s]", "6:21", "unknown name 'w'"),
        ("relations:\n  - u <= 1\n  - abs(u - v) <= 0.5 kg", "8:19", "unit 'kg' does not fit"),
        ("relations: abs(u) <= 1", "6:12", "expected a list of texts"),
        ("relations: [u >= v + 3]", "6:12", "0 of 20480 points of the box"),
        ("symmetries: {translation: [p, q]}", "6:31", "unknown state or input 'q'"),
        ("symmetries: {translation: []}", "6:27", "at least 1"),
        ("relations: [p + T <= 3]", "6:17", "unknown name 'T'"),
        ("relations: [p <= 2]\nsymmetries: {translation: [p]}", "7:28", "'p' stands in the relation 'p <= 2'"),
        ("coordinates: [u - v]", "6:14", "found a list; expected a mapping"),
        ("coordinates: {d: 3}", "6:18", "coordinates.d: found 3; expected text"),
        ("coordinates: {d: u - w}", "6:22", "unknown name 'w'"),
        ("coordinates: {d: u - 2 kg*v}", "6:27", "v times kg does not fit; expected m/s"),
        ("coordinates: {d: u - (v}", "6:24", "found the end; expected )"),
        ("coordinates: {d: u - v <= 1}", "6:24", "expected a sum, and nothing behind it"),
        ("coordinates: {d: u*v}", "6:20", "not linear"),
        ("coordinates: {d: u - abs(v)}", "6:22", "a constant or abs(...)"),
        ("coordinates: {d: u - v + 1}", "6:26", "a constant or abs(...)"),
        ("coordinates: {d: p - v}", "6:18", "found no input in it"),
        ("coordinates: {d: u - v, e: 2*u}", "6:28", "u stands in d already"),
        ("coordinates: {p: u - v}", "6:15", "'p' cannot be its name"),
        ("coordinates: {d e: u - v}", "6:15", "'d e' cannot be its name"),
        ("coordinates: {}", "6:14", "at least 1"),
        ("hidden: {sample: {ranges: {z: [1, 0]}}}", "6:31", "hidden.sample.ranges.z: [1, 0] is inverted"),
        ("hidden: {sample: {ranges: {z: [1, 1]}}}", "6:31", "hidden.sample.ranges.z: [1, 1] is empty"),
        ("hidden: {sample: {ranges: {z: [.nan, 1]}}}", "6:32", "expected a finite number"),
    ],
)
def test_errors_stand_at_their_place(lines, place, says):
    with pytest.raises(gc.SpecError) as caught:
        gc.load_spec(SPEC + lines + "\n")
    text = str(caught.value)
    assert f"<text>:{place}: error:" in text
    assert says in text
    assert "^" in text


def test_both_sections_are_part_of_the_schema():
    from gapcert.spec.schema import schema

    properties = schema()["else"]["properties"]
    assert properties["relations"]["type"] == "array"
    assert "symmetries" in properties
    spec = gc.load_spec(SPEC + "relations: [abs(u - v) <= 0.5]\nsymmetries: {translation: [p]}\n")
    assert spec.config.relations == ("abs(u - v) <= 0.5",)
    assert spec.config.symmetries.translation == ["p"]


class Cart(Drift):
    """p⁺ = p + u, v⁺ = u, as a Drift with another step."""

    def __init__(self):
        super().__init__(1)
        self.states = self.outputs = (StateSpec("p", "m"), StateSpec("v", "m/s"))
        self.inputs, self.period = (StateSpec("u", "m/s"),), 1.0

    def _step(self, x, u, **options):
        return np.stack([x[:, 0] + u[:, 0], u[:, 0]], axis=1)

    def enclosure(self, z):
        return Interval.stack([z[:, 0] + z[:, 2], z[:, 2]], axis=1)


RANGES = {"p": (0.0, 3.0), "v": (-1.0, 1.0), "u": (-1.0, 1.0)}
CUT = "abs(u - v) <= 0.5 m/s"


def cut(*texts):
    return Domain.of(Cart(), RANGES, texts or (CUT,))


class Guarded(Backend):
    """A cart that cannot reverse: asked to, it fails the test. r_p = 0.2 (v − u)², r_v = 0.1 (v − u), plus `drift`(p)."""

    def __init__(self, drift=None, limit=0.5):
        model = Cart()
        self.states, self.inputs, self.period = model.states, model.inputs, model.period
        self.drift, self.limit = drift, limit

    def _step(self, x, u, **options):
        change = x[:, 1] - u[:, 0]
        assert (np.abs(change) <= self.limit).all(), "asked outside Z"
        p = x[:, 0] + u[:, 0] + 0.2 * change**2 + (0.0 if self.drift is None else self.drift(x[:, 0]))
        return np.stack([p, u[:, 0] + 0.1 * change], axis=1)


# On |u − v| ≤ 0.5: |∂r_p| = 0.4 |v − u| ≤ 0.2; over the whole box it would be 0.8.
CONSTANTS = {"p": {"p": 0.0, "v": 0.2, "u": 0.2}, "v": {"p": 0.0, "v": 0.1, "u": 0.1}}


def declared():
    return gc.registry().get("lipschitz", "declared").load()(values=CONSTANTS)


def family(name, **options):
    return gc.registry().get("gap_family", name).load()(**options)


def certified(tmp_path, domain=None, backend=None, **options):
    options = {
        "sampling": AdaptiveSampling(150),
        "lipschitz": declared(),
        "family": family("envelope", predictor="none"),
        **options,
    }
    options.setdefault("request", Request("deterministic", 1e-2, 1e-3, attack=20_000))
    return gc.certify(Cart(), backend or Guarded(), domain or cut(), folder=tmp_path / "run", **options)


class TestDomain:
    def test_draws_are_uniform_on_what_is_left(self):
        z = cut().draw(40_000, np.random.default_rng(1))
        assert cut().contains(z).all()
        assert len(z) == 40_000
        # |u − v| ≤ 0.5 leaves 7/16 of the square; the lower left quarter of it holds (1 − 1/8)/4 · 2 of that … by symmetry a
        # quarter of the triangle's complement: compared with what rejection by hand gives.
        box = np.random.default_rng(2).uniform((0, -1, -1), (3, 1, 1), (200_000, 3))
        kept = box[np.abs(box[:, 2] - box[:, 1]) <= 0.5]
        assert z.mean(axis=0) == pytest.approx(kept.mean(axis=0), abs=0.02)
        assert z.std(axis=0) == pytest.approx(kept.std(axis=0), rel=0.02)
        assert cut().volume == pytest.approx(12 * 7 / 16, rel=0.02)

    def test_draws_are_a_function_of_the_generator(self):
        one, two = (cut().draw(500, np.random.default_rng(7)) for _ in range(2))
        assert np.array_equal(one, two)
        plain = Domain.of(Cart(), RANGES)
        low, width = plain.low, plain.width
        assert np.array_equal(plain.draw(9, np.random.default_rng(7)), low + width * np.random.default_rng(7).random((9, 3)))

    def test_a_relation_of_nothing_is_refused(self):
        box = Domain.of(Cart(), RANGES)
        nothing = gc.plugin.Relation("0 <= 1", (0.0,) * len(box.axes), 1.0)
        with pytest.raises(gc.UsageError, match=r"give one finite number per state and input .*, not all 0"):
            Domain(box.states, box.inputs, (nothing,))

    def test_relations_that_leave_nothing_are_refused(self):
        for text in ("u >= v + 3", "abs(u - v) <= 1e-6"):
            with pytest.raises(gc.UsageError, match="points of the box satisfy them"):
                cut(text)

    def test_identity_changes_with_relations_only(self):
        plain = Domain.of(Cart(), RANGES)
        assert plain.digest_data() == [["p", "m", "real"], ["v", "m/s", "real"], ["u", "m/s", "real"], [0, -1, -1], [3, 1, 1]]
        assert cut().digest_data() != plain.digest_data()
        assert cut().digest_data() != cut("abs(u - v) <= 0.4").digest_data()

    def test_a_wrong_text_is_a_usage_error(self):
        with pytest.raises(gc.UsageError, match=r"domain.relations: 'u <= w', character 6: unknown name 'w'"):
            cut("u <= w")

    def test_coefficients_that_do_not_fit(self):
        box = cut().states
        with pytest.raises(gc.UsageError, match="one finite number per state and input"):
            Domain(box, cut().inputs, (Relation("?", (1.0, 1.0), 0.0),))

    @settings(max_examples=40, deadline=None)
    @given(st.integers(0, 10_000))
    def test_geometry(self, seed):
        """Boxes called outside hold no point of Z; moved points lie in Z; chords and ways end in Z, and no earlier."""
        rng = np.random.default_rng(seed)
        relations = tuple(
            Relation("r", tuple(rng.normal(size=4)), float(rng.uniform(-0.2, 1))) for _ in range(rng.integers(1, 5))
        )
        zone = Zone((-1.0,) * 4, (1.0,) * 4, relations)
        try:
            points = zone.draw(2_000, rng)
        except gc.UsageError:
            return
        low = rng.uniform(-1, 0.8, (60, 4))
        boxes = Interval(low, np.minimum(low + rng.uniform(0.01, 0.8, (60, 4)), 1.0))
        holds = ((points >= boxes.lo[:, None]) & (points <= boxes.hi[:, None])).all(axis=2).any(axis=1)
        assert not (zone.outside(boxes) & holds).any()
        moved = zone.inside(boxes.mid, boxes)
        assert zone.contains(moved).all()
        stay = zone.contains(boxes.mid)
        assert np.array_equal(moved[stay], boxes.mid[stay])
        own = ((moved >= boxes.lo) & (moved <= boxes.hi)).all(axis=1)
        assert own[holds].mean() >= 0.9 if holds.sum() > 20 else True
        assert zone.contains(zone.centre[None]).all()
        target = rng.uniform(-1, 1, points.shape)
        end = zone.reach(points, target)
        assert zone.contains(end).all()
        further = end + 1e-6 * (target - points)
        assert (zone.contains(target) | ~zone.contains(further)).all()
        a, b = zone.chord(points[:50], 2)
        for ends, beyond in ((a, -1e-6), (b, 1e-6)):
            z = points[:50].copy()
            z[:, 2] = ends
            assert zone.related(z).all()
            z[:, 2] += beyond
            assert not zone.contains(z).any()


class TestDesigns:
    @pytest.mark.parametrize("counts", [(1, 7, 7), (4, 10, 9), (2, 3, 50)])
    def test_a_cover_covers_what_is_left(self, counts):
        domain = cut()
        cover = Cover(domain, counts)
        p, h = cover.chunk(0, len(cover)), cover.half_widths()
        assert domain.contains(p).all()
        z = domain.draw(4_000, np.random.default_rng(3))
        near = (np.abs(z[:, None] - p[None]) <= h).all(axis=2).any(axis=1)
        assert near.all()
        assert len(cover) < np.prod(counts) or counts[1] < 4
        assert np.array_equal(np.concatenate([cover.chunk(0, 5), cover.chunk(5, len(cover))]), p)
        assert np.array_equal(cover.at(np.array([3, 1])), p[[3, 1]])

    def test_the_radius_of_moved_points_is_needed(self):
        """With the plain half-widths of the cells some point would be uncovered."""
        domain, counts = cut(), (1, 7, 5)
        cover = Cover(domain, counts)
        p, plain = cover.chunk(0, len(cover)), Cover(Domain.of(Cart(), RANGES), counts).half_widths()
        z = domain.draw(20_000, np.random.default_rng(3))
        assert not (np.abs(z[:, None] - p[None]) <= plain).all(axis=2).any(axis=1).all()

    def test_covering_keeps_its_radius(self):
        grid = GridSampling.covering(cut(), 2.0, 0.1)
        ex, eu = grid.first(cut()).radii()
        assert ex <= 2.0
        assert 0.08 < eu <= 0.1

    def test_adaptive_samples_lie_in_the_domain_and_spend_the_budget(self):
        domain, rng = cut(), np.random.default_rng(0)
        for held in ((), (0,)):
            plan = AdaptiveSampling(400).holding(held)
            z = plan.first(domain).z
            more = plan.further(domain, z, rng.random((len(z), 2)), np.array([[0.0, 0.2, 0.2], [0.0, 0.1, 0.1]]))
            both = np.concatenate([z, more])
            assert domain.contains(both).all()
            assert 380 <= len(both) <= 400
            assert len(np.unique(both, axis=0)) == len(both)
            assert not held or (both[:, 0] == 1.5).all()


class TestCertificate:
    @pytest.mark.parametrize("sampling", [AdaptiveSampling(150), GridSampling((1, 12, 12))])
    def test_nothing_is_asked_outside_and_the_bound_holds(self, tmp_path, sampling):
        """`Guarded` fails when asked outside Z; declared constants hold on Z alone, and no fresh point of Z refutes them."""
        c = certified(tmp_path, sampling=sampling)
        assert c.claim.kind == "deterministic"
        assert c.attack == {"points": 20_000, "violations": 0, "gamma_violations": 0}
        assert c.domain.contains(c.samples.z).all()
        c.save(tmp_path / "run")
        assert verify_run(tmp_path / "run")["verdict"] == "holds"

    def test_constants_of_the_cut_domain_do_not_hold_on_the_box(self, tmp_path):
        """Without the relation the same constants are refuted: what it saves is real, and dropping it is caught."""
        c = certified(tmp_path, Domain.of(Cart(), RANGES), Guarded(limit=9))
        assert not c.holds
        assert c.claim.kind == "empirical"

    def test_route_theorem1(self, tmp_path):
        c = certified(tmp_path, sampling=GridSampling((1, 30, 30)), family=family("constant"), route="theorem1")
        assert c.holds
        assert c.claim.kind == "deterministic"
        assert c.states["p"].gamma_max < 0.2 * 0.25 + 0.2 * 0.3
        c.save(tmp_path / "run")
        assert verify_run(tmp_path / "run")["verdict"] == "holds"

    def test_estimated_constants_come_from_pairs_within(self, tmp_path):
        estimator = gc.registry().get("lipschitz", "wood-zhang").load()(pairs=400, batches=20)
        c = certified(tmp_path, lipschitz=estimator, request=Request("statistical", 1e-2, 1e-3))
        assert c.claim.summary()["distribution"] == "uniform on X × U within its relations"
        # sup over Z is 0.2, over the box 0.8.
        assert 0.2 < c.lipschitz.value[0, 1] < 0.3
        assert c.lipschitz.value[1, 2] == pytest.approx(0.12, rel=0.02)

    def test_no_room_for_pairs_is_said(self, tmp_path):
        estimator = gc.registry().get("lipschitz", "wood-zhang").load()(pairs=100, batches=10, distance=1.0)
        with pytest.raises(gc.UsageError, match=r"room for a pair along 'v' within the relations; give a smaller distance"):
            certified(tmp_path, lipschitz=estimator, request=Request("empirical"))

    def test_the_supremum_is_that_of_what_is_left(self):
        class Steep(Band):
            """γ = |u − v|: 2 on the box, 0.5 where the relation holds."""

            __init__ = object.__init__

            def interval(self, z):
                size = np.abs(z[:, 2:] - z[:, 1:2]).repeat(2, axis=1)
                return -size, size

            def interval_over(self, boxes):
                size = abs(boxes[:, 2:] - boxes[:, 1:2]).hi.repeat(2, axis=1)
                return Interval(-size, size)

            def lipschitz(self, boxes):
                return np.broadcast_to([0.0, 1.0, 1.0], (len(boxes), 2, 3))

        upper, lower = supremum(Steep(), cut(), tolerance=1e-2)
        assert (lower <= 0.5).all()
        assert (upper >= 0.5).all()
        assert (upper <= 0.5 * 1.03).all()
        assert supremum(Steep(), cut(), tolerance=1e-2, states=[1])[0] == upper[1:]

    def test_a_changed_relation_is_noticed(self, tmp_path):
        c = certified(tmp_path)
        c.save(tmp_path / "run")
        path = tmp_path / "run" / "certificate.json"
        data = json.loads(path.read_text())
        data["domain"]["relations"][0]["b"] = 0.4
        path.write_text(json.dumps(data))
        failed = [check["check"] for check in verify_run(tmp_path / "run")["checks"] if not check["passed"]]
        assert "sampled and audited points lie in Z" in failed
        assert "the audit's points are those that its seed draws" in failed

    def test_pictures_leave_out_what_is_outside(self, tmp_path):
        domain = Domain(
            Box(Cart().states[::-1], (-1.0, 0.0), (1.0, 3.0)), cut().inputs, (Relation("u <= v", (-1.0, 0, 1.0), 0.1),)
        )
        c = certified(tmp_path)
        figure = gap_figure(c, Residual(Guarded(), Cart()), cut())
        assert np.isnan(figure.slices[0].gamma).any() == np.isnan(figure.slices[0].gap).any()
        assert all(np.isfinite(b.gamma).all() and np.abs(b.at).max() <= 3 for b in figure.bands)
        along_u = next(b for b in figure.bands if b.axis.name == "u")
        assert np.ptp(along_u.at) == pytest.approx(1.0)
        assert not domain.contains(np.array([[-1.0, 0.0, 1.0]])).any()


def creep(p):
    return 0.01 * p


def rare(p):
    return np.where(np.abs(p - 1.0) < 0.01, 5e-3, 0.0)


def needle(p):
    return np.where(np.abs(p - 1.0) < 1e-4, 0.5, 0.0)


class TestSymmetry:
    def test_it_saves_samples_and_is_assumed(self, tmp_path):
        c = certified(tmp_path, symmetries=["p"], request=Request("statistical", 1e-2, 1e-3))
        assert (c.samples.z[:, 0] == 1.5).all()
        assert np.ptp(c.audit.z[:, 0]) > 2.9, "the audit goes over all of Z"
        assert c.holds
        assert c.summary()["samples"]["symmetry"] == 1000
        assert any("residual does not change when p is shifted: declared by the user" in s for s in c.assumptions)
        c.save(tmp_path / "run")
        assert verify_run(tmp_path / "run")["verdict"] == "holds"

    def test_no_pairs_are_spent_along_it(self, tmp_path):
        estimator = gc.registry().get("lipschitz", "wood-zhang").load()(pairs=400, batches=20)
        c = certified(tmp_path, lipschitz=estimator, symmetries=["p"], request=Request("statistical", 1e-2, 1e-3))
        assert c.lipschitz.samples < 2 * 400 * 3
        assert (c.lipschitz.value[:, 0] == 0).all()
        assert not (tmp_path / "run" / "samples" / "lipschitz-p").exists()

    @pytest.mark.parametrize("drift", [creep, rare])
    def test_one_that_does_not_hold_is_refused_with_a_witness(self, tmp_path, drift):
        says = r"symmetries.translation: the residual of p changes by .* from \(x, u\) = \[.*\] to \[.*\], .* pairs by more"
        with pytest.raises(gc.UsageError, match=says):
            certified(tmp_path, backend=Guarded(drift), symmetries=["p"])

    def test_one_that_breaks_too_rarely_for_the_check_is_caught_by_audit_or_attack(self, tmp_path):
        c = certified(
            tmp_path, backend=Guarded(needle), symmetries=["p"], request=Request("statistical", 1e-3, 1e-6, attack=100_000)
        )
        assert not c.holds
        assert c.claim.kind == "empirical"

    def test_a_forged_pair_is_noticed(self, tmp_path):
        c = certified(tmp_path, symmetries=["p"], request=Request("statistical", 1e-2, 1e-3))
        c.save(tmp_path / "run")
        path = tmp_path / "run" / "certificate.json"
        data = json.loads(path.read_text())
        data["symmetry"]["axes"] = [1]
        path.write_text(json.dumps(data))
        failed = [check["check"] for check in verify_run(tmp_path / "run")["checks"] if not check["passed"]]
        assert failed == ["the declared symmetry holds on the pairs that were looked at"]

    def test_a_predictor_that_breaks_it_pays_for_that(self, tmp_path):
        from gapcert.contracts.gaps.predictor import AffinePredictor

        p = AffinePredictor(np.zeros(2), np.array([[0.01, 0, 0], [0, 0, 0]]))
        c = certified(tmp_path, predictor=p, symmetries=["p"], request=Request("statistical", 1e-2, 1e-3, attack=5_000))
        assert c.lipschitz.value[0, 0] == pytest.approx(0.01)
        assert c.holds

    def test_one_cell_of_a_grid_is_enough(self, tmp_path):
        options = {
            "family": family("constant"),
            "route": "theorem1",
            "sampling": GridSampling((40, 30, 30)),
            "symmetries": ["p"],
        }
        c = certified(tmp_path, **options)
        assert c.samples.cover.counts == (1, 30, 30)
        assert c.holds
        assert c.states["p"].gamma_max < 0.12, "the axis that is held does not count in the margin"
        c.save(tmp_path / "run")
        assert verify_run(tmp_path / "run")["verdict"] == "holds"

    def test_axes_that_relations_involve_are_refused(self, tmp_path):
        with pytest.raises(gc.UsageError, match="'v' stands in the relation"):
            certified(tmp_path, symmetries=["v"])
        with pytest.raises(gc.UsageError, match="'q' is no state or input"):
            certified(tmp_path, symmetries=["q"])
