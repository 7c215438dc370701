"""Constants of networks on the box [−1, 1]ⁿ: time to a gap, against branch and bound over interval gradients in the same time.

Networks are random (seed 0, Gaussian weights over the root of the fan-in, biases of 0.3), or trained here. One thread, CPU
seconds. Ours is rounded outwards; the peer is not, and is given our lower bound from the start.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import statistics
import sys
import time
from itertools import pairwise
from pathlib import Path

import gapcert_networks

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import numpy as np
from harness import Row, main, row
from scipy.optimize import minimize

import gapcert as gc

LONG = 50.0  # s of wall clock for what is not expected to end
CHUNK = 512
REPEATS = 3


def network(*sizes: int) -> gapcert_networks.Network:
    rng = np.random.default_rng(0)
    weights = tuple(rng.standard_normal((o, i)) / np.sqrt(i) for i, o in pairwise(sizes))
    return gapcert_networks.Network(weights, tuple(rng.standard_normal(len(w)) * 0.3 for w in weights))


def trained(n: int, h: int, steps: int = 150) -> gapcert_networks.Network:
    """ReLU, least squares on 2,048 points of a function with kinks, by L-BFGS."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (2048, n))
    y = np.abs(x[:, 0]) * 0.4 + 0.3 * np.sin(2 * x[:, 1]) * x[:, 2] + 0.2 * np.maximum(x[:, 3], x[:, 0])
    cut = np.cumsum([h * n, h, h])
    start = np.concatenate([rng.standard_normal(h * n) / np.sqrt(n), rng.standard_normal(h) * 0.3, rng.standard_normal(h) / h])

    def loss(p: np.ndarray) -> tuple[float, np.ndarray]:
        first, b, w = p[: cut[0]].reshape(h, n), p[cut[0] : cut[1]], p[cut[1] :]
        v = x @ first.T + b
        z = np.maximum(v, 0)
        off = (z @ w - y) / len(x)
        back = off[:, None] * w * (v > 0)
        return 0.5 * len(x) * float(off @ off), np.concatenate([(back.T @ x).ravel(), back.sum(axis=0), z.T @ off])

    p = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": steps}).x
    return gapcert_networks.Network((p[: cut[0]].reshape(h, n), p[cut[1] :][None]), (p[cut[0] : cut[1]], np.zeros(1)))


def interval(net: gapcert_networks.Network, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The norm of the largest entries of an interval that contains the gradient on each box."""
    c, r, gates = (low + high) / 2, (high - low) / 2, []
    for w, b in zip(net.weights[:-1], net.biases[:-1], strict=True):
        z, reach = c @ w.T + b, r @ np.abs(w).T
        a, d = z - reach, z + reach
        gates.append(((a > 0) * 1.0, (d > 0) * 1.0))
        a, d = np.maximum(a, 0), np.maximum(d, 0)
        c, r = (a + d) / 2, (d - a) / 2
    middle, wide = np.broadcast_to(net.weights[-1][0], gates[-1][0].shape), np.zeros_like(gates[-1][0])
    for (off, on), w in zip(gates[::-1], net.weights[-2::-1], strict=True):
        a, d = middle - wide, middle + wide
        a, d = np.where(a < 0, a * on, a * off), np.where(d > 0, d * on, d * off)
        middle, wide = (a + d) / 2 @ w, (d - a) / 2 @ np.abs(w)
    return np.linalg.norm(np.abs(middle) + wide, axis=1)


def peer(net: gapcert_networks.Network, lower: float, tolerance: float, seconds: float) -> float:
    """Halves the longest side of the boxes with the largest bounds; value/lower − 1 when the time is over."""
    low, high = -np.ones((1, net.n_in)), np.ones((1, net.n_in))
    upper, done, end = interval(net, low, high), lower, time.process_time() + seconds
    while len(upper) and time.process_time() < end:
        worst = np.argsort(-upper)[: max(CHUNK, len(upper) // 4)]
        for a in range(0, len(worst), CHUNK):
            pick = worst[a : a + CHUNK]
            i, k = np.arange(len(pick)), (high[pick] - low[pick]).argmax(axis=1)
            first, second = high[pick].copy(), low[pick].copy()
            first[i, k] = second[i, k] = (low[pick] + high[pick])[i, k] / 2
            lo, hi = np.concatenate([low[pick], second]), np.concatenate([first, high[pick]])
            new = np.minimum(interval(net, lo, hi), np.tile(upper[pick], 2))
            low[pick], high[pick], upper[pick] = lo[: len(pick)], hi[: len(pick)], new[: len(pick)]
            low, high, upper = (
                np.concatenate(p) for p in ((low, lo[len(pick) :]), (high, hi[len(pick) :]), (upper, new[len(pick) :]))
            )
            if time.process_time() > end:
                break
        keep = upper > lower * (1 + tolerance)
        done = max(done, float(upper[~keep].max(initial=0.0)))
        low, high, upper = low[keep], high[keep], upper[keep]
    return max(done, float(upper.max(initial=0.0))) / lower - 1


def against(case: str, net: gapcert_networks.Network, tolerance: float) -> list[Row]:
    box = -np.ones(net.n_in), np.ones(net.n_in)
    start = time.process_time()
    found = gapcert_networks.local_bound(net, box, tolerance=tolerance, budget=10**9, seconds=LONG)
    spent = time.process_time() - start
    theirs = peer(net, found.lower, tolerance, spent)
    everywhere = gc.registry().build("lipschitz", "lipsdp").bound(net, axes=False).value
    print(f"{case}: {found.value:.6g} after {found.boxes} boxes, {spent:.3g} s", file=sys.stderr)
    goal = f"to {tolerance:.0%}" if found.gap <= tolerance else f"{tolerance:.0%} was not reached"
    return [
        Row(case, f"time, {goal}", "s of CPU", spent, None, "", None),
        Row(case, "boxes", "1", found.boxes, None, "", None),
        Row(case, "value/lower − 1", "1", found.gap, theirs, "interval gradients, same time", theirs / found.gap),
        Row(case, "constant", "1", found.value, everywhere, "LipSDP, all of space", everywhere / found.value),
    ]


def per_cell(case: str, net: gapcert_networks.Network, cells: int) -> list[Row]:
    """With a budget of one box, what is left is the grid."""
    box = -np.ones(net.n_in), np.ones(net.n_in)
    start = time.process_time()
    found = gapcert_networks.local_bound(net, box, budget=1, cells=cells)
    spent = time.process_time() - start
    everywhere = gc.registry().build("lipschitz", "lipsdp").bound(net, axes=False).value
    mean, count = float(found.constants.mean()), found.constants.size
    return [
        Row(f"{case}, {count:,} cells", "mean constant", "1", mean, everywhere, "LipSDP, all of space", everywhere / mean),
        Row(f"{case}, {count:,} cells", "time per cell", "ms of CPU", 1e3 * spent / count, None, "", None),
    ]


def cells_of(folder: Path) -> list[str]:
    """LipBaB.py as the cells of the notebook that it was."""
    if importlib.util.find_spec("cvxopt") is None or importlib.util.find_spec("cvxopt.glpk") is None:
        raise SystemExit("local: --lipbab needs the package cvxopt with GLPK; it is not installed here")
    program = folder / "LipBaB.py"
    parts = re.split(r"^# In\[\d+\]:$", program.read_text(), flags=re.MULTILINE) if program.is_file() else []
    whole = len(parts) == 13 and (folder / "saved_networks").is_dir()
    if not whole or "np.load" not in parts[11] or "pnorm=2" not in parts[12] or "af=1 " not in parts[12]:
        raise SystemExit(f"local: {program} is not LipBaB's program of 12 cells, beside saved_networks; give its folder")
    return parts


def lipbab(
    cells: list[str], net: gapcert_networks.Network, box: tuple[np.ndarray, np.ndarray], tolerance: float
) -> tuple[float, ...]:
    """(Its value, CPU seconds to the tolerance, CPU seconds to the end, subproblems), as published, but for the 11th cell."""
    sizes = [net.n_in, *(len(w) for w in net.weights)]
    space = {
        "weights": [None, *(w.tolist() for w in net.weights)],
        "biases": [None, *(b.tolist() for b in net.biases)],
        "ls": sizes,
        "L": len(sizes) - 1,
        "X": [0] * net.n_in,
        "act_pat": [[[1, 1] for _ in range(k)] for k in sizes],
        "bnds": np.transpose(box).tolist(),
    }
    times: list[float] = []

    def told(*words: object) -> None:
        """It prints the largest bound that is left: where it would stop with the tolerance as its factor `af`."""
        if not times and not isinstance(words[0], str) and words[0] <= (1 + tolerance) * space["glb"]:
            times.append(time.process_time())

    exec("\n".join(cells[:11]), space)
    space["print"] = told
    start = time.process_time()
    exec(cells[12], space)
    end = time.process_time()
    return float(space["tp"].Lub), (times or [end])[0] - start, end - start, space["pcnt"]


def beside(
    case: str, net: gapcert_networks.Network, box: tuple[np.ndarray, np.ndarray], tolerance: float, cells: list[str]
) -> list[Row]:
    """Beside LipBaB, once; the values are held against each other, too."""
    spent = []
    for _ in range(REPEATS):
        start = time.process_time()
        found = gapcert_networks.local_bound(net, box, tolerance=tolerance, budget=10**9, seconds=LONG)
        spent.append(time.process_time() - start)
        if spent[-1] > LONG / 2:
            break
    exact, soon, late, problems = lipbab(cells, net, box, tolerance)
    print(f"{case}: LipBaB {exact:.17g} after {soon:.3g} s to the tolerance, {late:.3g} s to the end", file=sys.stderr)
    reached = found.gap <= tolerance
    if not found.lower <= exact * (1 + 1e-12) or not exact * (1 - 1e-12) <= found.value:
        raise SystemExit(f"local: {case}: LipBaB says {exact}, and {found.lower} to {found.value} is proved")
    goal = f"to {tolerance:.0%}" if reached else f"{tolerance:.0%} was not reached"
    return [
        row(case, f"time, {goal}", "s of CPU", statistics.median(spent), soon, f"LipBaB, to {tolerance:.0%}"),
        Row(case, "boxes", "1", found.boxes, problems, "LipBaB, subproblems to the exact constant", None),
        Row(case, "value over LipBaB's exact constant, less 1", "1", found.value / exact - 1, None, "", None),
    ]


def theirs(folder: Path, name: str) -> gapcert_networks.Network:
    """The first output of a network that comes with LipBaB."""
    w, b = (np.load(folder / "saved_networks" / f"{name}_{part}.npy", allow_pickle=True) for part in ("weights", "biases"))
    weights, biases = [np.array(v, dtype=float).T for v in w], [np.array(v, dtype=float) for v in b]
    return gapcert_networks.Network((*weights[:-1], weights[-1][:1]), (*biases[:-1], biases[-1][:1]))


def with_lipbab(folder: Path, quick: bool) -> list[Row]:
    cells = cells_of(folder)
    rows = []
    for sizes, tolerance in [((2, 32, 32, 1), 0.05)] + ([] if quick else [((4, 50, 1), 0.01)]):
        net = network(*sizes)
        rows += beside("-".join(map(str, sizes)), net, (-np.ones(net.n_in), np.ones(net.n_in)), tolerance, cells)
    for name in ["SDnet_(10,15,10,3)"] + ([] if quick else ["SDnet_(10,20,15,10,3)"]):
        net = theirs(folder, name)
        rows += beside(f"LipBaB's {name}, first output, [0, 0.1]¹⁰", net, (np.zeros(10), np.full(10, 0.1)), 0.05, cells)
    return rows


def measure(options: argparse.Namespace) -> list[Row]:
    if options.lipbab:
        cells_of(options.lipbab)  # what is missing is told first
    gapcert_networks.local_bound(network(4, 8, 1), (-np.ones(4), np.ones(4)))  # warm
    fitted = trained(4, 400)
    rows = against("4-50-1", network(4, 50, 1), 0.01)
    rows += against("4-400-1", network(4, 400, 1), 0.01)
    rows += against("4-400-1, trained", fitted, 0.01)
    rows += per_cell("4-400-1, trained", fitted, 10)
    rows += against("3-64-64-1", network(3, 64, 64, 1), 0.05)
    rows += against("4-64-64-1", network(4, 64, 64, 1), 0.05)
    if not options.quick:  # two minutes each
        rows += against("6-400-1", network(6, 400, 1), 0.05)
        rows += against("4-64^3-1", network(4, 64, 64, 64, 1), 0.05)
    return rows + (with_lipbab(options.lipbab, options.quick) if options.lipbab else [])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--lipbab", type=Path, metavar="FOLDER", help="a copy of the public repository pyrobits/LipBaB")
    main(measure, parser)
