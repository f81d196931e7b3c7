"""The node over DDS and Fast DDS in one network namespace: `dds_exchange.py PROGRAM` prints what each received."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from typing import Any, cast

from rtcp.ros.ros2_dds import DdsWire
from rtcp.ros.ros2_node import Commands, Publications
from rtcp.ros.ros2_types import encode
from tests.ros.test_commands import FakeArm
from tests.ros2.node import CONFIG, OPTIONS, SAMPLE, commanded, point, trajectory
from tests.waiting import until


class FastDds:
    """A reader or writer of raw bytes (`fast_dds.cpp`)."""

    def __init__(self, program: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [program, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.lines: list[str] = []
        self._reading = threading.Thread(target=self._read, daemon=True)
        self._reading.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self.lines.append(line.strip())

    def samples(self) -> list[str]:
        return [line.removeprefix("sample ") for line in self.lines if line.startswith("sample ")]

    def put(self, data: bytes) -> None:
        assert self._process.stdin is not None
        print(data.hex(), file=self._process.stdin, flush=True)

    def end(self) -> None:
        self._process.communicate()


def main(program: str) -> None:
    arm = FakeArm()
    received: dict[str, Any] = {}
    with Commands(OPTIONS, cast(Any, arm.connect)) as commands:
        wire = DdsWire(OPTIONS, commands)
        publications = Publications(wire, "arm", lambda: None)
        publications.connected(CONFIG)

        late = FastDds(program, "read", "rt/robot_description", "std_msgs::msg::dds_::String_", "durable")
        received["robot_description"] = until(late.samples, "the description")[0]
        late.end()

        reader = FastDds(program, "read", "rt/joint_states", "sensor_msgs::msg::dds_::JointState_", "volatile")

        def publish() -> bool:
            publications.joints(tuple("abcdef"), SAMPLE)
            return len(reader.samples()) > 4

        until(publish, "joint_states")
        received["joint_states"] = reader.samples()
        received["writers"] = [line.split()[1:] for line in reader.lines if line.startswith("writer ")]
        reader.end()

        for topic, kind, message in (
            ("joint_command", "trajectory_msgs/msg/JointTrajectoryPoint", point(0.0, (0.1, 0.2, 0.3))),
            ("joint_path_command", "trajectory_msgs/msg/JointTrajectory", trajectory()),
        ):
            name = f"trajectory_msgs::msg::dds_::{kind.rpartition('/')[2]}_"
            for quality in ("reliable", "best_effort"):
                before = len(commanded(arm, topic))
                writer = FastDds(program, "write", f"rt/{topic}", name, quality)

                def command(writer: FastDds = writer, data: bytes = encode(kind, message)) -> list[Any]:
                    writer.put(data)
                    return commanded(arm, topic)[before:]  # noqa: B023  called in this turn alone

                received[f"{topic}, {quality}"] = until(command, topic)[0][:2]
                writer.put(b"\x00\x01\x00\x00\xff\xff\xff\xff")  # no message: the next one is taken
                before = len(commanded(arm, topic))
                until(command, topic)
                writer.end()
        commands.loop.call_soon_threadsafe(arm.end)
        wire.close()
    print(json.dumps(received))


if __name__ == "__main__":
    main(sys.argv[1])
