"""Drawn claims of every kind hold against whoever tries to break them; and what is broken is seen."""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest
import redteam
from attacks import KINDS, adversary, certificates, formulas, games, networks

import gapcert as gc
from gapcert.contracts.gaps.lipschitz import Residual

SEED = 11
FEW = {"networks": (4, 3000), "formulas": (60, 20)}
MORE = {"certificates": 16, "games": 12, "mpc": 4, "networks": 40, "formulas": 1000, "calibrations": 4, "forgeries": 3}


def broken(kind: str, first: int, claims: int, tries: int | None) -> list[dict]:
    rows = [redteam.asked(kind, SEED, k, tries) for k in range(first, first + claims)]
    assert any(r["tries"] for r in rows), "something was attacked"
    return [r for r in rows if r["claim"] == "error" or (r["claim"] == "deterministic" and r["broken"])]


@pytest.mark.run
@pytest.mark.parametrize("kind", FEW)
def test_no_claim_breaks(kind):
    claims, tries = FEW[kind]
    assert not broken(kind, 0, claims, tries)


@pytest.mark.exam
@pytest.mark.parametrize("kind", MORE)
def test_none_of_many_claims_breaks(kind):
    assert not broken(kind, 100, MORE[kind], None)


def test_every_kind_has_an_attack():
    assert all(hasattr(importlib.import_module(f"attacks.{kind}"), "attempt") for kind in KINDS)


def made(draw, rng, folder):
    """The first drawn spec that gives a claim."""
    for k in range(40):
        try:
            run = gc.run(
                draw(rng), overrides=("report.html=false", "report.rerun=false"), out=folder / str(k), executor="threads"
            )
        except gc.GapcertError:
            continue
        if run.summary["verdict"] == "holds":
            return run
    raise AssertionError("nothing that is drawn holds")


class Narrow(gc.GapFunction):
    """A share of another band."""

    family = "narrow"

    def __init__(self, gap, share):
        self.gap, self.share = gap, share

    def interval(self, z):
        low, high = self.gap.interval(z)
        return low * self.share, high * self.share

    def interval_over(self, boxes):
        return self.gap.interval_over(boxes) * self.share

    def arrays(self):
        return {}

    @property
    def form(self):
        return {}

    def lipschitz(self, boxes):
        return self.gap.lipschitz(boxes)


@pytest.mark.run
def test_a_band_that_is_too_narrow_is_found(tmp_path):
    rng = np.random.default_rng(1)
    run = made(certificates.drawn, rng, tmp_path)
    certificate, residual = run.certificate, Residual(run.artifacts["backend"], run.artifacts["model"])
    z = certificates.aimed(certificate, 2000, rng)
    z = np.concatenate([z, certificates.climbed(certificate, residual, z, rng)])
    assert not certificates.broken(certificate, residual, z).any()
    share = np.max(np.abs(residual(z)) / certificate.gap.gamma(z)) / 2
    narrow = dataclasses.replace(certificate, gap=Narrow(certificate.gap, share))
    assert certificates.broken(narrow, residual, z).any()


@pytest.mark.run
def test_a_gap_that_a_controller_was_not_told_of_is_found(tmp_path):
    rng = np.random.default_rng(2)
    for k in range(20):
        run = made(games.drawn, rng, tmp_path / str(k))
        gap = run.certificate.gap
        if not gap.gamma(run.artifacts["domain"].draw(1, rng)).all():
            continue
        steps, wrong, _ = adversary.fought(run.artifacts["model"], gap, run.controller, 2000, 50, rng, 20)
        assert steps
        assert not wrong
        if adversary.fought(run.artifacts["model"], Narrow(gap, 30.0), run.controller, 2000, 50, rng, 20)[1]:
            return
    raise AssertionError("a gap of thirty times the size broke nothing")


def test_a_slope_above_its_constant_is_found(monkeypatch, tmp_path):
    monkeypatch.setattr(
        networks.LipSDP, "bound", lambda self, net, units: dataclasses.make_dataclass("B", [("value", float, 1e-3)])()
    )
    assert any(networks.attempt(np.random.default_rng(k), tmp_path, 500).broken for k in range(3))


def test_an_automaton_of_another_formula_is_found(monkeypatch, tmp_path):
    real = formulas.automaton_of
    monkeypatch.setattr(formulas, "automaton_of", lambda text: real(text.replace("U", "W").replace("F", "X")))
    assert any(formulas.attempt(np.random.default_rng(k), tmp_path).broken for k in range(30))


def test_words_of_known_truth():
    word = np.array([[1, 0, 0], [0, 1, 0], [1, 1, 0]], dtype=bool)  # a; then b and ab for ever
    says = {("U", "a", "b"): True, ("G", ("F", "a")): True, ("F", ("G", "a")): False, ("R", "a", "b"): False, ("X", "b"): True}
    assert {f: bool(formulas.truth(f, word, 1)[0]) for f in says} == says


@pytest.mark.contract
def test_what_is_kept_is_not_asked_again(tmp_path, monkeypatch):
    rows = tmp_path / "rows.jsonl"
    redteam.attack([("formulas", 1, k) for k in range(3)], 5, 1, rows)
    before = rows.read_text()
    redteam.attack([("formulas", 1, k) for k in range(3)], 5, 1, rows)
    assert rows.read_text() == before
    assert "| formulas | 3 | 15 |" in redteam.table(rows)
    monkeypatch.setattr(redteam, "commit", lambda: "another")
    redteam.attack([("formulas", 1, 0)], 5, 1, rows)
    assert len(rows.read_text().splitlines()) == 4


def test_a_share_above_its_level_is_told():
    row = {"kind": "calibrations", "claim": "statistical", "tries": 1000, "broken": 0, "level": 0.01, "doubt": 0.1}
    rows = [{**row, "drawn": [1000, wrong]} for wrong in (0, 10, 40)]
    assert [redteam.above(r) for r in rows] == [False, False, True]
    assert redteam.line("calibrations", rows)[4] == "1 of 3 (may be 2)"
