"""What a stored certificate says of itself, against its data: figures of states, hidden state, a symmetry, cells."""

from __future__ import annotations

import numpy as np

from gapcert.plugin import Array, Interval

from .evidence import Evidence, bounds

_APART = 16  # widths: what stored functions are padded by is a few times what is known of them here
_HARMLESS = 4  # resolutions: what a spread may be of arithmetic alone
AT_REST = ", hidden state at its default"
DRAWN = ", hidden state in equal parts at its default, "


def figures(e: Evidence) -> str:
    """Means over the audit's points, and their ratio, tightness, are as stated, to 1e-9 and what rounding leaves open."""
    return _figures(e, e.audit[1], *e.audited)


def held_figures(e: Evidence) -> str:
    """The same over the transitions of a recording's held windows."""
    return _figures(e, e.arrays["held.r"], *bounds(e, e.arrays["held.z"], "predictor.calibration"))


def _figures(e: Evidence, r: Array, low: Interval, high: Interval) -> str:
    ends, gap = abs(low).maximum(abs(high)), np.abs(r).mean(axis=0)
    # As computed, and padded for rounding, γ may lie some widths of what contains the exact one away: far from 0, over 1e-9.
    least, most = ends.lo - _APART * ends.width, ends.hi + _APART * ends.width
    for i, name in enumerate(e.data["domain"]["axes"][: e.data["domain"]["states"]]):
        s, mean = e.data["states"][name], (float(least[:, i].mean()), float(most[:, i].mean()))
        if s["resolved"] != bool(gap[i] >= 10 * e.rounding[i]) or ("tightness" in s) != s["resolved"]:
            return f"{name}.resolved is stated wrongly"
        pairs = [
            ("gap_mean", (float(gap[i]),) * 2),
            ("gamma_mean", mean),
            ("gamma_max", (float(least[:, i].max()), float(most[:, i].max()))),
        ]
        if s["resolved"]:
            pairs.append(("tightness", (mean[0] / gap[i], mean[1] / gap[i])))
        for key, (at_least, at_most) in pairs:
            if not np.isfinite(at_most):  # any figure is as near to it as another
                return f"{name}.{key} is infinite"
            spare = 1e-9 * abs(at_most) + 1e-300
            if not at_least - spare <= s[key] <= at_most + spare:
                return f"{name}.{key} is stated as {s[key]:.12g} and follows as {at_most:.12g}"
        if s["resolved"] and not s["vacuous"] and not s["gamma_mean"] <= s["constant_bound"] * (1 + 1e-9):
            return f"{name} is vacuous: its mean γ exceeds the constant bound"
    vacuous = any(s["vacuous"] for s in e.data["states"].values())
    return "" if e.data["vacuous"] == vacuous else "vacuous is stated otherwise than for the states"


def hidden(e: Evidence) -> str | None:
    """What e holds beyond arithmetic is the stated bound over hidden states; harmless ones, drawn ones and those left at their
    default are told as the spread says; and γ of the default was attacked.
    """
    spread, slack = e.arrays["resolution"] - e.rounding, 4 * np.spacing(e.arrays["resolution"])
    if not (spread >= 0).all():
        return "arithmetic alone is said to err by more than the resolution"
    if (h := e.data.get("hidden")) is None:
        return "the resolution holds a spread over hidden states, and none is stated" if (spread > slack).any() else None
    states = e.data["domain"]["axes"][: e.data["domain"]["states"]]
    measured, bound = (np.array([h.get(k, {}).get(s, 0.0) for s in states], dtype=np.float64) for k in ("spread", "bound"))
    if h["harmless"] != bool((measured <= _HARMLESS * e.rounding).all()):
        return "whether hidden state is harmless is stated otherwise than its spread says"
    drawn = not h["harmless"] and h["mode"] == "sample"
    if not (np.abs(bound - spread) <= slack).all() or ("bound" in h) != drawn:
        return f"the bound over hidden states is stated as {bound.tolist()}, and the resolution holds {spread.tolist()}"
    if h["harmless"]:
        # Older audits asked about its default alone.
        told = h["distribution"] == "" or (h["distribution"].startswith(DRAWN))
        return "" if told else f"hidden state is harmless, and the distribution says otherwise: {h['distribution']}"
    if drawn:
        return "" if h["distribution"] not in ("", AT_REST) else "hidden state was drawn, and the distribution does not say how"
    if h["mode"] != "default" or h["distribution"] != AT_REST:
        return f"hidden state matters and is not drawn; mode {h['mode']} and distribution '{h['distribution']}' do not say so"
    return _attacked(h["attack"])


def _attacked(a: dict[str, object]) -> str:
    points, violations = a["points"], a["violations"]
    if not (isinstance(points, int) and isinstance(violations, int) and 0 < points >= violations >= 0):
        return f"the attack with other hidden states had {points} points and {violations} violations"
    if a["share"] != violations / points or ("witness" in a) != (violations > 0):
        return "the attack's share or its witness does not fit its violations"
    return ""


def symmetry(e: Evidence) -> str | None:
    """Pairs that differ along each of the declared axes, and along them alone, have the same residual, to 4 e."""
    if (stated := e.data.get("symmetry")) is None:
        return "pairs were looked at for a symmetry that is not stated" if "symmetry" in e.data["digests"] else None
    (z, r), nz = e.round("symmetry"), len(e.zone.low)
    drawn = z.shape[1] == 2 * nz  # then r is the change itself, under a common hidden state
    a, b = (z[:, :nz], z[:, nz:]) if drawn else np.split(z, 2)
    change = np.abs(r if drawn else np.subtract(*np.split(r, 2)))
    others = [j for j in range(nz) if j not in stated["axes"]]
    if len(a) != stated["pairs"] or not (e.zone.contains(a) & e.zone.contains(b)).all():
        return "the pairs are not as many as stated, or not all in Z"
    if (a[:, others] != b[:, others]).any() or any(c.coefficients[j] for c in e.zone.relations for j in stated["axes"]):
        return "the pairs differ along other axes too, or a relation stands in the way of a shift"
    if not (a[:, stated["axes"]] != b[:, stated["axes"]]).any(axis=0).all():
        return "the pairs do not differ along every axis that is stated"
    if stated["names"] != [e.data["domain"]["axes"][j] for j in stated["axes"]]:
        return f"the axes {stated['axes']} are not called {', '.join(stated['names'])}"
    if (change > 4 * (e.rounding if drawn else e.arrays["resolution"])).any():
        return f"the residual changes by {float(change.max()):.3g} where it was declared not to"
    return "" if np.array_equal(change.max(axis=0), stated["deviation"]) else "the largest change of the pairs is another one"


def cells(e: Evidence) -> str | None:
    """How many cells there are, how many of them jump and what share they fill; no jump was seen that J does not allow."""
    stated = e.data["lipschitz"]
    if "cells.L" not in e.arrays:
        return "cells are stated, and none are stored" if "cells" in stated else None
    jumps, low = e.arrays["cells.J"], np.asarray(e.data["domain"]["low"])
    marked, width = np.asarray((jumps > 0).any(axis=1)), np.asarray(e.data["domain"]["high"]) - low
    share = sum(float(np.prod((e.parts[k].box.hi - e.parts[k].box.lo) / width)) for k in np.flatnonzero(marked))
    counts = {"cells": len(jumps), "marked": int(marked.sum())}
    if any(stated[k] != n for k, n in counts.items()) or not abs(stated["marked_share"] - share) <= 1e-9:
        return f"{counts} of a share of {share:.6g} are stored, and others are stated"
    names = e.data["domain"]["axes"]
    over = [j for j in stated["jumps"] if j["size"] * stated["safety"] > jumps[:, names.index(j["state"])].max() * (1 + 1e-9)]
    return f"a jump of {over[0]['state']} by {over[0]['size']:.6g} was seen, and the cells allow less" if over else ""
