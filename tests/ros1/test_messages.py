"""Messages generated from our definitions are, by their MD5 sums, those that other ROS nodes speak."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from rtcp.ros import ros1_messages

CONTROL = {
    "FollowJointTrajectoryAction": "bc4f9b743838566551c0390c65f1a248",
    "FollowJointTrajectoryGoal": "69636787b6ecbde4d61d711979bc7ecb",
    "FollowJointTrajectoryResult": "493383b18409bfb604b4e26c676401d2",
    "FollowJointTrajectoryFeedback": "10817c60c2486ef6b33e97dcd87f4474",
    "FollowJointTrajectoryActionGoal": "cff5c1d533bf2f82dd0138d57f4304bb",
    "FollowJointTrajectoryActionResult": "c4fb3b000dc9da4fd99699380efcc5d9",
    "FollowJointTrajectoryActionFeedback": "d8920dc4eae9fc107e00999cce4be641",
    "JointTolerance": "f544fe9c16cf04547e135dd6063ff5be",
}
INDUSTRIAL = {
    "RobotStatus": "b733cb45a38101840b75c4c0d6093d19",
    "RobotMode": "24ac279e988b6b3db836e437e6ed1ba0",
    "TriState": "deb03829f3c2d0f1b647fa38d7087952",
    "ServiceReturnCode": "85a4e241266be66b1e1426b03083a412",
}
SERVICES = {
    "CmdJointTrajectory": "94fdf82abbbb1071bc31be1a2aea4fcd",
    "StopMotion": "50b1f38f75f5677e5692f3b3e7e1ea48",
    "SetDrivePower": "89dc29b38aedf0d168daa33da97de48a",
}
"""Sums of the published packages control_msgs and industrial_msgs."""


@pytest.mark.parametrize(
    ("module", "sums"),
    [("control_msgs.msg", CONTROL), ("industrial_msgs.msg", INDUSTRIAL), ("industrial_msgs.srv", SERVICES)],
)
def test_the_generated_classes_have_the_md5_sums_of_the_published_ones(
    ros_on_the_path: None, module: str, sums: dict[str, str]
) -> None:
    imported = importlib.import_module(module)
    assert {name: getattr(imported, name)._md5sum for name in sums} == sums


def test_they_are_generated_once_and_whole(
    ros_on_the_path: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = ros1_messages.generated()
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.py")}
    assert ros1_messages.generated() == folder
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.py")} == before
    assert [path.name for path in (tmp_path / "rtcp").iterdir()] == [folder.name]


def test_our_own_packages_come_before_those_of_debian(ros_on_the_path: None) -> None:
    program = (
        "from rtcp.ros import ros1_messages; ros1_messages.make_importable()\n"
        "import json, numpy, rospy, sys; print(json.dumps([numpy.__file__, rospy.__file__]))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    ours, debian = json.loads(done.stdout)
    assert ours.startswith(sys.prefix)
    assert debian.startswith("/usr/lib/python3/dist-packages")


def test_where_ros_is_missing_one_sentence_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros1_messages, "_NEEDED", (Path("/nowhere/rospy"),))
    assert ros1_messages.missing().startswith(
        "ROS 1 is not installed (/nowhere/rospy is missing): apt install python3-rospy"
    )
