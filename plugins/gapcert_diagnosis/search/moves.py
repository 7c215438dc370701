"""Sets that differ from a found one by a law in the place of another: of one that it contains, of its family, or of two."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gapcert_diagnosis.fitting.fit import promising

from .candidates import Candidate, Causes
from .criterion import TIE, Found, keys, noise, values

if TYPE_CHECKING:
    from .stepwise import Search

ASTRAY = 1.1  # times the squared residual, from which the first values of a law lead nowhere
LESS = 8.0  # fall of the squared residual that is not worth a richer law

Option = tuple[Causes, dict[str, float]]


def idle(search: Search, found: Found, new: Causes) -> bool:
    """Is there a law between one and its richer substitute, and none of these leaves less?

    Or is noise left, and the substitute remembers, which takes long to fit, and leaves plainly more wherever it would begin?
    """
    causes, now = found
    gone, come = ([c for c in one if c.key not in keys(other)] for one, other in ((causes, new), (new, causes)))
    if not len(gone) == len(come) == 1:
        return False
    if noise(now) and search.library.extension(come[0]).memory and _astray(search, found, gone[0], come[0], new):
        return True
    between = [k for k in search.library.candidates if search.library.within(gone[0], k) and search.library.within(k, come[0])]
    fits = [search.known(tuple(k if j is gone[0] else j for j in causes)) for k in between]
    least = float(np.sum(now.residual**2)) - LESS
    return bool(fits) and all(f is not None and float(np.sum(f.residual**2)) > least for f in fits)


def _astray(search: Search, found: Found, old: Candidate, come: Candidate, new: Causes) -> bool:
    """Do all first values of a law leave plainly more than what it would take the place of?"""
    h, names, starts = search.library.hypothesis(new), search.library.names(come), search.library.starts(come)
    known = dict(zip(h.names, h.value.tolist(), strict=True)) | values(found[1])
    same = search.carried(old, come, found, default=False)
    rows = [known | dict(zip(names, row, strict=True)) | same for row in starts.tolist()]
    thetas = np.array([[row[n] for n in h.names] for row in rows])
    return promising(h, search.windows, thetas, found[1].start)[2] > ASTRAY * float(np.sum(found[1].residual ** 2))


def swaps(search: Search, found: Found) -> list[Option]:
    """Each cause replaced by a law that it contains; by one that contains it, or of its family, where that may pay.

    Where a joint sticks, or remembers, no screen shows what a richer law would change. Where samples cannot be counted, a law
    is also replaced at all its sites at once: windows that agree on all of them may hesitate about each.
    """
    library, (causes, now) = search.library, found
    n = now.residual.shape[0] * now.residual.shape[1]
    left = float(np.sum(now.whiteness * n * np.log(np.maximum(now.chi, 1.0)))) > 2 * TIE
    out: dict[frozenset[tuple[str, str]], Option] = {}
    for c in causes:
        for e in library.candidates:
            if e.site != c.site or e.key in keys(causes) or any(library.related(e, k) for k in causes if k is not c):
                continue
            certain = library.contains(c.effect.name, e.effect.name) or library.richer(e, c)
            family = bool(c.effect.family) and c.effect.family == e.effect.family
            kin = family or library.contains(e.effect.name, c.effect.name)
            if certain or (kin and (left or ((s := search.promise(found, e)) is not None and s.gain > TIE))):
                places: list[Causes] = [(c,)]
                if certain and len(alike := _alike(search, causes, c)) > 1:
                    places.append(alike)
                for where in places:
                    new, start = _swapped(search, found, where, e)
                    out.setdefault(keys(new), (new, start))
    return list(out.values())


def spared(search: Search, causes: Causes, new: Causes) -> bool:
    """Does a simpler law take one of several sites from a law that is judged at all of them at once?"""
    gone, come = ([c for c in one if c.key not in keys(other)] for one, other in ((causes, new), (new, causes)))
    if not len(gone) == len(come) == 1 or len(_alike(search, causes, gone[0])) == 1:
        return False
    return search.library.contains(gone[0].effect.name, come[0].effect.name)


def _alike(search: Search, causes: Causes, c: Candidate) -> Causes:
    """Causes that are judged with c: where samples cannot be counted, the same law at other sites."""
    return tuple(k for k in causes if k is c or (search.cautious and k.effect.name == c.effect.name))


def _swapped(search: Search, found: Found, where: Causes, e: Candidate) -> Option:
    """With the law of e in the place of these causes, where it can act there."""
    rest = [k for k in found[0] if k not in where]
    at = {k.site: k for k in search.library.candidates if k.effect.name == e.effect.name}
    at = {site: new for site, new in at.items() if not any(search.library.related(new, k) for k in rest)}
    start: dict[str, float] = {}
    for k in where:
        start |= search.carried(k, at[k.site], found) if k.site in at else {}
    return tuple(at.get(k.site, k) if k in where else k for k in found[0]), start


def merges(search: Search, found: Found) -> list[Option]:
    """Two causes at one site as one law that contains the first of them."""
    causes, out = found[0], []
    for a in causes:
        for b in causes:
            for e in search.library.candidates if a is not b and a.site == b.site else ():
                rest = tuple(k for k in causes if k is not a and k is not b)
                if e.site == a.site and a.effect.name in e.effect.contains and e.key not in keys(causes):
                    out.append(((*rest, e), search.carried(a, e, found) | search.carried(b, e, found, default=False)))
    return out
