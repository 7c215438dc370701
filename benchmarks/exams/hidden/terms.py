"""Mass matrices and forces of the plants, written out by hand and compiled: nothing here comes from equation text."""

from __future__ import annotations

import math

from exams.hidden import slots as s
from exams.hidden.slots import compiled
from gapcert.numerics.arrays import Array

STANDARD = 9.80665


@compiled
def mass(plant: int, p: Array, exact: Array, C: Array, W: Array, at: int, M: Array) -> None:
    """M(q) at row `at` of the workspace, with the point masses that the coordinates carry."""
    if plant == 0:
        M[0, 0, 0] = p[0] * p[1] * p[1] + p[2] + C[0, s.PAYLOAD] * exact[0] * exact[0]
    elif plant == 1:
        M[0, 0, 0] = p[0] + C[0, s.PAYLOAD]
    elif plant == 2:
        far = C[1, s.PAYLOAD] * exact[0]
        M[0, 0, 0] = p[0] + p[1] + C[0, s.PAYLOAD] + C[1, s.PAYLOAD]
        M[0, 0, 1] = M[0, 1, 0] = (p[1] * p[2] + far) * math.cos(W[at, 1])
        M[0, 1, 1] = p[1] * p[2] * p[2] + p[3] + far * exact[0]
    elif plant == 3:
        m1, m2, l1, c1, c2 = p[0], p[1], p[2], p[3], p[4]
        tip = exact[0]
        first = m2 * c2 + C[1, s.PAYLOAD] * tip
        second = m2 * c2 * c2 + C[1, s.PAYLOAD] * tip * tip + p[6]
        cross = l1 * first * math.cos(W[at, 1])
        M[0, 0, 0] = p[5] + m1 * c1 * c1 + (m2 + C[0, s.PAYLOAD] + C[1, s.PAYLOAD]) * l1 * l1 + second + 2 * cross
        M[0, 0, 1] = M[0, 1, 0] = second + cross
        M[0, 1, 1] = second
    elif plant == 4:
        M[0, 0, 0] = M[0, 1, 1] = 1.0
        M[0, 0, 1] = M[0, 1, 0] = 0.0
    elif plant == 5:
        M[0, :, :] = 0.0
        M[0, 0, 0] = M[0, 1, 1] = p[0]
        M[0, 2, 2] = p[1]
    else:
        chain_mass(p, W, at, M)


@compiled
def bias(plant: int, p: Array, exact: Array, C: Array, W: Array, at: int) -> None:
    """Forces that the motion and gravity need, into row BIAS; gravity is turned along tilted coordinates."""
    g = 9.81
    if plant == 0:
        W[s.BIASED, 0] = (p[0] * p[1] + C[0, s.PAYLOAD] * exact[0]) * g * math.sin(W[at, 0] - C[0, s.TILT])
    elif plant == 1:
        W[s.BIASED, 0] = -(p[0] + C[0, s.PAYLOAD]) * STANDARD * math.sin(C[0, s.TILT])
    elif plant == 2:
        first = p[1] * p[2] + C[1, s.PAYLOAD] * exact[0]
        push = STANDARD * math.sin(C[0, s.TILT])
        W[s.BIASED, 0] = (
            -first * math.sin(W[at, 1]) * W[at + 1, 1] * W[at + 1, 1] - (p[0] + p[1] + C[0, s.PAYLOAD] + C[1, s.PAYLOAD]) * push
        )
        W[s.BIASED, 1] = first * g * math.sin(W[at, 1] - C[1, s.TILT]) - first * math.cos(W[at, 1]) * push
    elif plant == 3:
        m1, m2, l1, c1, c2 = p[0], p[1], p[2], p[3], p[4]
        first = m2 * c2 + C[1, s.PAYLOAD] * exact[0]
        h = l1 * first * math.sin(W[at, 1])
        upper = (m1 * c1 + (m2 + C[0, s.PAYLOAD] + C[1, s.PAYLOAD]) * l1) * g * math.sin(W[at, 0] - C[0, s.TILT])
        lower = first * g * math.sin(W[at, 0] - C[0, s.TILT] + W[at, 1] - C[1, s.TILT])
        W[s.BIASED, 0] = -h * (2 * W[at + 1, 0] * W[at + 1, 1] + W[at + 1, 1] * W[at + 1, 1]) + upper + lower
        W[s.BIASED, 1] = h * W[at + 1, 0] * W[at + 1, 0] + lower
    elif plant == 4:
        W[s.BIASED, 0] = W[s.BIASED, 1] = 0.0
    elif plant == 5:
        W[s.BIASED, 0] = p[2] * W[at + 1, 0]
        W[s.BIASED, 1] = p[2] * W[at + 1, 1]
        W[s.BIASED, 2] = p[3] * W[at + 1, 2]
        for j in range(2):
            W[s.BIASED, j] -= p[0] * STANDARD * math.sin(C[j, s.TILT])
    else:
        chain_bias(p, C, W, at)


@compiled
def applied(plant: int, p: Array, W: Array, at: int, u: Array) -> None:
    """Forces of the inputs, for a plain derivative its whole right-hand side, into row FORCE."""
    if plant == 2:
        W[s.FORCE, 0], W[s.FORCE, 1] = u[0], 0.0
    elif plant == 4:
        w, i = W[at + 1, 0], W[at + 1, 1]
        W[s.FORCE, 0], W[s.FORCE, 1] = p[1] * i / p[2], (u[0] - p[0] * i - p[1] * w) / p[3]
    elif plant == 5:
        cos, sin = math.cos(W[at, 2]), math.sin(W[at, 2])
        W[s.FORCE, 0], W[s.FORCE, 1], W[s.FORCE, 2] = u[0] * cos - u[1] * sin, u[0] * sin + u[1] * cos, u[2]
    else:
        for j in range(W.shape[1]):
            W[s.FORCE, j] = u[j]


@compiled
def chain_mass(p: Array, W: Array, at: int, M: Array) -> None:
    """By absolute angles φ: T = ½ Σ A_ij cos(φ_i − φ_j) φ̇_i φ̇_j, summed from the tip inwards; ROTOR on the diagonal."""
    n = W.shape[1]
    ll = 0.25 * 0.25
    M[0, :, :] = 0.0
    for i in range(n - 1, -1, -1):
        for j in range(n - 1, -1, -1):
            a, b = min(i, j), max(i, j)
            inertia = p[b] / 3 if a == b else p[b] / 2
            angle = 0.0
            for k in range(b + 1, n):
                inertia += p[k]
            for k in range(a + 1, b + 1):
                angle += W[at, k]
            M[0, i, j] = ll * inertia * math.cos(angle)
            # Sums over all later rows and columns by inclusion and exclusion.
            if i + 1 < n:
                M[0, i, j] += M[0, i + 1, j]
            if j + 1 < n:
                M[0, i, j] += M[0, i, j + 1]
            if i + 1 < n and j + 1 < n:
                M[0, i, j] -= M[0, i + 1, j + 1]
    for i in range(n):
        M[0, i, i] += 0.05


@compiled
def chain_bias(p: Array, C: Array, W: Array, at: int) -> None:
    n = W.shape[1]
    length, g = 0.25, 9.81
    for i in range(n - 1, -1, -1):
        total, phi, below = 0.0, 0.0, p[i] / 2
        for k in range(i + 1, n):
            below += p[k]
        for k in range(i + 1):
            phi += W[at, k] - C[k, s.TILT]
        speed, angle_j = 0.0, 0.0
        angle_i = 0.0
        for k in range(i + 1):
            angle_i += W[at, k]
        for j in range(n):
            speed += W[at + 1, j]
            angle_j += W[at, j]
            b = max(i, j)
            inertia = p[b] / 2
            for k in range(b + 1, n):
                inertia += p[k]
            if i != j:
                total += inertia * math.sin(angle_i - angle_j) * speed * speed
        W[s.BIASED, i] = length * length * total + length * g * below * math.sin(phi)
        if i + 1 < n:
            W[s.BIASED, i] += W[s.BIASED, i + 1]
    for i in range(n):
        W[s.BIASED, i] += 0.1 * W[at + 1, i]


@compiled
def solve(M: Array, W: Array, into: int) -> None:
    """Row `into` = M_ff⁻¹ (row NET) over the coordinates that are not stuck and 0 elsewhere; M is positive definite."""
    n = W.shape[1]
    for i in range(n):
        stuck = W[s.MODE, i] == 0
        W[into, i] = 0.0 if stuck else W[s.NET, i]
        for j in range(n):
            M[1, i, j] = (1.0 if i == j else 0.0) if stuck or W[s.MODE, j] == 0 else M[0, i, j]
    for k in range(n):
        for i in range(k + 1, n):
            factor = M[1, i, k] / M[1, k, k]
            if factor != 0.0:
                for j in range(k + 1, n):
                    M[1, i, j] -= factor * M[1, k, j]
                W[into, i] -= factor * W[into, k]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            W[into, i] -= M[1, i, j] * W[into, j]
        W[into, i] /= M[1, i, i]
