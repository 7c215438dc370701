"""A calibrated certificate of a model that drifts, beside a backend with a ripple."""

import gapcert as gc
from gapcert.certification.routes import Request
from gapcert.testing.toys import Drift, Perturbed, ripple
from gapcert_calibrate.stochastic_backend import Stochastic

UNIFORM = "uniform on X × U"
RANGES = {"x0": (-1.0, 1.0), "u0": (-2.0, 2.0)}
ASKED = Request("statistical", 1e-2, 1e-3)
TOO_SMALL, TOO_LARGE = 0.1, 3.0


def declared(factor):
    return gc.registry().get("lipschitz", "declared").load()(values={"x0": {"x0": 0.03 * factor, "u0": 0.08 * factor}})


def family(name, **options):
    return gc.registry().get("gap_family", name).load()(**options)


def calibrated(folder, backend=None, **options):
    model = Drift(1)
    options = {
        "family": family("envelope"),
        "lipschitz": declared(TOO_SMALL),
        "request": ASKED,
        "route": "calibrate",
        **options,
    }
    backend = Perturbed(model, ripple) if backend is None else backend
    c = gc.certify(model, backend, gc.Domain.of(model, RANGES), folder=folder / "run", **options)
    c.save(folder / "run")
    return c


def noisy():
    return Stochastic(Perturbed(Drift(1), ripple), noise={"x0": 0.02})
