"""Thresholds stand in one frozen table per room, each with its reason."""

import importlib
from dataclasses import FrozenInstanceError, fields

import pytest
import rooms

from gapcert.plugin import reasons

TABLES = sorted(name for name in rooms.files() if name.endswith(".thresholds"))


@pytest.mark.parametrize("name", TABLES)
def test_every_threshold_is_frozen_and_has_a_reason(name):
    table = importlib.import_module(name).THRESHOLDS
    told = reasons(table)
    assert [n for n, reason in told.items() if len(reason.split()) < 3] == []
    assert all(isinstance(getattr(table, n), int | float | tuple) for n in told)
    with pytest.raises(FrozenInstanceError):
        setattr(table, fields(table)[0].name, 0)


def test_rooms_have_tables():
    assert len(TABLES) > 15
    assert "gapcert_diagnosis.thresholds" in TABLES
