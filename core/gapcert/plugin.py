"""What authors of plugins find: the contracts, and what is needed to keep them. Imported on first use."""

from __future__ import annotations

import sys

from gapcert.lazy import LazyPackage, homes

_HOME = homes(
    {
        "gapcert.certification.certificate": (
            "Audit Band Certificate Record SavedStatement StateEvidence Statement domain_data figures gap_digest overpowered "
            "saved_digest"
        ),
        "gapcert.certification.certify": "predictor_of",
        "gapcert.certification.compatibility": "unmatched unpaired",
        "gapcert.certification.coordinates": "Coordinates RelativeModel in_words",
        "gapcert.certification.declaration": "Declaration",
        "gapcert.certification.fingerprint": "Fingerprint digest",
        "gapcert.certification.contradiction": "symmetric",
        "gapcert.certification.gates.augment": "forgets widen",
        "gapcert.certification.gates.circle": "repeating",
        "gapcert.certification.gates.hidden_distribution": "Law beginning",
        "gapcert.certification.gates.hidden_state": "Gate open_gate",
        "gapcert.certification.ledger": "Entry Ledger",
        "gapcert.certification.gates.entry": "responses",
        "gapcert.certification.refutation": "Trails follow",
        "gapcert.certification.routes": "Findings Request Route",
        "gapcert.certification.samples.executors": "processes",
        "gapcert.certification.samples.store": "Store",
        "gapcert.certification.supremum": "supremum",
        "gapcert.contracts.controllers.control": "Controller SynthesisProblem Synthesizer",
        "gapcert.contracts.controllers.goal": "MOST Automaton Goal",
        "gapcert.contracts.controllers.policies": "ANYWHERE POLICIES Policy known",
        "gapcert.contracts.data.effect": "Effect EffectParameter position site_units",
        "gapcert.contracts.data.recording": "SHORTEST Hold Reader Recording Trajectory as_numbers first_text seconds",
        "gapcert.contracts.data.units": "magnitude pretty shown stated_units without_units",
        "gapcert.contracts.gaps.claim": "Claim beta_of",
        "gapcert.contracts.gaps.gap": "FitRoute GapFamily GapFunction GapProblem",
        "gapcert.contracts.gaps.lipschitz": ("LipschitzBound LipschitzEstimator LipschitzProblem Provenance Residual Symmetry"),
        "gapcert.contracts.gaps.predictor": "AffinePredictor ModelPredictor Predictor Samples",
        "gapcert.contracts.plugins.events": "BEAT Emit Event Pulse Stages silent",
        "gapcert.contracts.plugins.options": "ConfigContract Keyed of_config",
        "gapcert.contracts.plugins.presentation": "Shown View view",
        "gapcert.contracts.plugins.component": "ALLOW_CODE EXECUTED LOG RUN Answer Argument Arguments Component Context load",
        "gapcert.contracts.plugins.registry": "Registry hookimpl installed registry",
        "gapcert.contracts.systems.arithmetic": "Arithmetic",
        "gapcert.contracts.systems.cells": "Cells",
        "gapcert.contracts.systems.domain": "Box Cover Domain Outside Points turned",
        "gapcert.contracts.systems.extension": "Extension Memory Parameter",
        "gapcert.contracts.systems.region": "Ellipsoid Polytope Region",
        "gapcert.contracts.systems.scene": "GREY Scene Shape at_rest",
        "gapcert.contracts.systems.system": (
            "Backend Capability EngineHints Extendable Model StateSpec Step System Values Variant cross difference rotated "
            "step_seed"
        ),
        "gapcert.lazy": "LazyPackage homes",
        "gapcert.numerics": "circle order_statistics",
        "gapcert.numerics.arrays": "Array Bools Ints",
        "gapcert.numerics.circle": "TURN",
        "gapcert.numerics.atomic_files": "DAMAGE damage_told npz_bytes write_atomic",
        "gapcert.numerics.constraint_zone": "Relation Zone grid_at grid_size lattice",
        "gapcert.numerics.counter_rng": "keys normals uniforms",
        "gapcert.numerics.digest": "identity json_digest located",
        "gapcert.numerics.errors": "GapcertError MissingDependency NoStart SpecError Undecided UsageError clipped harmless",
        "gapcert.numerics.interpolation": "cells cut highest interpolate joined on_curvature ranges rounding slopes worst",
        "gapcert.numerics.intervals": "Interval",
        "gapcert.numerics.kernels": "compiler",
        "gapcert.numerics.majorant": "cells_of majorant majorant_of",
        "gapcert.numerics.order_statistics": "missed",
        "gapcert.numerics.texts": "columns leaves times",
        "gapcert.cli.terminal": "Terminal",
        "gapcert.run.build": "Build",
        "gapcert.run.folder": "LOCK MARK is_run owned stored",
        "gapcert.run.progress_rate": "duration figure",
        "gapcert.run.run": "Outcome Study cpu_seconds",
        "gapcert.run.status": "RunFolder folders walk",
        "gapcert.run.verdict": "beside_nominal nothing_won outside share",
        "gapcert.spec.check": "COMPONENTS",
        "gapcert.spec.compose": "regular",
        "gapcert.spec.expect": "evaluate_expectations",
        "gapcert.spec.models": "near unknown_key validate",
        "gapcert.spec.relations": "backend_axes",
        "gapcert.spec.sections": "sections",
        "gapcert.spec.sections.plugin_sections": "Axes Checker Drawn Schema SpecSection",
        "gapcert.spec.sections.sections": (
            "Bound Boxes Config Count HiddenConfig Name Probability SECTIONS Seconds Section Share Time Whole"
        ),
        "gapcert.spec.source": "At Problem read",
        "gapcert.spec.spec": "load_spec",
        "gapcert.testing.checks": "expect",
        "gapcert.testing.signals": "multisine",
        "gapcert.testing.toys": "PLAIN",
        "gapcert.thresholds": "chosen decides reasons threshold",
        "gapcert.version": "__version__",
    }
)

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
