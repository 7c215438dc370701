"""Sets of causes with one law in the place of others: a simpler, a richer, a related one, or one for two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert.diagnosis.library import Causes
from gapcert.diagnosis.scores import TIE, Found, keys

if TYPE_CHECKING:
    from gapcert.diagnosis.search import Search

LESS = 8.0  # fall of the squared residual that is not worth a richer law


def idle(search: Search, found: Found, new: Causes) -> bool:
    """Is there a law between one and its richer substitute, and none of these leaves less?"""
    causes, now = found
    (e,), (c, *more) = ([k for k in a if k.key not in keys(b)] for a, b in ((new, causes), (causes, new)))
    between = [k for k in search.library.candidates if search.library.within(c, k) and search.library.within(k, e)]
    fits = [search.known(tuple(k if j is c else j for j in causes)) for k in between]
    least = float(np.sum(now.residual**2)) - LESS
    return bool(fits) and not more and all(f is not None and float(np.sum(f.residual**2)) > least for f in fits)


def swaps(search: Search, found: Found) -> list[tuple[Causes, dict[str, float]]]:
    """Each cause replaced by a law that it contains; by one that contains it, or of its family, where that may pay.

    Where a joint sticks, or remembers, no screen shows what a richer law would change.
    """
    causes, now = found
    n = now.residual.shape[0] * now.residual.shape[1]
    left = float(np.sum(now.whiteness * n * np.log(np.maximum(now.chi, 1.0)))) > 2 * TIE
    out = []
    for c in causes:
        for e in search.library.candidates:
            if e.site != c.site or e.key in keys(causes) or any(search.library.related(e, k) for k in causes if k is not c):
                continue
            certain = search.library.contains(c.effect.name, e.effect.name) or search.library.richer(e, c)
            family = bool(c.effect.family) and c.effect.family == e.effect.family
            kin = family or search.library.contains(e.effect.name, c.effect.name)
            if certain or (kin and (left or ((s := search.promise(found, e)) is not None and s.gain > TIE))):
                new = tuple(e if k is c else k for k in causes)
                out.append((new, search.carried(c, e, found)))
    return out


def merges(search: Search, found: Found) -> list[tuple[Causes, dict[str, float]]]:
    """Two causes at one site as one law that contains the first of them."""
    causes, out = found[0], []
    for a in causes:
        for b in causes:
            for e in search.library.candidates if a is not b and a.site == b.site else ():
                rest = tuple(k for k in causes if k is not a and k is not b)
                if e.site == a.site and a.effect.name in e.effect.contains and e.key not in keys(causes):
                    out.append(((*rest, e), search.carried(a, e, found) | search.carried(b, e, found, default=False)))
    return out
