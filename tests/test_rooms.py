"""Rooms and their order: what every module imports, whenever it does, against tests/rooms.toml."""

import pytest
import rooms


@pytest.fixture(scope="module")
def found():
    return rooms.imports(rooms.files())


@pytest.mark.unit
def test_every_module_is_in_a_room_of_the_order():
    modules = rooms.files()
    assert [m for m in modules if m not in rooms.FACADES and rooms.room(m) not in rooms.ORDER] == []
    assert [name for names in rooms.MAP["modules"].values() for name in names if name not in modules] == []
    assert len(modules) > 400


@pytest.mark.unit
def test_rooms_import_only_what_is_below_them(found):
    assert sorted({f"{i.source} -> {i.target}" for i in rooms.upward(found)}) == rooms.MAP["exceptions"]


@pytest.mark.unit
def test_packages_name_others_by_what_they_offer():
    assert rooms.inner(rooms.files()) == []


@pytest.mark.unit
def test_a_name_from_inside_another_package_is_caught(tmp_path):
    (tmp_path / "a.py").write_text(
        "from gapcert import Domain\nfrom gapcert.plugin import Zone\nfrom gapcert_cells import Splits\n"
        "def f():\n    from gapcert.spec.spec import load_spec\n    from gapcert_cells.successors import Splits\n"
    )
    assert rooms.inner({**rooms.files(), "gapcert_dask.a": tmp_path / "a.py"}) == [
        ("gapcert_dask.a", "gapcert.spec.spec"),
        ("gapcert_dask.a", "gapcert_cells.successors"),
    ]


@pytest.mark.unit
def test_verification_shares_no_code_with_fitting(found):
    """What proves: numbers, contracts, bounded functions, networks and the files of cells; no model, no fit, no registry.

    `run_folder` builds the spec once more, to say what was asked and to step both systems, and `verify` asks both.
    """
    modules, asking = rooms.files(), ("gapcert_verify.verify", "gapcert_verify.run_folder")
    seen = rooms.reached(found, [m for m in modules if m.startswith("gapcert_verify.") and not m.startswith(asking)])
    allowed = {"core.numerics", "core.contracts", "gapcert_cells", "gapcert_functions", "gapcert_networks", "gapcert_verify"}
    assert {m for m in seen if rooms.room(m) not in allowed} == set()
    assert "gapcert.contracts.plugins.registry" not in seen
    assert "gapcert.contracts.plugins.registry" in rooms.reached(
        [*found, rooms.Import("gapcert_verify.proofs", "gapcert.certification.certify", "later")], seen
    )


@pytest.mark.unit
def test_rooms_keep_to_their_budgets():
    used = dict.fromkeys(rooms.ORDER, 0)
    for module, path in rooms.files().items():
        if module not in rooms.FACADES:
            used[rooms.room(module)] += len(path.read_text().splitlines())
    assert {room: (n, rooms.MAP["lines"][room]) for room, n in used.items() if n > rooms.MAP["lines"][room]} == {}
    assert {what: n for what, n in rooms.totals().items() if n > rooms.MAP["totals"][what]} == {}


@pytest.mark.unit
def test_no_files_import_each_other_in_a_circle(found):
    assert rooms.knots({i[:2] for i in found if i.when == "now"}) == []


@pytest.mark.unit
def test_circles_of_types_and_late_imports_stay_inside_one_room_and_become_fewer(found):
    circles = rooms.knots({i[:2] for i in found})
    assert [c for c in circles if len({rooms.room(m) for m in c}) > 1] == []
    assert len(circles) == rooms.MAP["circles"]


@pytest.mark.unit
def test_no_rooms_import_each_other_in_a_circle_whenever_they_do(found):
    assert rooms.knots({i.rooms for i in found if i.rooms[0] != i.rooms[1]}) == []


@pytest.mark.unit
def test_folders_are_maps():
    counts = rooms.folders()
    assert {str(f): n for f, n in counts.items() if n > rooms.MAP["most_files"]} == {}
    assert len(counts) > 50


@pytest.mark.unit
def test_imports_are_seen_wherever_they_stand(tmp_path):
    """Planted: at the top, for types, in a function, under a condition, by a relative name, and through the facade."""
    (tmp_path / "a.py").write_text(
        "from typing import TYPE_CHECKING\n"
        "from gapcert import Domain\n"
        "if TYPE_CHECKING:\n    import gapcert.cli.main\n"
        "class A:\n    def f(self):\n        with open('x'):\n            from gapcert.report import html, page as p\n"
        "try:\n    from .b import c\nexcept ImportError:\n    from . import b\n"
    )
    known = ("gapcert.contracts.systems.domain", "gapcert.cli.main", "gapcert.report", "gapcert.report.html", "gapcert.b")
    seen = rooms.imported("gapcert.a", tmp_path / "a.py", known, {"gapcert": {"Domain": "gapcert.contracts.systems.domain"}})
    assert [i[1:] for i in seen] == [
        ("gapcert.contracts.systems.domain", "now"),
        ("gapcert.cli.main", "types"),
        ("gapcert.report.html", "later"),
        ("gapcert.report", "later"),
        ("gapcert.b", "now"),
        ("gapcert.b", "now"),
    ]


@pytest.mark.unit
def test_knots_are_found():
    assert rooms.knots([("a", "b"), ("b", "c"), ("c", "a"), ("c", "d"), ("e", "d")]) == [["a", "b", "c"]]
    assert rooms.knots([("a", "b"), ("b", "c"), ("a", "c")]) == []
