"""Mathematics of six-axis arms under the modified (Craig) Denavit-Hartenberg convention.

What computes on one configuration uses plain floats and is imported here. `forward_batch`, which needs numpy, and
`to_urdf` are imported when they are first asked for, so that the process of the loop stays free of both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from kinematics.forward import forward, frames
from kinematics.gravity import gravity_torques
from kinematics.inverse import InverseKinematics
from kinematics.jacobian import jacobian, manipulability, singularity_distances, tool_jacobian
from kinematics.model import ArmModel, DhRow, JointLimit, LinkMass
from kinematics.numeric import NumericResult, solve_numeric
from kinematics.pose import IDENTITY, Pose
from kinematics.solution import Branch, Near, Singularity, Solution, Solutions
from kinematics.velocity import JointVelocity, joint_velocity

if TYPE_CHECKING:
    from kinematics.batch import forward_batch
    from kinematics.urdf import to_urdf

__all__ = [
    "IDENTITY",
    "ArmModel",
    "Branch",
    "DhRow",
    "InverseKinematics",
    "JointLimit",
    "JointVelocity",
    "LinkMass",
    "Near",
    "NumericResult",
    "Pose",
    "Singularity",
    "Solution",
    "Solutions",
    "forward",
    "forward_batch",
    "frames",
    "gravity_torques",
    "jacobian",
    "joint_velocity",
    "manipulability",
    "singularity_distances",
    "solve_numeric",
    "to_urdf",
    "tool_jacobian",
]


def __getattr__(name: str) -> Any:
    if name == "forward_batch":
        from kinematics.batch import forward_batch

        return forward_batch
    if name == "to_urdf":
        from kinematics.urdf import to_urdf

        return to_urdf
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
