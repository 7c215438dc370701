"""Units in the heads of columns count, unless the spec says otherwise; what is in brackets beside is left alone."""

import numpy as np
import pytest

from gapcert import Recording, UsageError
from gapcert.contracts.data.units import stated_units, without_units


@pytest.mark.parametrize(
    ("column", "unit"),
    [
        ("theta [deg]", "deg"), ("theta[deg]", "deg"), ("theta (deg)", "deg"), ("a [m/s^2]", "m/s^2"), ("u [ N*m ]", "N*m"),
        ("t (ms)", "ms"), ("theta [°]", "°"), ("valve [%]", "%"),
        ("q[0]", None), ("joint (1)", None), ("u [raw]", None), ("u [-]", None), ("T [degC]", None), ("theta", None),
        ("[deg]", None), ("t (UTC)", None), ("q[1:]", None),
    ],
)  # fmt: skip
def test_what_is_a_unit(column, unit):
    assert stated_units([column]) == ({} if unit is None else {column: unit})


def test_names_without_their_units():
    assert without_units(["q [deg]", "u (V)", "a[0]"]) == {"q": "q [deg]", "u": "u (V)"} | {
        n: n for n in ("q [deg]", "u (V)", "a[0]")
    }
    assert without_units(["q [deg]", "q"])["q"] == "q"


def table(scale=1e3):
    t = 0.01 * np.arange(40)
    return {"t [ms]": scale * t, "theta [deg]": 180 * t, "u [raw]": t}


COLUMNS = {"theta": "theta [deg]", "u": "u [raw]"}


def test_they_count():
    found = Recording.from_columns([("log", table())], time="t [ms]", columns=COLUMNS)
    assert found.period == pytest.approx(0.01)
    assert found.units == {"theta": "deg"}
    in_rad = found.converted({"theta": "rad", "u": "N*m"}).trajectories[0].channels
    np.testing.assert_allclose(in_rad["theta"], np.pi * 0.01 * np.arange(40))
    with pytest.raises(UsageError, match=r"recording: 'theta': unit 'deg' does not fit; expected m"):
        found.converted({"theta": "m"})


def test_the_spec_overrules_them():
    units = {"t [ms]": "s", "theta [deg]": "rad"}
    found = Recording.from_columns([("log", table(1.0))], time="t [ms]", columns=COLUMNS, units=units)
    assert found.period == pytest.approx(0.01)
    assert found.units == {"theta": "rad"}
