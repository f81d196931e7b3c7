"""A rod that two arms hold: its equilibria, paths between them, its set shape, and the motion that bends it."""

from rtcp.processes.rod.bending import BendingPlan, Chuck, plan_bending, plan_motion
from rtcp.processes.rod.continuation import Form, bend, follow_parameters, follow_pose, pre_bend, sample_equilibrium
from rtcp.processes.rod.set_shape import Kinetics, Release, relax, release, set_fraction
from rtcp.processes.rod.statics import Equilibrium, Rod, integrate, shoot

__all__ = [
    "BendingPlan",
    "Chuck",
    "Equilibrium",
    "Form",
    "Kinetics",
    "Release",
    "Rod",
    "bend",
    "follow_parameters",
    "follow_pose",
    "integrate",
    "plan_bending",
    "plan_motion",
    "pre_bend",
    "relax",
    "release",
    "sample_equilibrium",
    "set_fraction",
    "shoot",
]
