"""A header and a C file with the tables: C99, no libraries but math.h, no memory but what the caller keeps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gapcert.plugin import UsageError, harmless, write_atomic
from gapcert_cells.automaton_controller import AutomatonController
from gapcert_cells.grid_controller import efforts

from .parts import Exported, cells_of, ends_of, memory_tables, parts_of, winning_of

LARGEST = 30_000_000
"""Numbers in the tables of a C file: what compilers still take as text."""

HEADER = """\
/* A controller exported from Gapcert: {cells} cells, {winning} of them in its domain.
   SHA-256 of what determines its inputs: {digest}

   States, in order: {states}.
   Every function returns 0, or says why it gives no answer; it then leaves its output as it was.
   Compile as C99 or later, in IEEE double precision and without -ffast-math; link with -lm. */
#ifndef GAPCERT_CONTROLLER_H
#define GAPCERT_CONTROLLER_H

#define CONTROLLER_STATES {nx}
#define CONTROLLER_INPUTS {nu}
#define CONTROLLER_POINTS {points}

#define CONTROLLER_OK 0
#define CONTROLLER_OUTSIDE 1 /* the state is outside the controller's domain, or not a number */
#define CONTROLLER_NO_INPUT 2 /* the goal is reached, and no input is promised there */
#define CONTROLLER_NO_POLICY 3

#define CONTROLLER_FIRST 0
#define CONTROLLER_MIDDLE 1
#define CONTROLLER_LAST 2
#define CONTROLLER_LEAST_EFFORT 3

#ifdef __cplusplus
extern "C" {{
#endif

{memory}/* One allowed input. */
int controller_act(const double x[CONTROLLER_STATES], {given}int policy, double u[CONTROLLER_INPUTS]);

/* The value function: in at most so many steps the target is reached; 0 for invariance. To reach and stay: how many moments,
   this one and those to come, may be outside of the target. */
int controller_value(const double x[CONTROLLER_STATES], {given}long *steps);

/* 1 for every input, of controller_points, that keeps the promise. */
int controller_allowed(const double x[CONTROLLER_STATES], {given}unsigned char allowed[CONTROLLER_POINTS]);

extern const double controller_points[CONTROLLER_POINTS][CONTROLLER_INPUTS];

#ifdef __cplusplus
}}
#endif
#endif
"""

WORDS = ("given", "passed", "moved")
MOVED = """\
  if (memory < 0 || memory >= CONTROLLER_MEMORIES) return CONTROLLER_OUTSIDE;
  index += (size_t)memory * CELLS;
"""

SOURCE = """\
/* A controller exported from Gapcert; controller.h says how to use it. */
#include "controller.h"

#include <math.h>
#include <stddef.h>

#define AXES {axes}
#define HELD {nheld}
#define HALVINGS {halvings}
#define BYTES {width}
#define TURN {turn}

{tables}

/* The angle on the turn of [low, high]: in it if and only if it lies on the nearest copy of it. ends: low, high, middle, and 1
   for a full turn, which has no outside. */
static double turned(double v, const double *ends) {{
  volatile double turns, back, first, last; /* each is rounded once */
  if (!(v < ends[0] || v > ends[1]) || v - v != 0.0) return v;
  turns = TURN * rint((v - ends[2]) / TURN);
  back = v - turns;
  first = ends[0] + turns;
  last = ends[1] + turns;
  if (ends[3] == 0.0 && ((v < first && back < ends[0]) || (v > last && back > ends[1]))) return back;
  return back < ends[0] ? ends[0] : back > ends[1] ? ends[1] : back;
}}

static void placed(const double x[CONTROLLER_STATES], const double box[CONTROLLER_STATES][4], double y[CONTROLLER_STATES]) {{
  int j;
  for (j = 0; j < CONTROLLER_STATES; j++) y[j] = is_angle[j] ? turned(x[j], box[j]) : x[j];
}}

static int grid_cell(const double x[CONTROLLER_STATES], size_t *cell) {{
  double y[CONTROLLER_STATES], v;
  size_t part[AXES], index = 0, low, high, middle, n;
  int j, left;
  placed(x, stay, y);
  for (j = 0; j < HELD; j++) {{
    v = y[held_state[j]];
    if (is_angle[held_state[j]]) v = turned(v, held[j]);
    if (!(v >= held[j][0] && v <= held[j][1])) return CONTROLLER_OUTSIDE;
  }}
  for (j = 0; j < AXES; j++) {{
    const double *e = edges + first_edge[j];
    n = (size_t)(first_edge[j + 1] - first_edge[j] - 1);
    v = y[cell_state[j]];
    if (!(v >= e[0] && v <= e[n])) return CONTROLLER_OUTSIDE;
    low = 0;
    high = n; /* e[low] <= v, and v < e[high] or high is the last edge */
    while (high - low > 1) {{
      middle = low + (high - low) / 2;
      if (e[middle] <= v) low = middle; else high = middle;
    }}
    part[j] = low;
    index = index * (n >> HALVINGS) + (low >> HALVINGS);
  }}
  for (left = HALVINGS; left > 0 && first_child[index] > 0; left--) {{
    for (j = 0, n = 0; j < AXES; j++) n = 2 * n + ((part[j] >> (left - 1)) & 1);
    index = (size_t)first_child[index] + n;
  }}
  *cell = index;
  return CONTROLLER_OK;
}}

/* The cell's place in the tables. */
static int cell_of(const double x[CONTROLLER_STATES], {given}size_t *cell) {{
  size_t index;
  int code = grid_cell(x, &index);
  if (code != CONTROLLER_OK) return code;
{moved}  if (values[index] < 0) return CONTROLLER_OUTSIDE;
  *cell = index;
  return CONTROLLER_OK;
}}

static int allows(size_t cell, int j) {{
  return (sets[(size_t)set_of[cell] * BYTES + (size_t)(j / 8)] >> (7 - j % 8)) & 1;
}}

int controller_value(const double x[CONTROLLER_STATES], {given}long *steps) {{
  size_t cell;
  int code = cell_of(x, {passed}&cell);
  if (code == CONTROLLER_OK) *steps = values[cell];
  return code;
}}

int controller_allowed(const double x[CONTROLLER_STATES], {given}unsigned char allowed[CONTROLLER_POINTS]) {{
  size_t cell;
  int j, code = cell_of(x, {passed}&cell);
  for (j = 0; code == CONTROLLER_OK && j < CONTROLLER_POINTS; j++) allowed[j] = (unsigned char)allows(cell, j);
  return code;
}}

int controller_act(const double x[CONTROLLER_STATES], {given}int policy, double u[CONTROLLER_INPUTS]) {{
  size_t cell;
  int j, k, rank, number = 0, code = cell_of(x, {passed}&cell);
  if (code != CONTROLLER_OK) return code;
  for (j = 0; j < CONTROLLER_POINTS; j++) number += allows(cell, j);
  if (number == 0) return CONTROLLER_NO_INPUT;
  switch (policy) {{
    case CONTROLLER_FIRST: rank = 0; break;
    case CONTROLLER_MIDDLE: rank = number / 2; break;
    case CONTROLLER_LAST: rank = number - 1; break;
    case CONTROLLER_LEAST_EFFORT: rank = 0; break;
    default: return CONTROLLER_NO_POLICY;
  }}
  for (k = 0; k < CONTROLLER_POINTS; k++) {{
    j = policy == CONTROLLER_LEAST_EFFORT ? by_effort[k] : k;
    if (allows(cell, j) && rank-- == 0) break;
  }}
  for (k = 0; k < CONTROLLER_INPUTS; k++) u[k] = controller_points[j][k];
  return CONTROLLER_OK;
}}
"""

MEMORY_HEADER = """\
/* The controller has a memory, a number that the caller keeps, and reads every state of a run once:

     int memory;
     controller_init(&memory);
     each period:  code = controller_step(x, CONTROLLER_FIRST, &memory, u);

   The goal is reached, and the promise ends, where controller_done(memory). */
#define CONTROLLER_MEMORIES {memories}

/* Before a run has begun. */
void controller_init(int *memory);

/* The memory reads x; CONTROLLER_OUTSIDE where the goal is lost, and the memory is as it was then. */
int controller_advance(const double x[CONTROLLER_STATES], int *memory);

/* controller_advance and controller_act in one; where there is no input, the memory is as it was. */
int controller_step(const double x[CONTROLLER_STATES], int policy, int *memory, double u[CONTROLLER_INPUTS]);

/* 1 where the goal is reached. */
int controller_done(int memory);

"""

MEMORY_SOURCE = """
/* a times b, rounded before anything is added to it. */
static double times(double a, double b) {
  volatile double product = a * b;
  return product;
}

static int in_shape(const double x[CONTROLLER_STATES], int k) {
  double y[CONTROLLER_STATES], d[CONTROLLER_STATES];
  volatile double total;
  int i, j;
  placed(x, stay, d);
  placed(d, shape_box[k], y);
  for (j = 0; j < CONTROLLER_STATES; j++) {
    if (!(y[j] >= shape_box[k][j][0] && y[j] <= shape_box[k][j][1])) return 0;
    d[j] = y[j] - shape_centres[k][j];
  }
  for (i = 0; i < CUTS; i++) {
    if (cut_of[i] != k) continue;
    total = 0.0;
    for (j = 0; j < CONTROLLER_STATES; j++) total = total + times(cuts[i][j], y[j]);
    if (!(total <= bounds[i])) return 0;
  }
  total = 0.0;
  for (i = 0; i < TERMS; i++) {
    if (term_of[i] == k) total = total + times(times(d[terms[i][0]], d[terms[i][1]]), factors[i]);
  }
  return total <= 1.0;
}

void controller_init(int *memory) { *memory = MEMORY_START; }

int controller_done(int memory) { return memory >= 0 && memory < CONTROLLER_MEMORIES && is_done[memory]; }

int controller_advance(const double x[CONTROLLER_STATES], int *memory) {
  size_t cell;
  int k, letter = 0, next;
  if (*memory < 0 || *memory >= CONTROLLER_MEMORIES) return CONTROLLER_OUTSIDE;
  for (k = 0; k < SHAPES; k++) {
    if (in_shape(x, k)) letter |= 1 << shape_region[k];
  }
  /* What was proved of the whole cell counts, should a point on a border be told otherwise by rounding. */
  if (grid_cell(x, &cell) == CONTROLLER_OK) letter = (letter | must[cell]) & may[cell];
  next = after[*memory][letter];
  if (next < 0) return CONTROLLER_OUTSIDE;
  *memory = next;
  return CONTROLLER_OK;
}

int controller_step(const double x[CONTROLLER_STATES], int policy, int *memory, double u[CONTROLLER_INPUTS]) {
  int then = *memory, code = controller_advance(x, &then);
  if (code == CONTROLLER_OK) code = controller_act(x, then, policy, u);
  if (code == CONTROLLER_OK) *memory = then;
  return code;
}
"""


def write_c(controller: Exported, out: Path) -> list[Path]:
    """`controller.h` and `controller.c`."""
    parts, stay = parts_of(controller), controller.goal.stay
    one, memory = parts[0], isinstance(controller, AutomatonController)
    sets, which = np.unique(np.concatenate([part.bits for part in parts]), axis=0, return_inverse=True)
    numbers = len(one.values) * (2 * (len(parts) + memory) + (one.splits is not None)) + sets.size
    if numbers > LARGEST:
        raise UsageError(f"export: C tables of {numbers:,} numbers (limit {LARGEST:,}); use --to numpy, or fewer cells")
    words = {"given": "int memory, ", "passed": "memory, ", "moved": MOVED} if memory else dict.fromkeys(WORDS, "")
    counts = {"nx": len(stay.axes), "nu": one.points.shape[1], "points": len(one.points), "cells": cells_of(controller)}
    # Names of a stranger's controller stand in a comment, which they must not end.
    told = ", ".join(f"{a.name} [{a.unit or '1'}]" for a in stay.axes).replace("*/", "* /").replace("/*", "/ *")
    names = {"states": harmless(" ".join(told.replace("\\", "/").split())), "digest": controller.digest()}
    counts |= {"winning": winning_of(controller)}
    declared = MEMORY_HEADER.format(memories=len(parts)) if memory else ""
    header = HEADER.format(**counts, **names, **words, memory=declared)
    held = 0 if one.held is None else len(one.held.axes)
    sizes = {"axes": len(one.edges), "nheld": held, "width": one.bits.shape[1], "turn": repr(2 * np.pi)}
    sizes["halvings"] = 0 if one.splits is None else one.splits.levels
    source = SOURCE.format(**sizes, **words, tables="\n".join(_tables(controller, sets, which.ravel())))
    files = [out / "controller.h", out / "controller.c"]
    for file, text in zip(files, (header, source + (MEMORY_SOURCE if memory else "")), strict=True):
        write_atomic(file, text.encode())
    return files


def _tables(controller: Exported, sets: npt.NDArray[np.uint8], which: npt.NDArray[Any]) -> Iterable[str]:
    parts, stay = parts_of(controller), controller.goal.stay
    one, values = parts[0], np.concatenate([part.values for part in parts])
    others = [j for j in range(len(stay.axes)) if j not in one.on]
    yield _rows("const double controller_points[CONTROLLER_POINTS][CONTROLLER_INPUTS]", one.points)
    yield _list("static const int by_effort", np.argsort(efforts(one.points), kind="stable"))
    yield _list("static const int is_angle", [int(a.kind == "angle") for a in stay.axes])
    yield _rows("static const double stay[CONTROLLER_STATES][4]", ends_of(stay))
    # An array of no length is no C: one row stands there that is never read.
    yield _list("static const int held_state", others or [0])
    yield _rows("static const double held[][4]", ends_of(one.held) if one.held else [[0.0] * 4])
    yield _list("static const int cell_state", one.on)
    yield _list("static const size_t first_edge", np.cumsum([0, *(len(e) for e in one.edges)]))
    yield _list("static const double edges", np.concatenate(one.edges))
    first = np.zeros(1, dtype=np.int64) if one.splits is None else one.splits.first
    yield _list(f"static const {_kind(first)} first_child", first)
    yield _list(f"static const {_kind(values)} values", values)
    yield _list(f"static const {_kind(which)} set_of", which)
    yield _list("static const unsigned char sets", sets.ravel())
    if isinstance(controller, AutomatonController):
        yield from _memory(controller)


def _memory(controller: AutomatonController) -> Iterable[str]:
    made = memory_tables(controller)
    sizes = {"CELLS": len(controller.must), "SHAPES": len(made["region"]), "CUTS": len(made["bounds"])}
    sizes |= {"TERMS": len(made["factors"]), "MEMORY_START": int(made["start"])}
    yield "\n".join(f"#define {name} {value}" for name, value in sizes.items())
    letters = made["after"].shape[1]
    yield _rows(f"static const int after[CONTROLLER_MEMORIES][{letters}]", made["after"], int)
    yield _list("static const int is_done", made["done"].astype(int))
    for name in ("must", "may"):
        yield _list(f"static const {_kind(made[name])} {name}", made[name])
    yield _list("static const int shape_region", made["region"])
    boxes = ("{" + ",".join(_row(ends, float) for ends in shape) + "}" for shape in made["box"])
    yield "static const double shape_box[][CONTROLLER_STATES][4] = {" + ",\n".join(boxes) + "};"
    yield _rows("static const double shape_centres[][CONTROLLER_STATES]", made["centres"])
    # As above, of what there is none of one row stands there.
    yield _list("static const int cut_of", _some(made["cut_of"]))
    yield _rows("static const double cuts[][CONTROLLER_STATES]", _some(made["cuts"]))
    yield _list("static const double bounds", _some(made["bounds"]))
    yield _list("static const int term_of", _some(made["term_of"]))
    yield _rows("static const int terms[][2]", _some(made["terms"]), int)
    yield _list("static const double factors", _some(made["factors"]))


def _some(table: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return table if len(table) else np.zeros((1, *table.shape[1:]), dtype=table.dtype)


def _kind(values: npt.NDArray[Any]) -> str:
    for kind, name in ((np.int8, "signed char"), (np.int16, "short")):
        if np.iinfo(kind).min <= values.min() and values.max() <= np.iinfo(kind).max:
            return name
    return "int"


def _list(head: str, values: Sequence[Any] | npt.NDArray[Any]) -> str:
    items = [repr(v) for v in np.asarray(values).tolist()]
    return f"{head}[{len(items)}] = {{\n" + ",\n".join(",".join(items[k : k + 20]) for k in range(0, len(items), 20)) + "};"


def _rows(head: str, rows: Iterable[Iterable[float]], kind: type = float) -> str:
    return f"{head} = {{\n" + ",\n".join(_row(row, kind) for row in rows) + "};"


def _row(row: Iterable[float], kind: type) -> str:
    return "{" + ",".join(repr(kind(v)) for v in row) + "}"
