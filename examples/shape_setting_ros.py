"""Robots and heater together through ROS 1: two arms bend a Nitinol rod, the heater sets its shape.

    rtcp cell start --config config/cell_shape_setting.yaml --detach      # two virtual arms and the heater
    roscore &                                                             # ROS 1: docs/ros.md
    rtcp ros --cell &
    python examples/shape_setting_ros.py config/cell_shape_setting.yaml config/shape_setting/arc.yaml

All commands and all measurements go through ROS. The bend is planned here, by the package; any other planner that sends
a FollowJointTrajectory could take its place. `--yes` asks nobody to grip and to take out the rod.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rtcp.config.cell_file import load_cell
from rtcp.processes.rod import plan_motion
from rtcp.processes.rod.bending import plan_approach
from rtcp.processes.shape_setting.heat_profile import heat_command
from rtcp.processes.shape_setting.job import pose_of, read_job
from rtcp.ros import ros1_messages

ros1_messages.make_importable()

import actionlib  # noqa: E402
import rospy  # noqa: E402
from control_msgs.msg import FollowJointTrajectoryAction, FollowJointTrajectoryGoal  # noqa: E402
from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from diagnostic_msgs.srv import AddDiagnostics  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint  # noqa: E402

Points = Mapping[str, Sequence[Mapping[str, Any]]]
"""Points of each arm, at the same times: `t`, `q`, and `v`, `a` where they are known."""


class Cell:
    """The group of joints and the heater, as `rtcp ros --cell` offers them."""

    def __init__(self) -> None:
        self._action = actionlib.SimpleActionClient("joint_trajectory_action", FollowJointTrajectoryAction)
        self._action.wait_for_server()
        self._before = ""
        rospy.Subscriber("processes", DiagnosticArray, self._show)

    def enable(self) -> None:
        """Enable arms and heater."""
        self._call("robot_enable", Trigger)

    def heater(self, command: str, **fields: Any) -> None:
        """Send a command to the heater; return when it is carried out, of a lasting one when the heater has finished.

        A command with fields takes them as one text, as `rtcp process` does.
        """
        if fields:
            self._call(
                f"heater/{command}", AddDiagnostics, " ".join(f"{name}={value}" for name, value in fields.items())
            )
        else:
            self._call(f"heater/{command}", Trigger)

    def positions(self) -> dict[str, float]:
        """Return the measured position of each joint, rad."""
        states = rospy.wait_for_message("joint_states", JointState)
        return dict(zip(states.name, states.position, strict=True))

    def follow(self, arms: Points) -> None:
        """Run a trajectory of all arms in step."""
        count = len(next(iter(arms.values()))[0]["q"])
        path = JointTrajectory(joint_names=[f"{arm}_joint_{number}" for arm in arms for number in range(1, count + 1)])
        for rows in zip(*arms.values(), strict=True):
            point = JointTrajectoryPoint(time_from_start=rospy.Duration(rows[0]["t"]))
            point.positions = [q for row in rows for q in row["q"]]
            if all(row.get("v") for row in rows):
                point.velocities = [v for row in rows for v in row["v"]]
            path.points.append(point)
        self._action.send_goal_and_wait(FollowJointTrajectoryGoal(trajectory=path))
        result = self._action.get_result()
        if result.error_code != 0:
            raise SystemExit(f"the arms did not follow: {result.error_string}")

    def _call(self, name: str, kind: Any, *request: Any) -> None:
        rospy.wait_for_service(name)
        answer = rospy.ServiceProxy(name, kind)(*request)
        print(f"{name}: {answer.message}", flush=True)
        if not answer.success:
            raise SystemExit(f"{name} was refused")

    def _show(self, message: Any) -> None:
        """Print each new state of the heater with the temperature of the rod."""
        for entry in message.status:
            if entry.name == "heater" and entry.message != self._before:
                self._before = entry.message
                values = {value.key: value.value for value in entry.values}
                print(
                    f"the heater is {entry.message}, the rod has {float(values['middle_temperature']):.0f} C",
                    flush=True,
                )


def set_shape(cell: Cell, cell_file: Path, job_file: Path, asks: bool) -> None:
    """Set the shape of one rod; an early end turns the heat off first, then stops the arms."""
    config, (job, profile) = load_cell(cell_file), read_job(job_file)
    print("the bend is planned", flush=True)
    plan = plan_motion(config, job.holders, job.steps(), pose_of(job.held), job.near)
    cell.enable()
    now = cell.positions()
    here = {arm: [now[f"{arm}_joint_{number + 1}"] for number in range(len(q))] for arm, q in plan.begin.items()}
    approach = plan_approach(config, job.holders, here, plan.begin, job.approach_speed)
    if approach is not None:
        cell.follow(approach)
    confirm(asks, "grip the rod, straight and unloaded; the key is at Auto")
    # The initial resistance is that of the straight rod: stress would change it.
    cell.heater("set_heat_profile", **asdict(heat_command(profile)))
    cell.heater("arm_heater")
    cell.heater("measure_resistance", straight_and_unloaded="true", phase="austenite")
    cell.heater("stop_heating")
    cell.follow(plan.trajectory)
    cell.heater("arm_heater")
    cell.heater("start_heating")  # heat, hold, cool down
    confirm(asks, "open the chucks and take the rod out")


def confirm(asks: bool, what: str) -> None:
    """Ask the operator to do something, and wait for Enter."""
    print(what, flush=True)
    if asks:
        input("then press Enter")


def main() -> None:
    """Set the shape of one rod."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("cell", type=Path, help="the cell's file")
    parser.add_argument("job", type=Path, help="the shape's file")
    parser.add_argument("--yes", action="store_true", help="ask nobody")
    arguments = parser.parse_args(rospy.myargv()[1:])
    rospy.init_node("shape_setting")
    cell = Cell()
    try:
        set_shape(cell, arguments.cell, arguments.job, not arguments.yes)
    except BaseException:  # an interrupt too
        try:
            rospy.ServiceProxy("heater/stop_heating", Trigger)()
        finally:  # the arms stop although the heater does not answer
            rospy.ServiceProxy("robot_stop", Trigger)()
        raise


if __name__ == "__main__":
    main()
