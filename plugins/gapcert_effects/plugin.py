"""Declares what this package offers; imports nothing but gapcert."""

import gapcert

NAMES = {
    "viscous-friction": "a force against the motion, proportional to speed",
    "coulomb-friction": "dry friction: constant against the motion, and sticking at rest",
    "quadratic-drag": "a force against the motion, proportional to speed squared",
    "constant-force": "a force that never changes",
    "input-gain": "an input that acts stronger or weaker than it says",
    "input-delay": "an input that acts late",
}


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component("effect", name, summary, f"gapcert_effects.laws:{name.title().replace('-', '')}")
        for name, summary in NAMES.items()
    ]
