"""Attacks on the book of audits: another spelling for fresh β, a fit that knows its points, a book that is lost or edited."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forging import edit_json, failed
from spellings import another, asked, drawn, respelled

import gapcert as gc
from gapcert.certification.certificate import gap_digest
from gapcert.certification.fingerprint import Fingerprint
from gapcert.certification.ledger import Entry, Kind, Ledger, _seal
from gapcert.certification.routes import Request
from gapcert.certification.samples.executors import threads
from gapcert.contracts.gaps.claim import audit_size
from gapcert.numerics.order_statistics import drawing, missed
from gapcert.testing.toys import Drift, Opaque, Perturbed, ripple, ripple_lipschitz
from gapcert_verify.verify import verify_run


def kept(question: Fingerprint) -> dict[str, Any]:
    """As the book hands it back."""
    return json.loads(json.dumps({k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in question.known.items()}))


def held(question: Fingerprint, other: Fingerprint) -> float:
    """By how many times 4 e two questions of the same axes differ at the points of the first; a twin of what the book does."""
    z, nx = question.known["z"], question.domain.nx
    axes = [a.name for a in question.domain.axes]
    whole = np.tile(question.domain.centre, (len(z), 1))
    counting = [k for k, name in enumerate(axes) if name in counted(question)]
    whole[:, counting] = z
    x, u = (np.ascontiguousarray(part) for part in (whole[:, :nx], whole[:, nx:]))
    pairs = ((question.model, other.model), (question.backend, other.backend))
    d = np.max([np.abs(a.step(x, u).x - b.step(x, u).x).max(axis=0) for a, b in pairs], axis=0)
    states = [k for k in counting if k < nx]
    return float((d[states] / (4 * question.known["e"][0])).max(initial=0.0))


def counted(question: Fingerprint) -> list[str]:
    return [question.domain.axes[k].name for k in question._axes]


def attacked(seed: int, questions: int, spellings: int) -> tuple[int, int]:
    """(meaningless edits, edits that mean something) that were tried."""
    rng, same, apart = np.random.default_rng(seed), 0, 0
    for _ in range(questions):
        spec = drawn(rng)
        first = asked(spec)
        old = kept(first)
        for _ in range(spellings):
            other, edits = respelled(spec, rng, int(rng.integers(1, 4)))
            assert asked(other).same(old), (edits, spec, other)
            same += 1
        for _ in range(spellings):
            found = asked(another(spec, rng))
            (low, high), ends = first.known["ends"], found._all["ends"][:, first._axes]  # what relations leave of ranges
            moved = (np.abs(ends - first.known["ends"]) > 1e-8 * (high - low)).any()
            if moved or held(first, found) > 2:
                assert not found.same(old), (spec, found.backend.to_spec(), found.model.to_spec())
                apart += 1
    return same, apart


def test_a_question_is_the_same_whatever_its_spelling() -> None:
    same, apart = attacked(1, 6, 3)
    assert same == 18
    assert apart > 5


@pytest.mark.exam
@pytest.mark.parametrize("seed", range(2, 8))
def test_many_questions_are(seed: int) -> None:
    same, apart = attacked(seed, 20, 5)
    assert same == 100
    assert apart > 60


# --- other Systems: units, noise, relations that only say again what ranges say


class Plant(gc.Backend):
    """v⁺ = 0.9 v + 0.1 a + size · v · a in metres per second, seen in other units; a may be noisy, or have another order."""

    def __init__(self, size: float, per: float = 1.0, unit: str = "m/s", noise: float = 0.0, turned: bool = False) -> None:
        order = (1, 0) if turned else (0, 1)
        self.states = tuple((gc.StateSpec(f"v{unit[0]}", unit), gc.StateSpec("w", "m/s"))[k] for k in order)
        self.inputs, self.period, self.capabilities = (gc.StateSpec("a", "m/s"),), 0.1, frozenset(("seed",) if noise else ())
        self.size, self.per, self.noise, self.order = size, per, noise, order

    def _step(self, x, u, **options):
        v, w = x[:, self.order[0]] / self.per, x[:, self.order[1]]
        out = [(0.9 * v + 0.1 * u[:, 0] + self.size * v * u[:, 0]) * self.per, 0.8 * w + 0.02 * v * v]
        out = np.stack([out[k] for k in self.order], axis=1)
        rng = np.random.default_rng(options.get("seed"))
        scale = np.array([(self.per, 1.0)[k] for k in self.order])
        return out + self.noise * scale * rng.standard_normal(out.shape) if self.noise else out


def plant(size: float, per: float = 1.0, unit: str = "m/s", noise: float = 0.0, turned: bool = False) -> Fingerprint:
    backend = Plant(size, per, unit, noise, turned)
    model = Opaque(Plant(0.0, per, unit, 0.0, turned))
    ranges = {f"v{unit[0]}": (-2.0 * per, 1.0 * per), "w": (-2.0, 1.0), "a": (-1.0, 1.0)}
    return Fingerprint(model, backend, gc.Domain.of(backend, ranges))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_units_and_order_of_other_systems_do_not_count(noise: float) -> None:
    old = kept(plant(0.05, noise=noise))
    for other in ({"per": 1000.0, "unit": "mm/s"}, {"per": 3.6, "unit": "km/hour"}, {"turned": True}):
        assert plant(0.05, noise=noise, **other).same(old), other
    assert not plant(0.3, noise=noise).same(old)
    assert not plant(0.05, noise=noise + 0.02).same(old)


def test_a_relation_that_cuts_what_the_range_does_not_have_is_no_other_domain() -> None:
    question = plant(0.05)
    wide = gc.Domain.of(question.backend, {"vm": (-2.0, 7.0), "w": (-2.0, 1.0), "a": (-1.0, 1.0)}, ["vm <= 1 m/s"])
    assert Fingerprint(question.model, question.backend, wide).same(kept(question))
    less = gc.Domain.of(question.backend, {"vm": (-2.0, 1.0), "w": (-2.0, 1.0), "a": (-1.0, 1.0)}, ["vm + w <= 1 m/s"])
    assert not Fingerprint(question.model, question.backend, less).same(kept(question))


def test_more_orders_than_can_be_tried_are_the_same_question() -> None:
    """Five states and inputs of one range, all alike on the diagonal."""
    n = 5
    model = Drift(n)
    domain = gc.Domain.of(model, {a.name: (-1.0, 1.0) for a in (*model.states, *model.inputs)})
    weights = np.random.default_rng(5).permutation(np.linspace(0.01, 0.02, n))
    one, other = (Fingerprint(model, Perturbed(model, Weighed(w)), domain) for w in (weights, weights[::-1]))
    assert other.same(kept(one))


@dataclass(frozen=True)
class Weighed:
    weights: Any

    def __call__(self, z: np.ndarray) -> np.ndarray:
        n = z.shape[1] // 2
        return np.repeat(z[:, n:] @ self.weights[:, None], n, axis=1) * 1e-3


# --- trying again until it passes

EPSILON, BETA, TRIES, FISHERS = 0.2, 0.3, 5, 120


def line(period: float = 0.1, name: str = "x0") -> Fingerprint:
    model = Drift(1, period)
    return Fingerprint(model, Perturbed(model, ripple), gc.Domain.of(model, {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}), named=name)


def passes(asked: Fingerprint, entry: Entry, seed: int, beta: float) -> bool:
    """Does an audit at β find none of the share ε where the band is wrong?"""
    z = asked.domain.draw(audit_size(EPSILON, beta), entry.draws(seed, "audit"))
    return not (z[:, 0] > 1 - 2 * EPSILON).any()


def test_trying_again_under_other_spellings_passes_no_more_often_than_beta(tmp_path: Path) -> None:
    """A false band, and fishers who edit spec and family until it passes: most of them, were every edit a new question."""
    spellings = [line(name=f"spelling {k}") for k in range(TRIES)]
    lucky = naive = 0
    for fisher in range(FISHERS):
        entries = [Ledger(tmp_path / f"{fisher}.json").enter(s, "audit", f"{fisher}") for s in spellings[:1]]
        entries += [Ledger(tmp_path / f"{fisher}.json").enter(s, "audit", f"{fisher} {k}") for k, s in enumerate(spellings[1:])]
        assert [e.k for e in entries] == list(range(1, TRIES + 1))
        assert {e.question for e in entries} == {"spelling 0"}
        lucky += any(passes(s, e, fisher, BETA / 2**e.k) for s, e in zip(spellings, entries, strict=True))
        naive += any(passes(s, e, fisher, BETA) for s, e in zip(spellings, entries, strict=True))
    assert 1 - missed(lucky - 1, FISHERS, BETA) > 1e-6  # no more than β explains
    assert 1 - missed(naive - 1, FISHERS, BETA) < 1e-6


def test_a_fit_that_foresees_points_is_audited_at_others(tmp_path: Path) -> None:
    """It knows question, number and seed, and leaves out of its band what it was about to be asked."""
    asked, caught = line(), 0
    for seed in range(40):
        first = drawing(seed, 1, "audit", asked.digest, hashlib.sha256(b"band").hexdigest())
        foreseen = asked.domain.draw(audit_size(EPSILON, BETA / 2), first)
        entry = Ledger(tmp_path / f"{seed}.json").enter(asked, "audit", f"band but at {foreseen.tolist()}")
        z = asked.domain.draw(len(foreseen), entry.draws(seed, "audit"))
        assert not np.isin(z, foreseen).any()
        caught += bool((z[:, 0] > 1 - 2 * EPSILON).any())
    assert caught > 25  # all but a share β / 2 of 40, on average


# --- the book itself


def numbers(folder: Path, asked: Fingerprint, *audited: str, kind: Kind = "audit") -> list[int]:
    return [Ledger(folder / "ledger.json").enter(asked, kind, text).k for text in audited]


def test_two_runs_at_once_lose_no_entry(tmp_path: Path) -> None:
    asked = line()
    asked.known  # noqa: B018 - as a run has it, once
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda k: numbers(tmp_path, asked, str(k))[0], range(40)))
    assert sorted(found) == list(range(1, 41))
    assert numbers(tmp_path, line(name="again"), "0", "new") == [found[0], 41]


def test_kinds_are_counted_apart(tmp_path: Path) -> None:
    asked = line()
    assert numbers(tmp_path, asked, "a", "b") == [1, 2]
    for kind in ("calibration", "closed loop", "hidden state"):
        assert numbers(tmp_path, asked, "a", "c", kind=kind) == [1, 2]


def test_an_older_book_counts_for_every_spelling_that_it_names(tmp_path: Path) -> None:
    one, other = line(), line(name="other")
    old = {one.digest: ["a", "calibrate:b", "c"], other.digest: ["d"], "unknown": ["e"]}
    (tmp_path / "ledger.json").write_text(json.dumps(old))
    again = Ledger(tmp_path / "ledger.json").enter(one, "audit", "c")
    assert (again.k, again.question) == (3, "")  # the same audit, by the rule of then
    assert np.array_equal(again.draws(5, "audit").random(3), np.random.default_rng([5, 3]).random(3))
    assert json.loads((tmp_path / "ledger.json").read_text()) == old
    assert numbers(tmp_path, one, "new") == [3]
    assert numbers(tmp_path, one, "new", kind="calibration") == [2]
    assert numbers(tmp_path, other, "newer", "newest") == [4, 5]
    assert numbers(tmp_path, line(0.2, "longer"), "e") == [1]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A folder with three runs of one question."""
    for seed in range(3):
        certified(tmp_path, seed)
    return tmp_path


def certified(folder: Path, seed: int, backend: gc.System | None = None) -> gc.Certificate:
    model = Drift(1)
    c = gc.certify(
        model,
        backend or Perturbed(model, ripple),
        gc.Domain.of(model, {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}),
        lipschitz=Constants(),
        sampling=gc.GridSampling((5, 5)),
        request=Request("statistical", 0.05, 0.01),
        seed=seed,
        folder=folder / f"run{seed}",
        executor=threads,
    )
    c.save(folder / f"run{seed}")
    return c


class Constants(gc.plugin.LipschitzEstimator):
    def bound(self, problem: Any) -> gc.plugin.LipschitzBound:
        value = 2 * ripple_lipschitz(1, 2.0) + np.abs(getattr(problem.predictor, "slope", 0.0))
        return gc.plugin.LipschitzBound(value, 0 * value, "declared", "twice", 2.0)


def said(c: gc.Certificate) -> str:
    assert c.summary().get("warnings", []) == [w.removeprefix("Warning: ")[:-1] for w in c.assumptions if "book" in w]
    return " ".join(c.summary().get("warnings", []))


def test_a_whole_book_is_no_news(run: Path) -> None:
    assert (certified(run, 3).audit.k, said(certified(run, 3)), said(certified(run, 0))) == (4, "", "")


def test_a_lost_book_is_told_and_run_folders_count_on(run: Path) -> None:
    (run / "ledger.json").unlink()
    c = certified(run, 3)
    assert c.audit.k == 4
    assert "lacks 3 that run folders beside it tell of" in said(c)
    assert "lacks 3" in said(certified(run, 3))  # for as long as it is lost
    assert certified(run, 1).audit.k == 2  # the same audit


def test_a_book_that_ends_too_soon_is_told_however_well_it_is_sealed(run: Path) -> None:
    book = json.loads((run / "ledger.json").read_text())
    book["lines"].pop()
    book["seal"] = _seal(book)
    (run / "ledger.json").write_text(json.dumps(book))
    c = certified(run, 3)
    assert (c.audit.k, c.audit.entry.edited, c.audit.entry.lost) == (4, False, 1)
    assert "lacks 1 that" in said(c)


@pytest.mark.parametrize(
    "edit", [lambda b: b["lines"].pop(0), lambda b: b["questions"][0]["e"].clear(), lambda b: b["lines"].clear()]
)
def test_an_edited_book_is_told_for_ever(run: Path, edit: Callable[[Any], Any]) -> None:
    shutil.rmtree(run / "run0")
    book = json.loads((run / "ledger.json").read_text())
    edit(book)
    (run / "ledger.json").write_text(json.dumps(book))
    assert "was edited" in said(certified(run, 3))
    assert "was edited" in said(certified(run, 4))


def test_another_question_is_not_counted_with_what_the_book_lacks(run: Path) -> None:
    model = Drift(1)
    assert certified(run, 5, Perturbed(model, half)).audit.k == 1
    (run / "ledger.json").unlink()
    assert (
        certified(run, 6, Perturbed(model, half)).audit.k == 4
    )  # whose the three were nobody can tell; its own is one of them


def half(z: np.ndarray) -> np.ndarray:
    return 0.5 * ripple(z)


def test_forged_entries_do_not_draw_the_points(run: Path) -> None:
    data = json.loads((run / "run0" / "certificate.json").read_text())
    assert verify_run(run / "run0")["verdict"] == "holds"
    audit = data["audit"]
    for forged in (
        {**audit, "book": {**audit["book"], "question": "another"}},
        {**audit, "book": {**audit["book"], "audited": "0" * 64}},
        {**audit, "book": {**audit["book"], "kind": "calibration"}},
        {k: v for k, v in audit.items() if k != "book"},
    ):
        edit_json(run / "run0", audit=forged)
        assert "the audit's points are those that its seed draws" in failed(run / "run0"), forged


def test_what_was_drawn_by_the_older_rule_is_verified_by_it_and_told(tmp_path: Path) -> None:
    asked = Perturbed(Drift(1), ripple)
    first = certified(tmp_path, 0)
    text = f"{gap_digest(first.gap, first.problem)}:{first.audit.entry.question}:0.05:0.01"
    assert hashlib.sha256(text.encode()).hexdigest() == first.audit.entry.audited
    shutil.rmtree(tmp_path / "run0")
    (tmp_path / "ledger.json").write_text(json.dumps({first.audit.entry.question: [text]}))
    c = certified(tmp_path, 0, asked)
    assert (c.audit.k, "book" in c.summary()["audit"]) == (1, False)
    assert "is of a book before format 2" in " ".join(c.summary()["warnings"])
    told = verify_run(tmp_path / "run0")
    assert told["verdict"] == "holds", [c for c in told["checks"] if not c["passed"]]
    assert any("by the rule before the book's format 2" in t for t in told["trusted"])
    assert not np.array_equal(c.audit.z, first.audit.z)
