"""Kinematics of six-joint arms in the modified (Craig) Denavit-Hartenberg convention.

Functions for one configuration use plain floats. Importing this package loads neither numpy, which `forward_batch`
imports when it is called, nor the XML of `to_urdf`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import kinematics.compiled  # noqa: F401  first: it decides whether the others are imported compiled
from kinematics.capsules import Placed, capsules, distance, self_pairs
from kinematics.damped_least_squares import NumericResult, solve_numeric
from kinematics.forward import forward, forward_batch, frames, twist_batch
from kinematics.gravity import gravity_torques
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import JointVelocity, jacobian, joint_velocity, manipulability, singularity_distances
from kinematics.model import ArmModel, Capsule, DhRow, JointLimit, LinkMass
from kinematics.pose import IDENTITY, Pose
from kinematics.solution import Branch, Near, Singularity, Solution, Solutions

if TYPE_CHECKING:
    from kinematics.urdf import to_urdf

__all__ = [
    "IDENTITY",
    "ArmModel",
    "Branch",
    "Capsule",
    "DhRow",
    "InverseKinematics",
    "JointLimit",
    "JointVelocity",
    "LinkMass",
    "Near",
    "NumericResult",
    "Placed",
    "Pose",
    "Singularity",
    "Solution",
    "Solutions",
    "capsules",
    "distance",
    "forward",
    "forward_batch",
    "frames",
    "gravity_torques",
    "jacobian",
    "joint_velocity",
    "manipulability",
    "self_pairs",
    "singularity_distances",
    "solve_numeric",
    "to_urdf",
    "twist_batch",
]


def __getattr__(name: str) -> Any:
    if name == "to_urdf":
        from kinematics.urdf import to_urdf

        return to_urdf
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
