"""What every physics engine shares: options, the wiring of a spec's names to a robot, hidden state, tiling."""

from gapcert.engine.backend import EngineBackend
from gapcert.engine.config import Drive, EngineConfig
from gapcert.engine.contract import BASE, BASE_EULER, Engine, EngineWorld, Joint

__all__ = ["BASE", "BASE_EULER", "Drive", "Engine", "EngineBackend", "EngineConfig", "EngineWorld", "Joint"]
