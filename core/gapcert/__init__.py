"""Gapcert: how wrong can a model be, and why? The whole public API, imported on first use."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from gapcert.lazy import LazyPackage

if TYPE_CHECKING:
    from gapcert.arrays import Array as Array
    from gapcert.arrays import Bools as Bools
    from gapcert.arrays import Ints as Ints
    from gapcert.automaton import Automaton as Automaton
    from gapcert.bound import supremum as supremum
    from gapcert.cells import Cells as Cells
    from gapcert.certificate import Certificate as Certificate
    from gapcert.certify import Request as Request
    from gapcert.certify import certify as certify
    from gapcert.check import Certified as Certified
    from gapcert.check import Check as Check
    from gapcert.check import Monitor as Monitor
    from gapcert.check import Observation as Observation
    from gapcert.check import check as check
    from gapcert.check import read_log as read_log
    from gapcert.claim import Claim as Claim
    from gapcert.closed_loop import ClosedLoop as ClosedLoop
    from gapcert.closed_loop import closed_loop as closed_loop
    from gapcert.components import Component as Component
    from gapcert.components import Context as Context
    from gapcert.components import registry as registry
    from gapcert.control import Controller as Controller
    from gapcert.control import StepInfo as StepInfo
    from gapcert.control import SynthesisProblem as SynthesisProblem
    from gapcert.control import Synthesizer as Synthesizer
    from gapcert.controller_files import loading as loading
    from gapcert.controller_files import write_saved as write_saved
    from gapcert.covered import raised as raised
    from gapcert.declared import Declaration as Declaration
    from gapcert.designs import AdaptiveSampling as AdaptiveSampling
    from gapcert.designs import GridSampling as GridSampling
    from gapcert.designs import LatticeSampling as LatticeSampling
    from gapcert.diagnose import diagnose as diagnose
    from gapcert.domain import Box as Box
    from gapcert.domain import Cover as Cover
    from gapcert.domain import Domain as Domain
    from gapcert.domain import Points as Points
    from gapcert.dominating import DominatingGap as DominatingGap
    from gapcert.dominating import band as band
    from gapcert.dominating import dominate as dominate
    from gapcert.effect import Cause as Cause
    from gapcert.effect import Diagnosis as Diagnosis
    from gapcert.effect import Effect as Effect
    from gapcert.effect import EffectParameter as EffectParameter
    from gapcert.effect import Gain as Gain
    from gapcert.engine.backend import EngineBackend as EngineBackend
    from gapcert.engine.config import EngineConfig as EngineConfig
    from gapcert.engine.contract import Engine as Engine
    from gapcert.engine.contract import EngineWorld as EngineWorld
    from gapcert.engine.contract import Joint as Joint
    from gapcert.engine.contract import Motor as Motor
    from gapcert.engine.contract import Thruster as Thruster
    from gapcert.engine.drive import Drive as Drive
    from gapcert.engine.links import Link as Link
    from gapcert.engine.links import as_section as as_section
    from gapcert.engine.muted import muted as muted
    from gapcert.engine.natives import patched_sdf as patched_sdf
    from gapcert.engine.natives import patched_urdf as patched_urdf
    from gapcert.engine.patch import RobotText as RobotText
    from gapcert.engine.shapes import file_shapes as file_shapes
    from gapcert.engine.simulation import EngineModel as EngineModel
    from gapcert.errors import GapcertError as GapcertError
    from gapcert.errors import MissingDependency as MissingDependency
    from gapcert.errors import SpecError as SpecError
    from gapcert.errors import Undecided as Undecided
    from gapcert.errors import UsageError as UsageError
    from gapcert.events import Event as Event
    from gapcert.events import Pulse as Pulse
    from gapcert.expression import Expression as Expression
    from gapcert.extension import Extension as Extension
    from gapcert.extension import Memory as Memory
    from gapcert.extension import Parameter as Parameter
    from gapcert.figures import Axis as Axis
    from gapcert.figures import Band as Band
    from gapcert.figures import Channel as Channel
    from gapcert.figures import CompareFigure as CompareFigure
    from gapcert.figures import DiagnosisFigure as DiagnosisFigure
    from gapcert.figures import GapFigure as GapFigure
    from gapcert.figures import Lane as Lane
    from gapcert.figures import LoopFigure as LoopFigure
    from gapcert.figures import PairFigure as PairFigure
    from gapcert.figures import Runs as Runs
    from gapcert.figures import WinningFigure as WinningFigure
    from gapcert.functions import Function as Function
    from gapcert.functions import mean_value as mean_value
    from gapcert.gap import AffinePredictor as AffinePredictor
    from gapcert.gap import GapFamily as GapFamily
    from gapcert.gap import GapFunction as GapFunction
    from gapcert.gap import GapProblem as GapProblem
    from gapcert.gap import ModelPredictor as ModelPredictor
    from gapcert.gap import Predictor as Predictor
    from gapcert.gap import Samples as Samples
    from gapcert.gates import HiddenPlan as HiddenPlan
    from gapcert.goal import Goal as Goal
    from gapcert.grid_control import GridController as GridController
    from gapcert.growth import Trails as Trails
    from gapcert.growth import follow as follow
    from gapcert.hoa import read_hoa as read_hoa
    from gapcert.hooks import hookimpl as hookimpl
    from gapcert.identities import identity as identity
    from gapcert.identities import located as located
    from gapcert.intervals import Interval as Interval
    from gapcert.kernels import compiler as compiler
    from gapcert.layers import Network as Network
    from gapcert.lifting import Table as Table
    from gapcert.lipschitz import LipschitzBound as LipschitzBound
    from gapcert.lipschitz import LipschitzEstimator as LipschitzEstimator
    from gapcert.lipschitz import LipschitzProblem as LipschitzProblem
    from gapcert.lipschitz import Residual as Residual
    from gapcert.ltl import automaton_of as automaton_of
    from gapcert.majorant import cells_of as cells_of
    from gapcert.majorant import majorant as majorant
    from gapcert.majorant import majorant_of as majorant_of
    from gapcert.memory_control import AutomatonController as AutomatonController
    from gapcert.multilinear import MultilinearPredictor as MultilinearPredictor
    from gapcert.network import NetworkBound as NetworkBound
    from gapcert.network import NetworkCertifier as NetworkCertifier
    from gapcert.network import Proposal as Proposal
    from gapcert.network_local import LocalBound as LocalBound
    from gapcert.network_local import local_bound as local_bound
    from gapcert.play import play as play
    from gapcert.playback import Motion as Motion
    from gapcert.playback import Playback as Playback
    from gapcert.policies import Policy as Policy
    from gapcert.products import Factor as Factor
    from gapcert.products import Term as Term
    from gapcert.recorded import CalibratedRecording as CalibratedRecording
    from gapcert.recorded import calibrate_recording as calibrate_recording
    from gapcert.recorded_figure import RecordedFigure as RecordedFigure
    from gapcert.recording import Reader as Reader
    from gapcert.recording import Recording as Recording
    from gapcert.recording import Trajectory as Trajectory
    from gapcert.region import Ellipsoid as Ellipsoid
    from gapcert.region import Polytope as Polytope
    from gapcert.region import Region as Region
    from gapcert.relation import Relation as Relation
    from gapcert.run import Run as Run
    from gapcert.run import run as run
    from gapcert.saved_control import load_controller as load_controller
    from gapcert.scene import Scene as Scene
    from gapcert.scene import Shape as Shape
    from gapcert.spec import load_spec as load_spec
    from gapcert.spec.units import magnitude as magnitude
    from gapcert.splits import Splits as Splits
    from gapcert.splits import SuccessorsByLevel as SuccessorsByLevel
    from gapcert.successors import Along as Along
    from gapcert.successors import Successors as Successors
    from gapcert.sums import WeightedSum as WeightedSum
    from gapcert.sums import weighted as weighted
    from gapcert.system import Backend as Backend
    from gapcert.system import Model as Model
    from gapcert.system import StateSpec as StateSpec
    from gapcert.system import Step as Step
    from gapcert.system import System as System
    from gapcert.system import difference as difference
    from gapcert.version import __version__ as __version__

# One name per line: where each public name lives. A test keeps this table and the imports above equal.
_HOME = {
    "AdaptiveSampling": "designs",
    "AffinePredictor": "gap",
    "Along": "successors",
    "Array": "arrays",
    "Automaton": "automaton",
    "AutomatonController": "memory_control",
    "Axis": "figures",
    "Backend": "system",
    "Band": "figures",
    "Bools": "arrays",
    "Box": "domain",
    "CalibratedRecording": "recorded",
    "Cause": "effect",
    "Cells": "cells",
    "Certificate": "certificate",
    "Certified": "check",
    "Channel": "figures",
    "Check": "check",
    "Claim": "claim",
    "ClosedLoop": "closed_loop",
    "CompareFigure": "figures",
    "Component": "components",
    "Context": "components",
    "Controller": "control",
    "Cover": "domain",
    "Declaration": "declared",
    "Diagnosis": "effect",
    "DiagnosisFigure": "figures",
    "Domain": "domain",
    "DominatingGap": "dominating",
    "Drive": "engine.drive",
    "Effect": "effect",
    "EffectParameter": "effect",
    "Ellipsoid": "region",
    "Engine": "engine.contract",
    "EngineBackend": "engine.backend",
    "EngineConfig": "engine.config",
    "EngineModel": "engine.simulation",
    "EngineWorld": "engine.contract",
    "Event": "events",
    "Expression": "expression",
    "Extension": "extension",
    "Factor": "products",
    "Function": "functions",
    "Gain": "effect",
    "GapFamily": "gap",
    "GapFigure": "figures",
    "GapFunction": "gap",
    "GapProblem": "gap",
    "GapcertError": "errors",
    "Goal": "goal",
    "GridController": "grid_control",
    "GridSampling": "designs",
    "HiddenPlan": "gates",
    "Interval": "intervals",
    "Ints": "arrays",
    "Joint": "engine.contract",
    "Lane": "figures",
    "LatticeSampling": "designs",
    "Link": "engine.links",
    "LipschitzBound": "lipschitz",
    "LipschitzEstimator": "lipschitz",
    "LipschitzProblem": "lipschitz",
    "LocalBound": "network_local",
    "LoopFigure": "figures",
    "Memory": "extension",
    "MissingDependency": "errors",
    "Model": "system",
    "ModelPredictor": "gap",
    "Monitor": "check",
    "Motion": "playback",
    "Motor": "engine.contract",
    "MultilinearPredictor": "multilinear",
    "Network": "layers",
    "NetworkBound": "network",
    "NetworkCertifier": "network",
    "Observation": "check",
    "PairFigure": "figures",
    "Parameter": "extension",
    "Playback": "playback",
    "Points": "domain",
    "Policy": "policies",
    "Polytope": "region",
    "Predictor": "gap",
    "Proposal": "network",
    "Pulse": "events",
    "Reader": "recording",
    "RecordedFigure": "recorded_figure",
    "Recording": "recording",
    "Region": "region",
    "Relation": "relation",
    "Request": "certify",
    "Residual": "lipschitz",
    "RobotText": "engine.patch",
    "Run": "run",
    "Runs": "figures",
    "Samples": "gap",
    "Scene": "scene",
    "Shape": "scene",
    "SpecError": "errors",
    "Splits": "splits",
    "StateSpec": "system",
    "Step": "system",
    "StepInfo": "control",
    "Successors": "successors",
    "SuccessorsByLevel": "splits",
    "SynthesisProblem": "control",
    "Synthesizer": "control",
    "System": "system",
    "Table": "lifting",
    "Term": "products",
    "Thruster": "engine.contract",
    "Trails": "growth",
    "Trajectory": "recording",
    "Undecided": "errors",
    "UsageError": "errors",
    "WeightedSum": "sums",
    "WinningFigure": "figures",
    "__version__": "version",
    "as_section": "engine.links",
    "automaton_of": "ltl",
    "band": "dominating",
    "calibrate_recording": "recorded",
    "cells_of": "majorant",
    "certify": "certify",
    "check": "check",
    "closed_loop": "closed_loop",
    "compiler": "kernels",
    "diagnose": "diagnose",
    "difference": "system",
    "dominate": "dominating",
    "file_shapes": "engine.shapes",
    "follow": "growth",
    "hookimpl": "hooks",
    "identity": "identities",
    "load_controller": "saved_control",
    "load_spec": "spec",
    "loading": "controller_files",
    "local_bound": "network_local",
    "located": "identities",
    "magnitude": "spec.units",
    "majorant": "majorant",
    "majorant_of": "majorant",
    "mean_value": "functions",
    "muted": "engine.muted",
    "patched_sdf": "engine.natives",
    "patched_urdf": "engine.natives",
    "play": "play",
    "raised": "covered",
    "read_hoa": "hoa",
    "read_log": "check",
    "registry": "components",
    "run": "run",
    "supremum": "bound",
    "weighted": "sums",
    "write_saved": "controller_files",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
