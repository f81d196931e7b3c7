"""The recorder as a process beside a real blackboard, which the test writes; its files are read by public readers."""

from __future__ import annotations

import csv
import json
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from kinematics.forward import forward
from rtcp.config import default_config, load
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import ResetDone
from rtcp.ipc.layout import PER_JOINT, SCALARS
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.session import Session
from rtcp.telemetry.channels import Channels

CONFIG = load(default_config())
PERIOD_NS = 2_000_000
PLACES = {name: at for at, (name, _) in enumerate(SCALARS[1:])}


class Loop:
    """The loop's side of a blackboard."""

    def __init__(self, directory: Path) -> None:
        Session(CONFIG, "inprocess", "", 0, time.monotonic_ns()).write(directory)
        self.directory = directory
        self.board = Blackboard(blackboard_file(directory), 6, PERIOD_NS)
        self.cycles = 0

    def publish(self, count: int = 1) -> None:
        """Publish cycles as fast as it goes; every number of a joint tells cycle, field and joint apart."""
        for _ in range(count):
            self.cycles += 1
            values: list[float] = [0] * len(PLACES)
            values[PLACES["cycle"]] = self.cycles
            values[PLACES["time_ns"]] = time.monotonic_ns()
            values[PLACES["inputs"]] = 0x3F
            for field, (_, code) in enumerate(PER_JOINT):
                values += [0x1237 if code == "H" else 1e-4 * self.cycles + field + 0.1 * axis for axis in range(6)]
            self.board.publish(values)


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[Loop]:
    made = Loop(tmp_path)
    yield made
    made.board.close()
    blackboard_file(tmp_path).unlink()


def record(loop: Loop, limit: int | None = None, **given: Any) -> subprocess.Popen[str]:
    """Start a recorder; it records when this returns. `limit`: of its files' size, as on a full disk."""
    options = {"out": str(loop.directory), "formats": ["mcap"], "signals": [], "every": 1, "seconds": None} | given

    def narrow() -> None:
        if limit is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.Popen(
        [sys.executable, "-m", "rtcp.telemetry.recorder", "--directory", str(loop.directory),
         "--options", json.dumps(options)],
        stdout=subprocess.PIPE, text=True, preexec_fn=narrow,  # noqa: PLW1509
    )  # fmt: skip


def begun(recorder: subprocess.Popen[str]) -> dict[str, Any]:
    assert recorder.stdout is not None
    found: dict[str, Any] = json.loads(recorder.stdout.readline())
    return found


def ended(recorder: subprocess.Popen[str], loop: Loop) -> dict[str, Any]:
    """End a recorder; return what it says it has done."""
    recorder.terminate()
    recorder.wait()
    found: dict[str, Any] = json.loads((loop.directory / f"recorder-{recorder.pid}.json").read_text())
    return found


def messages(path: Path, topic: str) -> list[Any]:
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [one.decoded_message for one in reader.iter_decoded_messages(topics=[topic])]


def test_every_cycle_is_in_both_files_with_the_values_of_its_record(loop: Loop) -> None:
    recorder = record(loop, formats=["mcap", "csv"])
    mcap_file, csv_file = map(Path, begun(recorder)["recording"]["files"])
    for _ in range(20):
        loop.publish(100)
        time.sleep(0.03)
    said = ended(recorder, loop)
    assert (said["records"], said["missing"], said["problem"], said["ended"]) == (2000, 0, "", True)
    cycles = messages(mcap_file, "/cycle")
    assert [one.number for one in cycles] == list(range(1, 2001))
    states = messages(mcap_file, "/joint_states")
    assert (states[0].name, states[6].position) == ([joint.name for joint in CONFIG.joints], cycles[6].actual_position)
    assert cycles[6].actual_position == pytest.approx([7e-4 + 0.1 * axis for axis in range(6)], abs=1e-12)
    assert messages(mcap_file, "/joint_targets")[6].effort == cycles[6].sent_torque
    rows = list(csv.reader(csv_file.open()))
    assert rows[0] == ["Time", *(f"J{axis}_{what}" for what in ("pos", "vel", "tor", "tpos") for axis in range(1, 7))]
    assert len(rows) == 2001
    for row, cycle in zip(rows[1:], cycles, strict=True):
        wanted = [*cycle.actual_position, *cycle.actual_velocity, *cycle.actual_torque, *cycle.sent_position]
        assert [float(value) for value in row] == pytest.approx([(cycle.time_ns - cycles[0].time_ns) * 1e-9, *wanted])


def test_the_file_explains_itself(loop: Loop) -> None:
    recorder = record(loop)
    (path,) = begun(recorder)["recording"]["files"]
    loop.publish(3)
    loop.board.event(ResetDone())
    loop.board.text("drive 3 (slave 4): its lamp is lit", is_problem=False)
    ended(recorder, loop)
    with open(path, "rb") as file:
        reader = make_reader(file)
        attached = {one.name: one.data for one in reader.iter_attachments()}
        (about,) = (one.metadata for one in reader.iter_metadata())
        logged = [json.loads(message.data)["message"] for _, _, message in reader.iter_messages(topics=["/log"])]
        (words,) = (json.loads(message.data) for _, _, message in reader.iter_messages(topics=["/machine"]))
    assert json.loads(attached["configuration.json"])["name"] == CONFIG.name
    assert b"<robot" in attached["arm.urdf"]
    assert about["joints"].split(", ") == [joint.name for joint in CONFIG.joints]
    assert len(logged) == 2
    assert logged[1] == "drive 3 (slave 4): its lamp is lit"
    assert words["drives"]["joint1"] == "operation enabled"
    assert words["inputs"]["forward"] is True


def test_the_frames_lead_from_the_base_to_the_tool(loop: Loop) -> None:
    recorder = record(loop)
    (path,) = map(Path, begun(recorder)["recording"]["files"])
    loop.publish()
    ended(recorder, loop)
    (tf,) = messages(path, "/tf")
    q = messages(path, "/cycle")[0].actual_position
    place, turn = np.zeros(3), np.eye(3)
    parent = "base_link"
    for one in tf.transforms:
        assert one.header.frame_id == parent
        parent = one.child_frame_id
        t, r = one.transform.translation, one.transform.rotation
        place = place + turn @ (t.x, t.y, t.z)
        turn = turn @ [
            [1 - 2 * (r.y**2 + r.z**2), 2 * (r.x * r.y - r.z * r.w), 2 * (r.x * r.z + r.y * r.w)],
            [2 * (r.x * r.y + r.z * r.w), 1 - 2 * (r.x**2 + r.z**2), 2 * (r.y * r.z - r.x * r.w)],
            [2 * (r.x * r.z - r.y * r.w), 2 * (r.y * r.z + r.x * r.w), 1 - 2 * (r.x**2 + r.y**2)],
        ]
    assert CONFIG.arm is not None
    tool = forward(CONFIG.arm, q)
    assert parent == "tool0"
    assert place == pytest.approx(tool.position, abs=1e-9)
    assert turn.ravel() == pytest.approx(tool.rotation, abs=1e-9)


def test_a_killed_recorder_leaves_all_but_the_last_second(loop: Loop) -> None:
    recorder = record(loop)
    (path,) = begun(recorder)["recording"]["files"]
    for _ in range(30):
        loop.publish(50)
        time.sleep(0.05)
    recorder.kill()
    recorder.wait()
    numbers = whole_cycles(path)
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > 600


def whole_cycles(path: str) -> list[int]:
    """Read a file without its end: the numbers of the cycles in it."""
    found = []
    cycles = 0
    with open(path, "rb") as file, suppress(EndOfFile):
        for one in StreamReader(file).records:
            if isinstance(one, Channel) and one.topic == "/cycle":
                cycles = one.id
            elif isinstance(one, Message) and one.channel_id == cycles:
                found.append(int.from_bytes(one.data[4:12], "little"))
    return found


def test_a_full_disk_ends_the_recording_with_a_message(loop: Loop) -> None:
    recorder = record(loop, limit=1_000_000)
    (path,) = begun(recorder)["recording"]["files"]
    while recorder.poll() is None:
        loop.publish(40)
        time.sleep(0.02)
    assert recorder.returncode == 1
    said = json.loads((loop.directory / f"recorder-{recorder.pid}.json").read_text())
    assert said["problem"] == f"the recording has ended: {path} cannot be written: File too large"
    assert len(whole_cycles(path)) > 50


def test_a_file_that_is_removed_ends_the_recording(loop: Loop) -> None:
    recorder = record(loop)
    (path,) = map(Path, begun(recorder)["recording"]["files"])
    path.unlink()
    while recorder.poll() is None:
        loop.publish(10)
        time.sleep(0.02)
    found = json.loads((loop.directory / f"recorder-{recorder.pid}.json").read_text())
    assert found["problem"] == f"the recording has ended: {path} cannot be written: it has been removed"


def test_what_was_not_read_in_time_is_a_gap_that_is_reported(loop: Loop) -> None:
    recorder = record(loop)
    (path,) = map(Path, begun(recorder)["recording"]["files"])
    loop.publish(10)
    time.sleep(0.5)
    recorder.send_signal(signal.SIGSTOP)
    loop.publish(40_000)
    recorder.send_signal(signal.SIGCONT)
    said = ended(recorder, loop)
    numbers = [one.number for one in messages(path, "/cycle")]
    assert said["missing"] > 0
    assert len(numbers) + said["missing"] == loop.cycles == numbers[-1]
    (logged,) = (one["message"] for one in json_messages(path, "/log"))
    assert logged.startswith(f"{said['missing']} of the cycles from 11 to 40010 are missing")


def json_messages(path: Path, topic: str) -> list[Any]:
    with open(path, "rb") as file:
        return [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=[topic])]


def test_chosen_signals_of_each_tenth_cycle(loop: Loop) -> None:
    recorder = record(loop, formats=["mcap", "csv"], signals=["*_position", "time_ns"], every=10)
    mcap_file, csv_file = map(Path, begun(recorder)["recording"]["files"])
    loop.publish(100)
    ended(recorder, loop)
    first = messages(mcap_file, "/cycle")[0]
    assert first.number == 10
    assert hasattr(first, "sent_position")
    assert not hasattr(first, "actual_torque")
    rows = list(csv.reader(csv_file.open()))
    assert len(rows) == 11
    assert "J6_pos" in rows[0]
    assert int(rows[1][rows[0].index("time_ns")]) == first.time_ns


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"signals": ["nothing"]}, "nothing: there is no such signal; allowed are number, cycle"),
        ({"out": "/proc/nowhere"}, "/proc/nowhere cannot be written"),
        ({"out": "/tmp/a\0b"}, "/tmp/a\0b cannot be written: "),
        ({"out": "/tmp/one.csv"}, "/tmp/one.csv: its ending is not that of the format mcap"),
    ],
    ids=["no such signal", "no such directory", "no path", "another format"],
)
def test_what_cannot_be_recorded_is_refused(loop: Loop, given: dict[str, Any], said: str) -> None:
    recorder = record(loop, **given)
    assert begun(recorder)["error"].startswith(said)
    assert recorder.wait() == 1


def test_times_of_a_recording_do_not_follow_the_wall_clock() -> None:
    channels = Channels(CONFIG, 10**18)
    assert channels.wall_ns(5) == 10**18 + 5
