"""Company: every kind of engine that answers by more than its arguments is caught, and a clean twin of it passes."""

from __future__ import annotations

import functools
from concurrent.futures import ThreadPoolExecutor

import impure
import numpy as np
import pytest
from impure import CONSTANTS, FORGETFUL, KINDS, Circumstantial, Forgetful, domain, nominal, violated

import gapcert as gc
import gapcert.certification.certify as steps
from gapcert.certification.gates import again as room
from gapcert.certification.gates import entry
from gapcert.certification.gates.again import in_calls
from gapcert.certification.gates.hidden_distribution import Around, visited
from gapcert.certification.gates.purity import Queries, laddered, purity
from gapcert.certification.samples import store
from gapcert.certification.samples.executors import processes, threads
from gapcert.contracts.gaps.lipschitz import Residual
from gapcert.testing import SystemContract
from gapcert_bounds.constants.declared_constants import Declared
from gapcert_verify.verify import verify_run

ONE = functools.partial(ThreadPoolExecutor, 1)
LATE = (  # the gates ask too few rows for these
    "large calls",
    "middling calls",
    "late rows",
    "after 40 calls",
    "after 150 calls",
    "after 700 rows",
    "cache of rounded rows",
    "sum of inputs",
    "small calls in a slit of 1 %",
    "small calls in a slit of 0.5 %",
    "large calls in a slit of 0.5 %",
)


def certified(engine, folder, claim="deterministic", seed=0):
    more = {"sampling": gc.GridSampling((9, 10, 8)), "lipschitz": Declared(CONSTANTS), "predictor": "none"}
    options = more if claim == "deterministic" else {}
    request = gc.Request(claim, epsilon=1e-3)
    return steps.certify(nominal(), engine, domain(), request=request, seed=seed, folder=folder / "c", executor=ONE, **options)


def refused_by_contract(kind, clean):
    contract = type("Contract", (SystemContract,), {"system": lambda self: Circumstantial(kind, clean=clean)})()
    for check in (
        "company_does_not_matter",
        "failures_leave_no_trace",
        "rollout_equals_steps",
        "batch_equals_singles",
        "pickles",
    ):
        try:
            getattr(contract, f"test_{check}")()
        except AssertionError:
            return True
    return False


@pytest.mark.parametrize("kind", sorted(set(KINDS) - set(LATE) - {"another process"}))
def test_gates_or_contract_catch_it_and_pass_its_clean_twin(kind):
    try:
        purity("backend", Circumstantial(kind), domain(), threads, 0)
    except gc.UsageError as error:
        assert "is not a function of (x, u)" in str(error)  # noqa: PT017
    else:
        assert refused_by_contract(kind, clean=False)
    assert purity("backend", Circumstantial(kind, clean=True), domain(), threads, 0).endswith("agreed bit for bit")
    assert not refused_by_contract(kind, clean=True)


def test_another_process_is_asked():
    with pytest.raises(gc.UsageError, match="in another worker"):
        purity("backend", Circumstantial("another process"), domain(), processes, 0)


@pytest.mark.parametrize("kind", LATE)
def test_what_gates_miss_is_refused_at_the_end_or_refuted_or_true(kind, tmp_path):
    purity("backend", Circumstantial(kind), domain(), threads, 0)
    try:
        c = certified(Circumstantial(kind), tmp_path)
    except gc.UsageError as error:
        assert "asked again" in str(error)  # noqa: PT017
    else:
        assert c.claim.kind == "empirical" or violated(c, lambda: Circumstantial(kind), 1200, 1)[0] == 0


def test_without_the_last_look_a_false_claim_passes(tmp_path, monkeypatch):
    """Right in calls of more than 900 rows, which is all that a measurement by grid and audit would see."""

    def bulk():
        return Circumstantial("bulk")

    monkeypatch.setattr(impure, "KINDS", {"bulk": lambda z, c: np.full(len(z), c.n < 160)})
    with pytest.raises(gc.UsageError, match=r"64 of 64 measured rows, asked again alone, differ by up to 0\.05, and rounding"):
        certified(bulk(), tmp_path / "seen")
    monkeypatch.setattr(steps, "again", lambda *_: "nothing was asked again")
    assert not certified(bulk(), tmp_path / "blind").holds  # the audit's small calls see it as well
    monkeypatch.setattr(store, "in_calls", lambda residual, z: residual(z))
    c = certified(bulk(), tmp_path / "blinder")
    assert c.claim.kind == "deterministic"
    assert violated(c, bulk, 600, 0)[0] > 500


def test_what_changes_between_gates_and_measurement_is_seen_at_the_end(tmp_path, monkeypatch):
    """All that is measured is alike, and other than what a new engine answers."""
    counted = Circumstantial("first row", clean=True)
    seen = []
    monkeypatch.setattr(Circumstantial, "_step", lambda self, x, u: seen.append(1) or self.law(np.hstack([x, u])))
    entry.answered(counted, domain(), 0)
    purity("backend", counted, domain(), ONE, 0)
    monkeypatch.undo()
    asked = sum(seen)
    monkeypatch.setattr(impure, "KINDS", {"aged": lambda z, c: np.full(len(z), c.calls >= asked)})
    with pytest.raises(gc.UsageError, match=r"the same 64 queries asked again at the end differ by up to 0\.05"):
        certified(Circumstantial("aged"), tmp_path)
    monkeypatch.setattr(steps, "unchanged", lambda *_: None)
    c = certified(Circumstantial("aged"), tmp_path / "blind")
    assert c.claim.kind == "deterministic"
    assert violated(c, lambda: Circumstantial("aged"), 20, 0)[0] > 0


def test_a_clean_engine_is_certified_and_the_claim_says_what_was_asked(tmp_path):
    c = certified(Circumstantial("large calls", clean=True), tmp_path)
    assert c.claim.kind == "deterministic"
    (said,) = [a for a in c.assumptions if "function of its arguments" in a]
    assert "128 measured rows, asked again alone, some after a close neighbour, and half of them in another order" in said
    assert "agreed bit for bit; this was probed" in said


class LastBits(gc.Backend):
    """Answers that differ in the last bits with the size of a call, as vectorised powers do."""

    def __init__(self, ulp):
        self.inner, self.ulp = Circumstantial("first row", clean=True, size=0.0), ulp
        self.states, self.inputs, self.period = self.inner.states, self.inner.inputs, 0.1

    def _step(self, x, u, **options):
        out = self.inner.law(np.hstack([x, u]))
        return out + self.ulp * np.spacing(np.abs(out)) * (len(x) % 2)


def test_last_bits_are_counted_in_e_and_said(tmp_path):
    c = certified(LastBits(2), tmp_path)
    assert c.claim.kind == "deterministic"
    (said,) = [a for a in c.assumptions if "function of its arguments" in a]
    assert said.count("within e, though not bit for bit (they differ by up to") == 2
    with pytest.raises(gc.UsageError, match="not a function"):
        certified(LastBits(40), tmp_path / "more")


class Counting(LastBits):
    """All calls but the first are a little off."""

    calls = 0

    def _step(self, x, u, **options):
        self.calls += 1
        out = self.inner.law(np.hstack([x, u]))
        return out + self.ulp * np.spacing(np.abs(out)) * (self.calls > 1)


def test_the_same_call_again_has_the_same_bits_though_e_allows_others(tmp_path):
    with pytest.raises(gc.UsageError, match=r"not a function of .* asked again"):
        certified(Counting(1), tmp_path)


def test_ladders_have_neighbours_at_every_scale():
    system, rng = Circumstantial("first row"), np.random.default_rng(0)
    rows = laddered(system, Queries(rng.uniform(-1, 1, (8, 2)), rng.uniform(-1, 1, (8, 1))))
    assert len(rows.x) == 8 + 3 * 14
    for k, (still, moved) in enumerate((("x", "u"), ("u", "x"), (None, "x"))):
        part = slice(8 + 14 * k, 22 + 14 * k)
        d = np.abs(np.diff(getattr(rows, moved)[part], axis=0)).max(axis=1)
        assert np.allclose(d[1:] / d[:-1], 1 / 3, rtol=1e-6)
        assert still is None or np.ptp(getattr(rows, still)[part], axis=0).max() == 0


def test_a_small_part_of_an_audit_is_asked_in_calls_of_all_sizes():
    seen = []

    class Seen(gc.Backend):
        def __init__(self):
            inner = Circumstantial("first row")
            self.states, self.inputs, self.period = inner.states, inner.inputs, 0.1

        def _step(self, x, u, **options):
            seen.append(len(x))
            return x + u

    z = domain().draw(14_502, np.random.default_rng(0))
    residual = Residual(Seen(), nominal())
    r = in_calls(residual, z)
    assert sum(seen) == len(z)
    assert set(range(1, 51)) <= set(seen)
    assert max(seen) > len(z) / 2
    assert len(seen) < 100
    assert r.tobytes() == residual(z).tobytes()
    for n in (1, 2, 5):
        assert in_calls(residual, z[:n]).shape == (n, 2)


def test_rows_asked_again_are_those_of_both_rounds():
    zone, pure = domain(), Residual(Circumstantial("first row", clean=True), nominal())
    z = zone.draw(1000, np.random.default_rng(0))
    r, e = pure(z), np.full(2, 1e-15)
    assert "agreed bit for bit" in room.again([(pure, z, r), (pure, z, r)], zone, e, 0)
    for wrong in (0, 1):
        parts = [(pure, z, r), (pure, z, r)]
        parts[wrong] = (pure, z, r + 1e-9)
        with pytest.raises(gc.UsageError, match="64 of 64 measured rows, asked again alone, differ by up to 1e-09"):
            room.again(parts, zone, e, 0)


# Hidden state that a probe found harmless


@pytest.mark.exam
@pytest.mark.parametrize("kind", FORGETFUL)
def test_forgetful_engines_get_no_false_claim(kind, tmp_path):
    for claim in ("deterministic", "statistical"):
        try:
            c = certified(Forgetful(kind), tmp_path / claim, claim)
        except gc.UsageError as error:
            assert "depends on hidden state" in str(error)  # noqa: PT017
        else:
            assert c.claim.kind == "empirical"
            assert c.audit.violations > 0


def test_a_harmless_hidden_state_is_drawn_and_named(tmp_path):
    c = certified(Forgetful("sum above 12", clean=True), tmp_path, "statistical")
    how = (
        ", hidden state in equal parts at its default, as rollouts of up to 256 steps leave it, and moved from its default as "
        "the probe does"
    )
    assert c.claim.kind == "statistical"
    assert c.claim.distribution == f"uniform on X × U{how}"
    assert c.summary()["hidden"]["harmless"]
    c.save(tmp_path / "c")
    assert verify_run(tmp_path / "c")["verdict"] == "holds"


def test_without_the_draw_a_false_claim_passes(tmp_path, monkeypatch):
    def forgetful():
        return Forgetful("sum above 12")

    monkeypatch.setattr(steps, "stricter", lambda store, gate, domain: store)
    c = certified(forgetful(), tmp_path)
    assert c.claim.kind == "deterministic"
    out, asked = violated(c, forgetful, 600, 0)
    assert out > 0.01 * asked


def test_long_rollouts_reach_what_adds_up():
    system = Forgetful("sum above 40")
    short = visited(system, domain(), 16, 12, 0)
    long = visited(system, domain(), 16, 256, 0, long=True)
    assert short.h.max() < 12 < 100 < long.h.max()
    law = Around(system, domain(), {}, 0)
    assert 0.33 < (law.pool == 0.0).mean() < 0.34
    assert (np.abs(law.pool[-len(law.pool) // 3 :]) <= 1).all()
    assert not law.outside(law.pool).any()
    assert law.outside(np.array([[-2.0]])).all()
    assert law.digest() != Around(system, domain(), {}, 1).digest()
    assert len(law.extremes(np.zeros((2, 2)), 16)) >= 16
