"""Declares what this package offers; imports nothing but gapcert."""

from gapcert.plugin import Component, hookimpl


@hookimpl
def gapcert_components() -> list[Component]:
    """The section `closed_loop:`."""
    return [
        Component(
            "study",
            "closed_loop",
            "runs of the controller on the simulator",
            "gapcert_closed_loop.study:ClosedLoopStudy",
            "gapcert_closed_loop.section:ClosedLoopSection",
        )
    ]
