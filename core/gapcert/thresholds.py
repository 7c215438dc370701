"""A threshold is a number with its reason: fields of the frozen table of a room are made here, and their reasons read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, TypeVar, final

T = TypeVar("T")


def threshold(value: T, reason: str) -> T:
    """A field of a dataclass, whose reason says where its value is from: *measured*, *by the formula*, *as* others set it."""
    return field(default=value, metadata={"reason": reason})


def chosen(value: T, reason: str) -> T:
    """A `threshold` that was chosen, not measured: the reason says what it is, or what it trades off."""
    return threshold(value, f"{reason}; chosen, not measured")


def decides(value: T, reason: str) -> T:
    """A `threshold` that was chosen, and matters: halved or doubled it changes an answer of the battery."""
    return threshold(value, f"{reason}; decides: halved or doubled, it changes an answer of the battery")


def reasons(table: Any) -> Mapping[str, str]:
    """Name → reason of all fields of a table of thresholds; KeyError where one has none."""
    return {f.name: f.metadata["reason"] for f in fields(table)}


@final
@dataclass(frozen=True)
class Thresholds:
    """Of this room: numbers that decide or bound what is tried, accepted or refused, read as `THRESHOLDS.name`."""

    zone_share: float = chosen(1e-3, "of the box: relations that leave less are refused, since points are drawn for ever")
    zone_steps: int = chosen(8, "per relation, to move a point into Z within its box")
    kept_folders: int = chosen(4, "of one package: those of other versions, or of other environments")
    majorant_cells: int = chosen(4096, "at most: more are tighter, and take longer")
    least_cut: int = chosen(16, "cells cut in a round")
    cut_share: int = chosen(3, "of all cells, one in so many is cut in a round")
    cut_tried: int = chosen(4, "cells of a round of which every axis is tried")
    majorant_gain: float = chosen(0.01, "of the mean, with four times as many cells: it ends where less was gained")
    surprise: float = chosen(1e-3, "an audit refutes ε where so many violations, or more, are at most this probable under it")


THRESHOLDS = Thresholds()
