"""What this package offers."""

import gapcert as gc


@gc.hookimpl
def gapcert_components():
    return [
        gc.Component(
            "backend", "shuttle", "a driven carriage with a loose block in its slot", "gapcert_shuttle.backend:ShuttleBackend"
        )
    ]
