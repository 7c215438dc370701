"""Pictures over two states: which parts of the goal they draw, what they call them, and where runs are cut."""

from __future__ import annotations

import numpy as np

from gapcert import Box, Goal, Region, StateSpec
from gapcert.contracts.controllers.goal import Automaton
from gapcert.contracts.systems.region import Ellipsoid
from gapcert_cells import AutomatonController, GridController
from gapcert_figures import Axis, LoopFigure, WinningFigure
from gapcert_figures.data import Figures, Runs, winning_figure
from gapcert_figures.region_outlines import outlines_of
from gapcert_report.pictures.control import runs_picture, trace_picture, value_picture, winning_picture

AXES = (StateSpec("h", "rad", "angle"), StateSpec("x", "m"), StateSpec("z", "m"))
STAY = Box(AXES, (-np.pi, -1.0, 0.0), (np.pi, 1.0, 2.0))
POST = Box(AXES, (-0.5, -0.5, 0.0), (0.5, 0.5, 2.0))
DISC = Ellipsoid.of(STAY, {"h": 3.0, "x": 0.0, "z": 0.2}, {"h": 0.5, "x": 0.5, "z": 0.2})
ENDS = Automaton(("dock",), ((0, 1), (1, 1)), (False, True), 0, "F dock")
GOAL = Goal("automaton", STAY, avoid=Region((POST,)), automaton=ENDS, regions=(Region((), (), (DISC,)),))


def controller(layer: int) -> AutomatonController:
    """It wins in one of five layers of z."""
    counts = (8, 6, 5)
    edges = tuple(np.linspace(a, b, n + 1) for a, b, n in zip(STAY.low, STAY.high, counts, strict=True))
    values = np.full(counts, -1, dtype=np.int32)
    values[:, :, layer] = np.arange(8)[:, None]
    bits = np.full((values.size, 1), 128, dtype=np.uint8)
    parts = tuple(GridController(GOAL, edges, np.zeros((1, 1)), bits, v.ravel(), {}) for v in (values, values * 0))
    none = np.zeros(values.size, dtype=np.int64)
    return AutomatonController(GOAL, parts, none, none, {})


def figure(at: float = 1.0) -> WinningFigure:
    grid = np.ones((4, 4))
    return WinningFigure(
        Axis.all_of(STAY), f"z = {at:g} m", "automaton", grid, grid, 3 * grid, outlines_of(GOAL, np.array([0, 0, at]))
    )


def loop() -> LoopFigure:
    t = np.stack([np.array([2.5, 3.0, -2.8, -2.4]), np.zeros(4), np.ones(4)], axis=1)
    x, none = np.vstack([t, t[:2] * np.nan])[None], np.array([-1])
    runs = tuple(Runs(gamma, "first", 1, 5, none, x, none, x) for gamma in (False, True))
    return LoopFigure(Axis.all_of(STAY), 0.1, np.column_stack([STAY.low, STAY.high]), runs)


def test_regions_have_their_names_and_are_dotted_where_the_plane_misses_them() -> None:
    high, low = figure(1.0), figure(0.2)
    assert {(o.role, o.where) for o in high.outlines} == {
        ("stay", "everywhere"),
        ("avoid", "everywhere"),
        ("region", "elsewhere"),
    }
    for w, dotted in ((high, True), (low, False)):
        for picture in (winning_picture(w), value_picture(w)):
            assert ">dock<" in picture.svg
            assert ("Dotted: not at z = 1 m." in picture.caption) == dotted
            assert ("stroke-dasharray" in picture.svg) == dotted
    runs = runs_picture(loop(), low)
    assert runs.caption.endswith("Dotted: at some values of z alone.")
    assert "stroke-dasharray" in runs.svg


def test_runs_are_cut_where_an_angle_comes_round() -> None:
    made = loop()
    assert [len(piece) for piece in made.pieces(made.runs[0].traces[0])] == [2, 2]
    straight = LoopFigure(tuple(Axis(a.name, a.unit, a.low, a.high) for a in made.axes), 0.1, made.stay, made.runs)
    assert len(straight.pieces(made.runs[0].traces[0])) == 1
    # A full turn has no limit to be drawn.
    assert "limit" not in [e.name for e in trace_picture(made).legend]
    assert "limit" in [e.name for e in trace_picture(straight).legend]


def test_a_slice_is_taken_where_something_wins(tmp_path) -> None:
    middle, low = winning_figure(controller(2), controller(2)), winning_figure(controller(0), controller(0))
    assert middle is not None
    assert low is not None
    assert middle.fixed == "z = 1 m"
    assert 0 < float(low.fixed.split()[2]) < 0.4
    assert low.with_gamma.all()
    assert np.nanmax(low.values) == 7
    Figures(winning=low, loop=loop()).save(tmp_path)
    again = Figures.load(tmp_path)
    assert again.winning is not None
    assert [o.where for o in again.winning.outlines] == [o.where for o in low.outlines]
    assert all(np.array_equal(a.points, b.points) for a, b in zip(again.winning.outlines, low.outlines, strict=True))
