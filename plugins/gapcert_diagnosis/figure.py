"""What a diagnosis shows, made from its fits: held-out motions, laws, what each cause explained, and what is left."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from gapcert.plugin import Array, Model
from gapcert_figures import Channel, Correlation, Course, DiagnosisFigure, Signal, Waterfall, called

from .data.dataset import Windows
from .fitting.fit import Fit
from .fitting.rollout_error import Stretches
from .residual.law_estimates import Fitted, laws, outputs
from .results import Correction, Experiment
from .search.candidates import Causes

if TYPE_CHECKING:
    from .search.fitted_sets import FittedSets

LAGS, SLOW = 0.5, 24  # s; samples that are looked at where these are far apart
CHANNELS = 4  # whose correlations are drawn


def figure(
    search: FittedSets,
    causes: Causes,
    last: Fit,
    judge: Stretches,
    design: Experiment | None = None,
    correction: Correction | None = None,
    plain: tuple[str, Fit] | None = None,
) -> DiagnosisFigure:
    """`last` is the fit of the causes, in the order listed, over the windows of the search.

    plain: what settings were changed before all of them, and the fit of nothing without that.
    """
    steps = [(causes, last)]
    while rest := steps[0][0]:
        steps.insert(0, (rest[:-1], search.fit(rest[:-1], steps[0])))
    named = [called(*c[-1].key) for c, _ in steps[1:]]
    fits = [f for _, f in steps]
    if plain is not None:
        named, fits = [plain[0], *named], [plain[1], *fits]
    first, windows = fits[0], search.windows
    path = Fitted(search.library, causes, last, windows)
    return DiagnosisFigure(
        _channels(judge, first, last),
        laws(path, correction) + outputs(path),
        Waterfall(("none of the causes", *named), np.array([judge.error(f) for f in fits])) if named else None,
        tuple(_correlations(windows, first, last)),
        tuple(_courses(windows, first, last)),
        () if design is None else _signals(design, search.library.model),
    )


def _channels(judge: Stretches, first: Fit, last: Fit) -> tuple[Channel, ...]:
    """The held-out rollout of the longest horizon whose error before is the median."""
    m, w = judge.windows.measured, judge.windows
    before, after = judge.simulate(first), judge.simulate(last)
    error = np.mean(((before - w.y[:, judge.lead :]) / m.spread) ** 2, axis=(1, 2))
    k = int(np.argsort(error)[len(error) // 2])
    t = w.t[k] + m.period * (judge.lead + np.arange(w.length - judge.lead))
    y = w.y[k, judge.lead :]
    return tuple(Channel(c.name, c.unit, t, y[:, i], before[k, :, i], after[k, :, i]) for i, c in enumerate(m.channels))


def _correlations(windows: Windows, first: Fit, last: Fit) -> list[Correlation]:
    """Per channel the residual's autocorrelation, and its correlation with the input that it follows most."""
    m, model = windows.measured, last.hypothesis.model
    reach = min(max(m.samples(LAGS), SLOW), windows.length // 2)
    band = 1.96 / math.sqrt(last.residual.shape[0] * last.residual.shape[1])
    inputs = windows.u[:, m.history :]
    out = []
    for i, c in enumerate(m.channels[:CHANNELS]):
        old, new = (f.residual[..., i] for f in (first, last))
        lag = m.period * np.arange(1.0, reach + 1)
        own = [correlation(r, r, reach)[reach + 1 :] for r in (old, new)]
        out.append(Correlation(c.name, "itself", lag, own[0], own[1], band))
        both = [(correlation(old, inputs[..., j], reach), correlation(new, inputs[..., j], reach)) for j in range(model.nu)]
        if both:
            j = int(np.argmax([np.abs(before).max() for before, _ in both]))
            lag = m.period * np.arange(-float(reach), reach + 1)
            out.append(Correlation(c.name, model.inputs[j].name, lag, *both[j], band))
    return out


def correlation(a: Array, b: Array, reach: int) -> Array:
    """ρ(k) = Σ a(t + k) b(t)/√(Σ a² Σ b²) of rows (W, L), about their means, for lags −reach … reach."""
    a, b = a - a.mean(), b - b.mean()
    count = 2 * a.shape[1]
    sums = np.fft.irfft(np.sum(np.fft.rfft(a, count, axis=1) * np.fft.rfft(b, count, axis=1).conj(), axis=0), count)
    size = math.sqrt(float(np.sum(a**2) * np.sum(b**2)))
    return np.asarray(np.concatenate([sums[count - reach :], sums[: reach + 1]]) / (size + 1e-300))


def _courses(windows: Windows, first: Fit, last: Fit) -> list[Course]:
    seen = np.sum(windows.weight**2, axis=(1, 2))
    rms = [np.sqrt(np.sum(f.residual**2, axis=(1, 2)) / seen) for f in (first, last)]
    out = []
    for i in np.unique(windows.trajectory):
        rows = np.flatnonzero(windows.trajectory == i)
        rows = rows[np.argsort(windows.t[rows])]
        out.append(Course(windows.t[rows], rms[0][rows], rms[1][rows]))
    return out


def _signals(design: Experiment, model: Model) -> tuple[Signal, ...]:
    units = {s.name: s.unit for s in model.inputs}
    return tuple(Signal(n, units.get(n, "1"), design.t, v) for n, v in design.inputs.items())
