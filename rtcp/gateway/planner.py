"""Plans made in the gateway's process: a motion is looked at whole, and refused with a sentence, before it begins."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

from kinematics.forward import frames
from kinematics.inverse import InverseKinematics
from kinematics.model import ArmModel, JointLimit
from kinematics.pose import Pose
from rtcp.config.model import ArmConfig, ConfigError, Point, Stop
from rtcp.gateway.carrier import CommandFailed
from rtcp.motion.guards.zones import Zones
from rtcp.motion.limits import Limits
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.plan import Plan, PlanRefused
from rtcp.motion.planning.trajectories import plan_trajectory

POSE_NUMBERS = 6
_MOST_M, _MOST_RAD = 100.0, 100.0
"""Further away is no arm; of larger angles the turns that are left over would be noise of the number."""


class Planner:
    """Makes plans for one arm under the limits that are in force.

    Args:
        config: the arm.
        limits: as they are now; changed elsewhere.

    Every method raises CommandFailed: `refused` for what this arm cannot do, `invalid` for what no arm could.
    """

    def __init__(self, config: ArmConfig, limits: Limits) -> None:
        self._config = config
        self.limits = limits
        """In force now."""
        self._zones = None if config.arm is None else Zones(config.arm, limits)

    def _model(self) -> ArmModel:
        """Return the geometry with the limits in force."""
        arm = self._config.arm
        if arm is None:
            sentence = f"the arm's geometry is not known: the key kinematics is missing in {self._config.source}"
            raise CommandFailed("refused", sentence)
        limits = zip(self.limits.low, self.limits.high, self.limits.velocity, strict=True)
        return dataclasses.replace(arm, limits=tuple(JointLimit(*three) for three in limits))

    def _zone_at(self, q: Sequence[float]) -> str | None:
        if self._zones is None or self._config.arm is None:
            return None
        distance, box = self._zones.distance(frames(self._config.arm, q))
        if distance >= 0.0:
            return None
        boxes = self._config.cartesian.keep_out
        return f"the keep-out box {boxes[box].name}" if 0 <= box < len(boxes) else "the space outside the Cartesian box"

    def joints_at(self, pose: Sequence[float], q_now: Sequence[float]) -> list[float]:
        """Return the joint positions, rad, nearest to `q_now` that bring the tool to `pose` (m, rad)."""
        _require_pose(pose, "the pose")
        found = InverseKinematics(self._model()).solve_near(Pose.from_xyzrpy(*pose), q_now)
        if found.q is None:
            raise CommandFailed("refused", f"the pose cannot be reached: {found.reason}")
        if box := self._zone_at(found.q):
            raise CommandFailed("refused", f"the pose cannot be reached: the arm would be in {box}")
        return list(found.q)

    def lines(self, stops: Sequence[Stop], q_now: Sequence[float], speed: float | None) -> Plan:
        """Return the plan of straight lines from `q_now` to each stop in turn."""
        for number, stop in enumerate(stops, 1):
            if stop.pose is not None:
                _require_pose(stop.pose, f"pose {number}")
        model = self._model()
        try:
            return plan_lines(
                model, self.limits, self._config.cartesian, q_now, stops, speed=speed, zone_at=self._zone_at
            )
        except PlanRefused as refused:
            raise CommandFailed("refused", str(refused)) from None

    def trajectory(self, points: Sequence[Point], q_now: Sequence[float]) -> Plan:
        """Return the plan of a trajectory that begins at `q_now`."""
        names = [joint.name for joint in self._config.joints]
        try:
            return plan_trajectory(points, self.limits, q_now, names=names, zone_at=self._zone_at)
        except PlanRefused as refused:
            raise CommandFailed("refused", str(refused)) from None

    def read(self, path: str) -> tuple[tuple[Point, ...], tuple[Stop, ...], float | None]:
        """Return trajectory, path and speed of a motion file."""
        from rtcp.config.motion_file import read_motion

        if not Path(path).is_absolute():
            raise CommandFailed("invalid", f"file: found {path!r}, allowed is an absolute path")
        try:
            motion = read_motion(Path(path))
        except ConfigError as error:
            raise CommandFailed("invalid", str(error)) from None
        return motion.trajectory, motion.path, motion.speed


def _require_pose(pose: Sequence[float], what: str) -> None:
    if len(pose) != POSE_NUMBERS:
        raise CommandFailed("invalid", f"{what}: found {len(pose)} numbers, allowed are 6: X Y Z (m) RX RY RZ (rad)")
    for name, number in zip(("x", "y", "z", "rx", "ry", "rz"), pose, strict=True):
        if not math.isfinite(number):
            raise CommandFailed("invalid", f"{what}: {name}: found {number}, allowed is a finite number")
        most, unit = (_MOST_RAD, "rad") if name.startswith("r") else (_MOST_M, "m")
        if abs(number) > most:
            raise CommandFailed(
                "invalid", f"{what}: {name}: found {number:g} {unit}, allowed is {-most:g} to {most:g} {unit}"
            )
