"""Family and predictor `multilinear` from spec to certificate, and forged certificates of them."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest
from forging import edit_arrays, edit_json

import gapcert as gc
from gapcert.certification.samples import designs
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert_bounds import MultilinearPredictor
from gapcert_verify.verify import verify_run

VALUES, CURVATURE = {"x0": {"x0": 0.03, "u0": 0.08}}, {"x0": {"x0": 0.09, "u0": 0.04}}
LATTICE = {"family": "multilinear", "sampling": gc.LatticeSampling(budget=200)}


def certified(folder, lipschitz, family="envelope", predictor="affine", sampling=None):
    model = Drift(1)
    made = gc.certify(
        model,
        Perturbed(model, ripple),
        gc.Domain.of(model, {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}),
        family=gc.registry().get("gap_family", family).load()(predictor=predictor),
        lipschitz=lipschitz,
        sampling=sampling,
        request=gc.Request("statistical", 1e-2, 1e-3),
        folder=folder,
    )
    made.save(folder)
    return made


def bounds(factor=1.0, steeper=1.0):
    values = {"x0": {k: v * steeper for k, v in VALUES["x0"].items()}}
    bent = {"x0": {k: v * factor for k, v in CURVATURE["x0"].items()}}
    return gc.registry().get("lipschitz", "declared").load()(values=values, curvature=bent)


def in_parts(**changes):
    """0.01 sin(3 x) bends by 0.09 at most, and by 0.0271 where |x| ≤ 0.1."""
    parts = [[-1.0, -0.1, 0.09], [-0.1, 0.1, 0.0271], [0.1, 1.0, 0.09]]
    curvature = {"x0": {"x0": parts, "u0": 0.04, **changes}}
    return gc.registry().get("lipschitz", "declared").load()(values=VALUES, curvature=curvature)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("multilinear")
    wide = gc.registry().get("lipschitz", "declared").load()(values={"x0": {"x0": 0.2, "u0": 0.2}})
    certified(folder / "family", **LATTICE, predictor="none", lipschitz=bounds())
    certified(folder / "affine", **LATTICE, lipschitz=bounds(1.5, 2.0))
    certified(folder / "predictor", predictor="multilinear", lipschitz=wide)
    certified(folder / "supremum", family="constant", predictor="multilinear", lipschitz=wide)
    certified(folder / "slabs", **LATTICE, predictor="none", lipschitz=in_parts())
    counts = gc.LatticeSampling((5, 9))
    certified(folder / "low", **{**LATTICE, "sampling": counts}, predictor="none", lipschitz=bounds(0.1))
    return folder


@pytest.mark.parametrize("name", ["family", "affine", "slabs", "predictor", "supremum"])
def test_honest_certificates_verify(runs, name):
    assert [c for c in verify_run(runs / name)["checks"] if not c["passed"]] == []


def test_too_little_curvature_is_refuted_by_the_nodes_themselves(runs):
    result = verify_run(runs / "low")
    assert result["claim"] == {"kind": "empirical"}
    assert any("second differences" in c["detail"] for c in result["checks"])


FORGERIES = {
    "less curvature": (
        lambda r: edit_arrays(r, curvature=lambda a: a * 0.9, gap__H0=lambda a: a * 0.9, gap__H1=lambda a: a * 0.9),
        "figures",
    ),
    "far less curvature": (
        lambda r: edit_arrays(r, curvature=lambda a: a * 0.1, gap__H0=lambda a: a * 0.1, gap__H1=lambda a: a * 0.1),
        "contradict",
    ),
    "curvature of the function alone": (
        lambda r: edit_arrays(r, gap__H0=lambda a: a * 0.9, gap__H1=lambda a: a * 0.9),
        "stored function",
    ),
    "negative curvature": (
        lambda r: edit_arrays(r, curvature=lambda a: -a, gap__H0=lambda a: -a, gap__H1=lambda a: -a),
        "contradict",
    ),
    "other nodes": (lambda r: edit_arrays(r, gap__axis1=lambda a: a * 0.9), "stored function"),
    "one node less": (lambda r: edit_arrays(r, gap__axis0=lambda a: a[:-1]), None),
    "a spacing of its own": (
        lambda r: edit_arrays(r, gap__axis0=lambda a: np.where(np.arange(len(a)) == 1, a + 0.01, a)),
        "stored function",
    ),
    "other values": (lambda r: edit_arrays(r, gap__g=lambda a: a * 0.9), "stored function"),
    "smaller constants": (lambda r: edit_arrays(r, gap__L=lambda a: a * 0.9), "stored function"),
    "no resolution": (lambda r: edit_arrays(r, gap__e=lambda a: a * 0), "contradict"),
    "another route": (lambda r: edit_json(r, route="theorem1"), "stored function"),
    "an envelope": (lambda r: edit_json(r, form={"form": "envelope", "predictor": "none"}), None),
    "a predictor with kinks": (
        lambda r: edit_json(r, predictor="multilinear", form={"form": "multilinear", "predictor": "multilinear"}),
        None,
    ),
    "a larger domain than the nodes": (lambda r: edit_json(r, domain__high=[2.0, 4.0]), "stored function"),
    "better tightness": (lambda r: edit_json(r, states__x0__tightness=1.0), "figures"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_forgeries_are_caught(runs, tmp_path, name):
    forge, caught_by = FORGERIES[name]
    shutil.copytree(runs / "family", tmp_path / "run")
    forge(tmp_path / "run")
    try:
        result = verify_run(tmp_path / "run")
    except gc.UsageError:
        assert caught_by is None
        return
    failed = [c["check"] for c in result["checks"] if not c["passed"]]
    assert failed
    assert caught_by is None or any(caught_by in check for check in failed), failed


def test_curvature_in_parts_puts_nodes_where_it_is_large(runs):
    nodes = np.load(runs / "slabs" / "certificate.npz")["gap.axis0"]
    assert {-0.1, 0.1} <= set(nodes)
    assert len(np.unique(np.round(np.diff(nodes), 9))) > 1


@pytest.mark.parametrize(
    "forge",
    [
        {"curvature__slabs0": lambda a: a * 0.5},
        {"curvature__slabs0": lambda a: a * 0.5, "gap__H0": lambda a: a * 0.5},
        {"curvature__slabs0": lambda a: a * 0.05, "gap__H0": lambda a: a * 0.05},
        {"curvature__cuts0": lambda a: np.where(np.abs(a) < 0.5, a + 0.3, a)},
        {"curvature__cuts0": lambda a: a * 0.5},
        {"curvature__cuts0": lambda a: a[::-1]},
    ],
)
def test_forged_parts_are_caught(runs, tmp_path, forge):
    shutil.copytree(runs / "slabs", tmp_path / "run")
    edit_arrays(tmp_path / "run", **forge)
    assert verify_run(tmp_path / "run")["verdict"] == "fails"


@pytest.mark.parametrize(
    "parts", [[[-1.0, 0.0, 1.0]], [[-1.0, 0.0, 1.0], [0.1, 1.0, 1.0]], [[-1.0, 0.5, 1.0], [0.2, 1.0, 1.0]]]
)
def test_parts_that_leave_a_gap_are_refused(tmp_path, parts):
    with pytest.raises(gc.UsageError, match="do not tile x0"):
        certified(tmp_path / "run", **LATTICE, lipschitz=in_parts(x0=parts))


@pytest.mark.parametrize("base", ["predictor", "supremum"])
def test_a_forged_predictor_is_caught(runs, tmp_path, base):
    shutil.copytree(runs / base, tmp_path / "run")
    edit_arrays(tmp_path / "run", predictor__values=lambda a: a * 3.0)
    assert verify_run(tmp_path / "run")["verdict"] == "fails"


def test_the_certificate_says_what_it_rests_on(tmp_path):
    c = certified(tmp_path / "run", **LATTICE, predictor="none", lipschitz=bounds())
    assert any("second derivative" in s and "declared" in s for s in c.assumptions)
    assert 1.0 <= c.states["x0"].tightness < c.states["x0"].envelope_mean / c.states["x0"].gap_mean
    assert len(c.samples) <= 200
    assert [a[0] for a in c.samples.lattice] == [-1.0, -2.0]
    assert any("curvature" in s for s in verify_run(tmp_path / "run")["trusted"])


def test_what_does_not_fit_together_is_one_sentence(tmp_path):
    model = Drift(1)
    backend, domain = Perturbed(model, ripple), gc.Domain.of(model, {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)})
    family = gc.registry().build("gap_family", "multilinear")
    plain = gc.registry().get("lipschitz", "declared").load()(values=VALUES)

    def ask(match, where=domain, **options):
        with pytest.raises(gc.UsageError, match=match):
            gc.certify(model, backend, where, **{"family": family, "folder": tmp_path / match[:9], **options})

    ask("needs nodes of a lattice", sampling=gc.AdaptiveSampling(50))
    ask("bounds of curvature, and declared gives none", lipschitz=plain)
    ask("has kinks at its nodes", lipschitz=bounds(), predictor=MultilinearPredictor(*flat()))
    cut = gc.Domain.of(model, {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}, ["x0 + u0 <= 1"])
    ask("a lattice needs a box", where=cut, lipschitz=bounds())
    with pytest.raises(gc.UsageError, match="either counts or a budget"):
        gc.LatticeSampling()


def flat():
    return (np.array([-1.0, 1.0]), np.array([-2.0, 2.0])), np.zeros((2, 2, 1))


def declared(constants, curvature):
    return gc.plugin.LipschitzBound(constants, 0 * constants, "declared", "declared", curvature=curvature)


def test_counts_follow_the_curvature(tmp_path):
    """Many nodes where it is large, two where the remainder is straight, one where it does not change."""
    field = gc.Box((gc.StateSpec("a"), gc.StateSpec("b"), gc.StateSpec("c")), (0.0,) * 3, (1.0,) * 3)
    domain = gc.Domain(field, gc.Box((gc.StateSpec("u"),), (0.0,), (1.0,)))
    plan = gc.LatticeSampling(budget=400)
    z = plan.first(domain).z
    constants, curvature = np.array([[4.0, 1.0, 0.0, 1.0]]), np.array([[16.0, 1.0, 0.0, 0.0]])
    nodes = plan.further(domain, z, np.ones((len(z), 1)), constants, declared(constants, curvature))
    counts = [len(np.unique(column)) for column in nodes.T]
    assert counts[2:] == [1, 2]
    assert counts[0] > 3 * counts[1] > 3
    assert 300 < len(nodes) + len(z) <= 400
    assert plan.further(domain, z, np.ones((len(z), 1)), 0 * constants, declared(0 * constants, 0 * curvature)).shape == (1, 4)


def missed(nodes, cuts, parts):
    """∫ of H h² / 12 over an axis with these nodes."""
    h = np.diff(nodes)
    return (
        float(gc.plugin.LipschitzBound(*[np.ones((1, 1))] * 2, "declared", "", slabs=((cuts, parts),)).bend(0, nodes)[0] @ h**3)
        / 12
    )


def test_slabs_are_charged_for_the_nodes_that_are_placed():
    cuts, parts = np.array([0.0, 0.5, 0.6, 0.7, 1.0]), np.array([[1.0, 40.0, 2.0, 0.0]])
    costs = designs._costs(np.ones(1)[0], np.array([1e9]), (cuts, parts), np.ones((1, 1)), 60)
    domain = gc.Domain(gc.Box((gc.StateSpec("a"),), (0.0,), (1.0,)), gc.Box((), (), ()))
    for n in range(2, 60):
        nodes = designs._nodes(domain, [n], [(cuts, parts)], np.ones((1, 1)))[:, 0]
        assert len(nodes) == n
        charged = missed(nodes, cuts, parts)
        assert costs[n - 1] == pytest.approx(charged) if n >= len(cuts) else costs[n - 1] >= charged


def test_slabs_without_curvature_rest_on_the_constants():
    """A lattice is found all the same, with some of its nodes in the slab that has no curvature."""
    cuts, parts = np.array([0.0, 0.4, 0.6, 1.0]), np.array([[1.0, np.inf, 1.0]])
    domain = gc.Domain(gc.Box((gc.StateSpec("a"),), (0.0,), (1.0,)), gc.Box((gc.StateSpec("u"),), (0.0,), (1.0,)))
    bound = gc.plugin.LipschitzBound(
        np.array([[2.0, 1.0]]),
        np.zeros((1, 2)),
        "interval",
        "",
        curvature=np.array([[np.inf, 1.0]]),
        slabs=((cuts, parts), None),
    )
    plan = gc.LatticeSampling(budget=300)
    z = plan.first(domain).z
    axes = [np.unique(c) for c in plan.further(domain, z, np.ones((len(z), 1)), bound.value, bound).T]
    assert 200 < len(axes[0]) * len(axes[1]) + len(z) <= 300
    inside = ((axes[0] >= 0.4) & (axes[0] <= 0.6)).mean()
    assert 0.3 < inside < 0.9


@pytest.mark.exam
def test_a_spec_asks_for_it(tmp_path):
    spec = written()
    done = gc.run(spec, out=tmp_path / "run")
    made = done.summary["certificate"]
    assert made["claim"]["kind"] == "statistical"
    assert made["audit"]["violations"] == 0
    assert made["states"]["x"]["tightness"] < 1.05
    assert made["samples"]["lipschitz"] <= 4000 + 800
    spec["lipschitz"]["residual"] |= {"curvature": False}
    other = {"sampling": {"kind": "adaptive", "budget": 120}, "gap": {"kind": "envelope", "predictor": "multilinear"}}
    done = gc.run({**spec, **other}, out=tmp_path / "other")
    stored = next((tmp_path / "other").rglob("certificate.json"))
    assert done.summary["certificate"]["audit"]["violations"] == 0
    assert json.loads(stored.read_text())["predictor"] == "multilinear"


@pytest.mark.parametrize(
    ("sampling", "said"),
    [
        ({"kind": "lattice"}, "expected either `counts: {axis: nodes}` or `budget: transitions`"),
        ({"kind": "lattice", "counts": {"x": 5}}, "u"),
        ({"kind": "latice", "budget": 5}, "lattice"),
    ],
)
def test_a_broken_lattice_is_a_spec_error(sampling, said):
    with pytest.raises(gc.SpecError, match=re.escape(said)):
        gc.load_spec({**written(), "sampling": sampling})


def test_a_spec_asks_for_proved_curvature(tmp_path):
    """Of 0.1 sin(2x) + 0.05 u²: 0.4 and 0.1, deterministic, and known to `verify`."""
    spec = written()
    spec["lipschitz"]["residual"] = {"kind": "interval", "curvature": True, "slabs": 4}
    spec["certificate"] |= {"claim": "deterministic"}
    done = gc.run(spec, out=tmp_path / "run")
    made = done.summary["certificate"]
    assert made["claim"]["kind"] == "deterministic"
    assert made["states"]["x"]["tightness"] < 1.05
    arrays = np.load(done.folder / "certificate.npz")
    assert np.allclose(arrays["curvature"], [[0.4, 0.1]], rtol=0.02)
    assert (arrays["curvature"] >= np.array([[0.4, 0.1]]) * (1 - 1e-12)).all()
    assert len(arrays["curvature.cuts0"]) == 5
    assert verify_run(done.folder)["verdict"] == "holds"


def written():
    return {
        "version": 1,
        "name": "bent",
        "model": {"kind": "equations", "states": {"x": "1"}, "inputs": {"u": "1"}, "next": {"x": "x + u"}, "period": "1 s"},
        "backend": {
            "kind": "equations",
            "states": {"x": "1"},
            "inputs": {"u": "1"},
            "next": {"x": "x + u + 0.1*sin(2*x) + 0.05*u**2"},
            "period": "1 s",
        },
        "domain": {"x": [-1, 1], "u": [-1, 1]},
        "sampling": {"kind": "lattice", "budget": 120},
        "lipschitz": {"residual": {"kind": "gradient-elite", "curvature": True, "budget": 4000}},
        "gap": {"kind": "multilinear"},
        "certificate": {"claim": "statistical", "violation": 1e-2, "confidence": 0.999},
    }
