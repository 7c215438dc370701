"""A plugin that knows nothing of this repository keeps the shipped contract, wherever it is installed beside gapcert."""

import pytest

import gapcert
from gapcert.testing import SystemContract

gapcert_acme = pytest.importorskip("gapcert_acme", reason="not installed here; tests/test_packaging.py installs it")


class TestPuck(SystemContract):
    def system(self):
        return gapcert.registry().build("backend", "acme-puck")


def test_declared_by_its_own_distribution():
    assert gapcert.registry().get("backend", "acme-puck").distribution == "gapcert-acme 1.0"


def test_steps():
    assert gapcert_acme.Puck().step([[1.0]], [[2.0]]).x.tolist() == [[1.02]]
