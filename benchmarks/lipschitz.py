"""Constants of networks at the optimum of LipSDP: ours with its proof against the same problem in cvxpy with open solvers.

Networks are random (seed 0, Gaussian weights over the root of the fan-in, 4 inputs, 1 output). One thread, CPU seconds. A
peer's value is what the solver printed and no bound; ours is proved.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import time
from collections.abc import Callable
from itertools import pairwise

import gapcert_networks

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import cvxpy as cp
import numpy as np
from harness import Row, alternate, main, row

import gapcert as gc
from gapcert_networks.network_constant import proved

REPEATS, LONG = 3, 3.0  # of each pair; a peer that takes longer runs once
WARM = 0.1  # seconds of each turn
CERTIFIER = gc.registry().build("lipschitz", "lipsdp")


def network(*hidden: int) -> gapcert_networks.Network:
    rng, sizes = np.random.default_rng(0), (4, *hidden, 1)
    weights = tuple(rng.standard_normal((o, i)) / np.sqrt(i) for i, o in pairwise(sizes))
    return gapcert_networks.Network(weights, tuple(np.zeros(len(w)) for w in weights))


def bound(net: gapcert_networks.Network) -> gapcert_networks.NetworkBound:
    return CERTIFIER.bound(net, axes=False)


def reduced(net: gapcert_networks.Network) -> float:
    """One hidden layer, with the block of its multipliers eliminated."""
    (first, last), n = (net.weights[0], net.weights[1][0]), net.n_in
    t, rho, corner = cp.Variable(len(last)), cp.Variable(), cp.Variable((1, 1))
    side = (first.T @ last).reshape(n, 1) / 2
    pairs = (first.T[:, None] * first.T[None]).reshape(n * n, len(last))
    inner = cp.reshape(pairs @ t, (n, n), order="C") / 2
    matrix = cp.bmat([[rho * np.eye(n) - inner, -side], [-side.T, corner]])
    room = corner <= 1 - cp.sum(cp.multiply(last**2, cp.inv_pos(t))) / 2
    cp.Problem(cp.Minimize(rho), [(matrix + matrix.T) / 2 >> 0, room]).solve(solver=cp.CLARABEL)
    return math.sqrt(rho.value)


def whole(net: gapcert_networks.Network, solver: str) -> float:
    """The matrix of all layers, as it is printed."""
    rho, lam = cp.Variable(), [cp.Variable(len(w)) for w in net.weights[:-1]]
    sizes = [net.n_in, *(len(w) for w in net.weights)]
    blocks = [[np.zeros((a, b)) for b in sizes] for a in sizes]
    blocks[0][0] = rho * np.eye(net.n_in)
    for i, w in enumerate(net.weights):
        last = i == len(net.weights) - 1
        blocks[i + 1][i] = -w if last else -cp.diag(lam[i]) @ w
        blocks[i][i + 1] = blocks[i + 1][i].T
        blocks[i + 1][i + 1] = np.eye(len(w)) if last else 2 * cp.diag(lam[i])
    matrix = cp.bmat(blocks)
    cp.Problem(cp.Minimize(rho), [(matrix + matrix.T) / 2 >> 0]).solve(solver=solver)
    return math.sqrt(rho.value)


def seconds(net: gapcert_networks.Network, repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.process_time()
        bound(net)
        times.append(time.process_time() - start)
    return statistics.median(times)


def against(
    case: str, net: gapcert_networks.Network, peer: Callable[[gapcert_networks.Network], float], name: str, *, same: float
) -> list[Row]:
    """Time of both, and by how much the peer's value lies above what is proved (below 0: it is too small to be a bound)."""
    values = []
    ours, theirs = alternate(lambda: bound(net), lambda: values.append(peer(net)), repeats=REPEATS, long=LONG, warm=WARM)
    best = bound(net)
    print(f"{case}: {name}: {theirs:.3g} s", file=sys.stderr)
    if abs(values[-1] / best.value - 1) > same:
        raise SystemExit(f"lipschitz: {case}: {name} says {values[-1]}, and {best.value} is proved")
    return [
        row(case, "time", "s of CPU", ours, theirs, name),
        Row(case, "value over the optimum's lower bound, less 1", "1", best.gap, values[-1] / best.lower - 1, name, None),
    ]


def proof(case: str, net: gapcert_networks.Network, b: gapcert_networks.NetworkBound, whole_time: float) -> Row:
    """One proof from the finished multipliers, as a share of all."""
    start = time.process_time()
    if proved(net.weights, b.multipliers, b.value**2 * (1 + 1e-10)) is None:
        raise SystemExit(f"lipschitz: {case}: the multipliers prove nothing")
    spent = time.process_time() - start
    return Row(case, "one proof of the constant", "s of CPU", spent, whole_time, "solver and proof together", None)


def measure(options: argparse.Namespace) -> list[Row]:
    repeats = 5 if options.quick else 9
    bound(network(8)), bound(network(8, 8))  # warm
    wide, naive = network(400), 100 if options.quick else 400
    rows = against(f"4-{naive}-1", network(naive), lambda n: whole(n, cp.CLARABEL), "cvxpy, Clarabel, 3 blocks", same=1e-4)
    rows += against("4-400-1", wide, reduced, "cvxpy, Clarabel, reduced form", same=1e-4)
    base = seconds(wide, repeats)
    for width in (40_000, 400_000):
        net = network(width)
        spent = seconds(net, 3)
        rows.append(Row(f"4-{width:,}-1", "time", "s of CPU", spent, base, "ours at 400 neurons", None))
        rows.append(Row(f"4-{width:,}-1", "relative gap", "1", bound(net).gap, None, "", None))
    rows += against("4-32-32-1", network(32, 32), lambda n: whole(n, cp.CLARABEL), "cvxpy, Clarabel", same=1e-4)
    if not options.quick:  # takes minutes
        rows += against("4-64-64-64-1", network(64, 64, 64), lambda n: whole(n, cp.SCS), "cvxpy, SCS, its defaults", same=1e-2)
    for hidden in ((400,), (64,) * 3, (128,) * 5, (100,) * 10):
        case, net = f"4-{hidden[0]}-1" if len(hidden) == 1 else f"4-{hidden[0]}^{len(hidden)}-1", network(*hidden)
        start = time.process_time()
        found = bound(net)
        spent = time.process_time() - start
        if len(hidden) > 1:
            rows.append(Row(case, "time", "s of CPU", spent, None, "", None))
            rows.append(Row(case, f"relative gap of {found.value:.9g}", "1", found.gap, None, "", None))
        rows.append(proof(case, net, found, base if len(hidden) == 1 else spent))
    return rows


if __name__ == "__main__":
    main(measure, argparse.ArgumentParser(description=__doc__))
