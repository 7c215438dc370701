"""A task of several parts: the car that ROCS 2 comes with, with its formula; CPU seconds and memory, for the same cells.

The problem is specs/benchmarks/car.yaml. Ours is one call of the synthesizer, abstraction, game and all valid inputs, on one
thread of a process that has solved a coarser one before. With `--rocs FOLDER`, peers/rocs.cc is compiled with the sources
there, which need the headers of Boost and Armadillo, and the two run in turn: each cell has to win for both or for neither.
ROCS's seconds are those of its abstraction and of its game on the product with the automaton; its memory is its process's.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import harness
import numpy as np
import symbolic as published

import gapcert as gc
from gapcert_symbolic.synthesizer import Symbolic

CAR, WINNING, REPEATS, RUNS = published.SPECS / "car.yaml", 74_994, 3, 3
AUTOMATON = Path("examples", "car", "dba1.txt")
SOURCES = ("grid.cpp", "interval.cpp", "interval_vector.cpp", "DBAparser.cpp")
# Its own options, with the header of Armadillo alone; compilers as of now want no warnings of 2021.
OPTIONS = ("-O3", "-DNDEBUG", "-DARMA_NO_DEBUG", "-w")
LEAN = ("-DARMA_DONT_USE_WRAPPER", "-DARMA_DONT_USE_BLAS", "-DARMA_DONT_USE_LAPACK")


def alone(runs: int, file: str) -> dict[str, Any]:
    """Ours, in this process: seconds and MB, and what it won, held against a file of the peer's where there is one."""
    spec = gc.load_spec(CAR)
    model, made = spec.build("model"), replace(spec.build("controller"), threads=1)
    domain = gc.Domain.of(model, dict(spec.config.domain))
    asked = gc.SynthesisProblem(model, None, domain, spec.goal(domain))
    coarse = Symbolic({n: c // 3 for n, c in made.cells.items()}, made.inputs, input_range=made.input_range, threads=1)
    coarse.synthesize(asked)
    before, spent = published.memory("VmRSS"), []
    Path("/proc/self/clear_refs").write_text("5")
    for _ in range(runs):
        controller = None  # two of them at once are nobody's need
        start = time.process_time()
        controller = made.synthesize(asked)
        spent.append(time.process_time() - start)
    assert controller is not None
    peak = published.memory("VmHWM")
    counts = controller.parts[0].counts
    low, high = (np.stack(np.meshgrid(*e, indexing="ij"), axis=-1).reshape(-1, len(counts)) for e in _ends(controller))
    won = controller.contains((low + high) / 2)
    if file:
        theirs = np.fromfile(file, dtype=np.int8).reshape(counts, order="F").ravel()
        if not np.array_equal(theirs == 1, won):
            raise SystemExit("symbolic_tasks: ROCS has other winning cells")
    if (number := int(controller.evidence["winning_cells"])) != int(won.sum()):
        raise SystemExit(f"symbolic_tasks: {won.sum()} middles of cells win; the controller says {number}")
    return {"seconds": statistics.median(spent), "over": peak - before, "process": peak, "winning": number}


def _ends(controller: Any) -> tuple[list[Any], list[Any]]:
    edges = controller.parts[0].edges
    return [e[:-1] for e in edges], [e[1:] for e in edges]


def compiled(folder: Path, out: Path) -> Path:
    found = [AUTOMATON, *(Path("src", name) for name in (*SOURCES, "buchi.c"))]
    if missing := [name for name in found if not (folder / name).is_file()]:
        raise SystemExit(f"symbolic_tasks: {folder} has no {missing[0]}; give a copy of ROCS 2")
    if not (shutil.which("g++") and shutil.which("gcc")):
        raise SystemExit("symbolic_tasks: no g++ and gcc")
    source, program = folder / "src", out / "rocs"
    subprocess.run(["gcc", *OPTIONS, "-c", source / "buchi.c", "-o", out / "buchi.o"], check=True)
    own = [published.HERE / "peers" / "rocs.cc", *(source / name for name in SOURCES), out / "buchi.o"]
    subprocess.run(["g++", *OPTIONS, *LEAN, "-std=c++11", f"-I{folder}", "-o", program, *own], check=True)
    return program


def peer(program: Path, folder: Path, file: Path) -> dict[str, float]:
    command = [str(program), str(file), str(folder / AUTOMATON), "0.2", "0.2", "0.2"]
    # It says much; what is asked for is the line before what it says as it ends.
    text = subprocess.run(command, check=True, capture_output=True, text=True, errors="replace").stdout
    said = next(line for line in text.splitlines() if line.startswith("result ")).split()[1:]
    return {"winning": int(said[3]), "seconds": float(said[4]) + float(said[5]), "process": int(said[6]) * 1024 / 1e6}


def measure(options: argparse.Namespace) -> list[harness.Row]:
    mine, theirs = list[dict[str, Any]](), list[dict[str, float]]()
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        program = compiled(options.rocs, out) if options.rocs else None
        for _ in range(1 if options.quick else REPEATS):
            if program:
                theirs.append(peer(program, options.rocs, out / "won"))
            command = [sys.executable, __file__, "alone", str(RUNS), str(out / "won") if program else ""]
            mine.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout))
            for found, whose in ((mine, "ours"), (theirs, "ROCS")):
                if found and found[-1]["winning"] != WINNING:
                    raise SystemExit(f"symbolic_tasks: {whose}: {found[-1]['winning']} cells win; expected {WINNING}")

    def middle(which: str, found: list[Any]) -> float | None:
        return statistics.median(d[which] for d in found) if found else None

    peak, rocs = middle("process", theirs), "ROCS 2" if theirs else ""
    case = "car, 93,636 cells × 49 inputs × 5 states"
    return [
        harness.row(case, "time", "s of CPU", middle("seconds", mine) or 0.0, middle("seconds", theirs), rocs),
        harness.row(case, "memory, less that of the warm process", "MB", middle("over", mine) or 0.0, peak, rocs),
        harness.row(case, "memory of the process", "MB", middle("process", mine) or 0.0, peak, rocs),
        harness.Row(
            f"car, {WINNING:,} cells",
            "cells that win from the beginning",
            "1",
            mine[-1]["winning"],
            middle("winning", theirs),
            f"{rocs}, the same cells" if theirs else "",
            None,
        ),
    ]


if __name__ == "__main__":
    if sys.argv[1:2] == ["alone"]:
        print(json.dumps(alone(int(sys.argv[2]), sys.argv[3])))
    else:
        parser = argparse.ArgumentParser(description=__doc__)
        parser.add_argument("--rocs", type=Path, metavar="FOLDER", help="a copy of ROCS 2, with src and examples in it")
        harness.main(measure, parser)
