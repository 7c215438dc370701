"""Declares what this package offers; imports nothing but gapcert."""

import gapcert

HOMES = {
    "friction": {
        "viscous-friction": "a force against the motion, proportional to speed",
        "asymmetric-viscous-friction": "a force against the motion, proportional to speed, with a factor for each direction",
        "quadratic-drag": "a force against the motion, proportional to speed squared",
        "coulomb-friction": "dry friction: constant against the motion, and sticking at rest",
        "asymmetric-coulomb-friction": "dry friction that is stronger in one direction than in the other",
        "stribeck-friction": "dry friction that is stronger near rest, and falls to its level at higher speed",
        "load-dependent-friction": "dry friction in proportion to the force that the drive transmits",
        "dahl-friction": "dry friction with bristles that bend like a spring before they slide",
        "lugre-friction": "bristles that bend before they slide, and that slide with less friction at higher speed",
    },
    "forces": {
        "constant-force": "a force that never changes",
        "gravity-tilt": "a base that does not stand level",
        "payload": "a mass that is carried at a point, and that the model does not know",
        "linear-spring": "a force towards zero, proportional to the distance",
        "cubic-spring": "a spring that stiffens with the third power of the distance",
        "joint-coupling": "a force in proportion to the speed of the neighbouring coordinate",
        "cogging": "a force that repeats itself along the way",
        "backlash": "play between the drive and the coordinate",
        "wheel-slip": "a driving force that the ground takes only up to its traction",
        "side-slip": "a base on wheels that moves sideways in turns",
        "external-push": "one push from outside",
    },
    "gear": {
        "gear-play": "play in the angle between a motor and what it drives, of which the log shows one",
    },
    "parameters": {
        "parameter": "a parameter of the model whose stated value is wrong by more than its tolerance",
        "contact-friction": "friction between bodies that touch, stronger or weaker than the engine has it",
        "contact-restitution": "bodies that bounce off each other more or less than the engine has it",
    },
    "inputs": {
        "input-gain": "an input that acts stronger or weaker than it says",
        "input-offset": "an input that acts as if something were always added to it",
        "input-dead-zone": "an input that must exceed a threshold before it acts",
        "input-saturation": "an input that is cut off at a level",
        "input-nonlinearity": "an input whose levels act by a curve instead of a straight line",
        "input-hysteresis": "an input that is followed with play, from above otherwise than from below",
        "input-delay": "an input that acts late",
        "input-lag": "an input that acts through a first-order lag",
        "input-rate-limit": "an input that changes only so fast",
        "input-rate-limited-lag": "an input that acts through a first-order lag whose rate is limited",
        "supply-sag": "an input that grows weaker the longer and harder it has acted",
    },
    "outputs": {
        "sensor-bias": "a sensor whose zero is wrong",
        "sensor-scale": "a sensor that shows too much or too little",
        "sensor-delay": "a sensor that shows the past",
        "sensor-lag": "a sensor that follows what it measures through a first-order lag",
        "sensor-quantisation": "a sensor that shows only multiples of its resolution",
    },
}
SENTENCES = {name: summary for effects in HOMES.values() for name, summary in effects.items()}


@gapcert.hookimpl
def gapcert_components() -> list[gapcert.Component]:
    return [
        gapcert.Component("effect", name, summary, f"gapcert_effects.{home}:{name.title().replace('-', '')}")
        for home, effects in HOMES.items()
        for name, summary in effects.items()
    ]
