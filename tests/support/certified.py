"""A certificate of smooth waves against nothing, under their true constants, saved where a test wants it."""

from gapcert.certification.certify import certify
from gapcert_bounds.constants.declared_constants import Declared
from gapcert_bounds.testing.fields import Nothing, Waves


def certified_waves(folder, family, sampling, route=None):
    """Two states and one input; the run is saved in `folder`."""
    field = Waves.smooth()
    names = [a.name for a in field.domain.axes]
    values = {n: dict(zip(names, row, strict=True)) for n, row in zip(names, field.constants.tolist(), strict=False)}
    options = {"sampling": sampling, "lipschitz": Declared(values), "family": family, "route": route, "folder": folder}
    made = certify(Nothing(field), field, field.domain, **options)
    made.save(folder)
    return made
