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
    from gapcert.routes import Request as Request
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
    "AdaptiveSampling": "gapcert.designs",
    "AffinePredictor": "gapcert.gap",
    "Along": "gapcert.successors",
    "Array": "gapcert.arrays",
    "Automaton": "gapcert.automaton",
    "AutomatonController": "gapcert.memory_control",
    "Axis": "gapcert.figures",
    "Backend": "gapcert.system",
    "Band": "gapcert.figures",
    "Bools": "gapcert.arrays",
    "Box": "gapcert.domain",
    "CalibratedRecording": "gapcert.recorded",
    "Cause": "gapcert.effect",
    "Cells": "gapcert.cells",
    "Certificate": "gapcert.certificate",
    "Certified": "gapcert.check",
    "Channel": "gapcert.figures",
    "Check": "gapcert.check",
    "Claim": "gapcert.claim",
    "ClosedLoop": "gapcert.closed_loop",
    "CompareFigure": "gapcert.figures",
    "Component": "gapcert.components",
    "Context": "gapcert.components",
    "Controller": "gapcert.control",
    "Cover": "gapcert.domain",
    "Declaration": "gapcert.declared",
    "Diagnosis": "gapcert.effect",
    "DiagnosisFigure": "gapcert.figures",
    "Domain": "gapcert.domain",
    "DominatingGap": "gapcert.dominating",
    "Drive": "gapcert.engine.drive",
    "Effect": "gapcert.effect",
    "EffectParameter": "gapcert.effect",
    "Ellipsoid": "gapcert.region",
    "Engine": "gapcert.engine.contract",
    "EngineBackend": "gapcert.engine.backend",
    "EngineConfig": "gapcert.engine.config",
    "EngineModel": "gapcert.engine.simulation",
    "EngineWorld": "gapcert.engine.contract",
    "Event": "gapcert.events",
    "Expression": "gapcert.expression",
    "Extension": "gapcert.extension",
    "Factor": "gapcert.products",
    "Function": "gapcert.functions",
    "Gain": "gapcert.effect",
    "GapFamily": "gapcert.gap",
    "GapFigure": "gapcert.figures",
    "GapFunction": "gapcert.gap",
    "GapProblem": "gapcert.gap",
    "GapcertError": "gapcert.errors",
    "Goal": "gapcert.goal",
    "GridController": "gapcert.grid_control",
    "GridSampling": "gapcert.designs",
    "HiddenPlan": "gapcert.gates",
    "Interval": "gapcert.intervals",
    "Ints": "gapcert.arrays",
    "Joint": "gapcert.engine.contract",
    "Lane": "gapcert.figures",
    "LatticeSampling": "gapcert.designs",
    "Link": "gapcert.engine.links",
    "LipschitzBound": "gapcert.lipschitz",
    "LipschitzEstimator": "gapcert.lipschitz",
    "LipschitzProblem": "gapcert.lipschitz",
    "LocalBound": "gapcert.network_local",
    "LoopFigure": "gapcert.figures",
    "Memory": "gapcert.extension",
    "MissingDependency": "gapcert.errors",
    "Model": "gapcert.system",
    "ModelPredictor": "gapcert.gap",
    "Monitor": "gapcert.check",
    "Motion": "gapcert.playback",
    "Motor": "gapcert.engine.contract",
    "MultilinearPredictor": "gapcert.multilinear",
    "Network": "gapcert.layers",
    "NetworkBound": "gapcert.network",
    "NetworkCertifier": "gapcert.network",
    "Observation": "gapcert.check",
    "PairFigure": "gapcert.figures",
    "Parameter": "gapcert.extension",
    "Playback": "gapcert.playback",
    "Points": "gapcert.domain",
    "Policy": "gapcert.policies",
    "Polytope": "gapcert.region",
    "Predictor": "gapcert.gap",
    "Proposal": "gapcert.network",
    "Pulse": "gapcert.events",
    "Reader": "gapcert.recording",
    "RecordedFigure": "gapcert.recorded_figure",
    "Recording": "gapcert.recording",
    "Region": "gapcert.region",
    "Relation": "gapcert.relation",
    "Request": "gapcert.routes",
    "Residual": "gapcert.lipschitz",
    "RobotText": "gapcert.engine.patch",
    "Run": "gapcert.run",
    "Runs": "gapcert.figures",
    "Samples": "gapcert.gap",
    "Scene": "gapcert.scene",
    "Shape": "gapcert.scene",
    "SpecError": "gapcert.errors",
    "Splits": "gapcert.splits",
    "StateSpec": "gapcert.system",
    "Step": "gapcert.system",
    "StepInfo": "gapcert.control",
    "Successors": "gapcert.successors",
    "SuccessorsByLevel": "gapcert.splits",
    "SynthesisProblem": "gapcert.control",
    "Synthesizer": "gapcert.control",
    "System": "gapcert.system",
    "Table": "gapcert.lifting",
    "Term": "gapcert.products",
    "Thruster": "gapcert.engine.contract",
    "Trails": "gapcert.growth",
    "Trajectory": "gapcert.recording",
    "Undecided": "gapcert.errors",
    "UsageError": "gapcert.errors",
    "WeightedSum": "gapcert.sums",
    "WinningFigure": "gapcert.figures",
    "__version__": "gapcert.version",
    "as_section": "gapcert.engine.links",
    "automaton_of": "gapcert.ltl",
    "band": "gapcert.dominating",
    "calibrate_recording": "gapcert.recorded",
    "cells_of": "gapcert.majorant",
    "certify": "gapcert.certify",
    "check": "gapcert.check",
    "closed_loop": "gapcert.closed_loop",
    "compiler": "gapcert.kernels",
    "diagnose": "gapcert.diagnose",
    "difference": "gapcert.system",
    "dominate": "gapcert.dominating",
    "file_shapes": "gapcert.engine.shapes",
    "follow": "gapcert.growth",
    "hookimpl": "gapcert.hooks",
    "identity": "gapcert.identities",
    "load_controller": "gapcert.saved_control",
    "load_spec": "gapcert.spec",
    "loading": "gapcert.controller_files",
    "local_bound": "gapcert.network_local",
    "located": "gapcert.identities",
    "magnitude": "gapcert.spec.units",
    "majorant": "gapcert.majorant",
    "majorant_of": "gapcert.majorant",
    "mean_value": "gapcert.functions",
    "muted": "gapcert.engine.muted",
    "patched_sdf": "gapcert.engine.natives",
    "patched_urdf": "gapcert.engine.natives",
    "play": "gapcert.play",
    "raised": "gapcert.covered",
    "read_hoa": "gapcert.hoa",
    "read_log": "gapcert.check",
    "registry": "gapcert.components",
    "run": "gapcert.run",
    "supremum": "gapcert.bound",
    "weighted": "gapcert.sums",
    "write_saved": "gapcert.controller_files",
}

__all__ = sorted(_HOME)
sys.modules[__name__].__class__ = LazyPackage
