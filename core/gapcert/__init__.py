"""Gapcert: how wrong can a model be, and why? The whole public API, imported on first use."""

from __future__ import annotations

import sys

from gapcert import plugin as plugin
from gapcert.lazy import LazyPackage, homes

# Module: its public names. `__init__.pyi` says the same to type checkers.
_HOME = homes(
    {
        "gapcert.certification.certificate": "Certificate",
        "gapcert.certification.certify": "certify",
        "gapcert.certification.declaration": "Declaration",
        "gapcert.certification.gates.hidden_state": "HiddenPlan",
        "gapcert.certification.routes": "Request",
        "gapcert.certification.samples.designs": "AdaptiveSampling GridSampling LatticeSampling",
        "gapcert.contracts.controllers.control": "Controller StepInfo SynthesisProblem",
        "gapcert.contracts.controllers.goal": "Goal",
        "gapcert.contracts.data.recording": "Recording Trajectory",
        "gapcert.contracts.gaps.claim": "Claim",
        "gapcert.contracts.gaps.gap": "GapFunction",
        "gapcert.contracts.plugins.events": "Event",
        "gapcert.contracts.plugins.component": "Component Context",
        "gapcert.contracts.plugins.registry": "hookimpl registry",
        "gapcert.contracts.systems.domain": "Box Domain",
        "gapcert.contracts.systems.extension": "Parameter",
        "gapcert.contracts.systems.region": "Ellipsoid Polytope Region",
        "gapcert.contracts.systems.system": "Backend Model StateSpec System",
        "gapcert.numerics.arrays": "Array",
        "gapcert.numerics.errors": "GapcertError MissingDependency SpecError Undecided UsageError",
        "gapcert.numerics.intervals": "Interval",
        "gapcert.run.run": "Run run",
        "gapcert.spec.spec": "load_spec",
        "gapcert.version": "__version__",
        "gapcert_calibrate.recording_certificate": "CalibratedRecording calibrate_recording",
        "gapcert_cells.load": "load_controller",
        "gapcert_closed_loop.closed_loop": "ClosedLoop closed_loop",
        "gapcert_diagnosis.diagnose": "diagnose",
        "gapcert_diagnosis.results": "Cause Diagnosis Gain",
        "gapcert_monitor.check": "Certified Check Monitor Observation check read_log",
        "gapcert_recordings.experiment": "play",
    }
)

# Where names are that were here before; they answer for one version more, and say so.
_MOVED = homes(
    {
        "gapcert.plugin": (
            "AffinePredictor Automaton Bools Cells Cover Effect EffectParameter Extension GapFamily GapProblem "
            "Ints LipschitzBound LipschitzEstimator LipschitzProblem Memory ModelPredictor Points "
            "Policy Predictor Pulse Reader Relation Residual Samples Scene Shape Step Synthesizer Trails cells_of compiler "
            "difference follow identity located magnitude majorant majorant_of supremum"
        ),
        "gapcert_bounds": "MultilinearPredictor",
        "gapcert_cells": (
            "Along AutomatonController GridController Splits Successors SuccessorsByLevel automaton_of loading read_hoa "
            "write_saved"
        ),
        "gapcert_engines": (
            "Drive Engine EngineBackend EngineConfig EngineModel EngineWorld Joint Link Motor RobotText as_section "
            "file_shapes muted patched_sdf patched_urdf"
        ),
        "gapcert_figures": (
            "Axis Band Channel CompareFigure DiagnosisFigure GapFigure Lane LoopFigure Motion PairFigure Playback "
            "RecordedFigure Runs WinningFigure"
        ),
        "gapcert_functions": (
            "DominatingGap Expression Factor Function Table Term WeightedSum band dominate mean_value weighted"
        ),
        "gapcert_networks": "LocalBound Network NetworkBound NetworkCertifier Proposal local_bound raised",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
