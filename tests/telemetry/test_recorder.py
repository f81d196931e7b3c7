"""The recorder beside a real blackboard, which the test writes: in this process, or as a process of its own where the
test kills the process, or takes its rights or its disk. Public readers read its files."""

from __future__ import annotations

import csv
import ctypes
import json
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
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
from rtcp.config.model import RecordingConfig
from rtcp.config.serialization import to_json
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import ErrorReported, ResetDone
from rtcp.ipc.layout import EVENTS, RECORDS
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.schema import PER_JOINT, Field, RecordSchema, arm_schema
from rtcp.ipc.session import Session
from rtcp.ipc.states import DriveState
from rtcp.ipc.tool_motion import POSE, VELOCITY
from rtcp.telemetry import recorder as module
from rtcp.telemetry.recorder import FLUSH_S, Recorder, RecorderStatus
from tests.records import numbers
from tests.waiting import until

CONFIG = load(default_config())
PERIOD_NS = 2_000_000
PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2
HOUR_NS = 3600 * 10**9
SCHEMA = arm_schema(6)
SCHEMA = RecordSchema(
    (*SCHEMA.fields, Field("io_inputs", "uint32", part="io"), Field("io_outputs", "uint32", part="io"))
)
"""An arm with an IO box."""


class Loop:
    """The loop's side of a blackboard."""

    def __init__(self, directory: Path) -> None:
        Session(CONFIG, "inprocess", "", 0, time.monotonic_ns()).write(directory)
        self.directory = directory
        self.board = Blackboard(blackboard_file(directory), SCHEMA, PERIOD_NS)
        self.cycles = 0

    def publish(self, count: int = 1, inputs: int = 0x3F) -> None:
        """Publish cycles as fast as it goes; every number of a joint tells cycle, field and joint apart."""
        for _ in range(count):
            self.cycles += 1
            joints: dict[str, Any] = {
                name: [1e-4 * self.cycles + field + 0.1 * axis for axis in range(6)]
                for field, name in enumerate(PER_JOINT)
            }
            joints |= {"drive_state": DriveState.OPERATION_ENABLED, "statusword": 0x1237}
            scalars = {"cycle": self.cycles, "time_ns": time.monotonic_ns(), "io_inputs": inputs}
            self.last = numbers(SCHEMA, **scalars, **joints)
            self.board.publish(self.last)


@pytest.fixture
def loop(tmp_path: Path) -> Iterator[Loop]:
    made = Loop(tmp_path)
    yield made
    made.board.close()
    blackboard_file(tmp_path).unlink()


def record(loop: Loop, limit: int | None = None, **given: Any) -> subprocess.Popen[str]:
    """Start a recorder. `limit`: of its files' size, as on a full disk. Rights of files bind it also as root."""
    options = to_json(RecordingConfig(**{"out": str(loop.directory)} | given))

    def narrow() -> None:
        for right in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, right, 0, 0, 0)
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
    answer: dict[str, Any] = json.loads(recorder.stdout.readline())
    return answer


def ended(recorder: subprocess.Popen[str], loop: Loop) -> dict[str, Any]:
    """End a recorder; return its report."""
    recorder.terminate()
    recorder.wait()
    return status(recorder, loop)


def status(recorder: subprocess.Popen[str], loop: Loop) -> dict[str, Any]:
    """Return the last report of a recorder."""
    state: dict[str, Any] = json.loads((loop.directory / f"recorder-{recorder.pid}.json").read_text())
    return state


class Clock:
    """The module `time` of the recorder, with an hour of the test's own."""

    def __init__(self) -> None:
        self.now, self.set_ns = 1000.0, 0

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def time_ns(self) -> int:
        return time.time_ns() + self.set_ns

    def strftime(self, form: str) -> str:
        return time.strftime(form)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(module, "time", made)
    return made


class Here:
    """A recorder in this process, which reads when the test says so."""

    def __init__(self, loop: Loop, clock: Clock, **given: Any) -> None:
        self.recorder = Recorder(loop.directory, RecordingConfig(**{"out": str(loop.directory)} | given))
        self.files = list(map(Path, self.recorder.status.files))
        self._clock = clock

    def take(self) -> RecorderStatus:
        """Write what is new, and flush it."""
        self._clock.now += FLUSH_S
        self.recorder._write_new()
        return self.recorder.status

    def finish(self) -> RecorderStatus:
        """Write the rest and end."""
        self._clock.now += FLUSH_S
        self.recorder.end()
        self.recorder.run()
        self.recorder._feed.close()
        return self.recorder.status


def messages(path: Path, topic: str) -> list[Any]:
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [decoded.decoded_message for decoded in reader.iter_decoded_messages(topics=[topic])]


def numbers_in(path: Path) -> list[int]:
    """The numbers of the cycles in a whole file."""
    with open(path, "rb") as file:
        found = make_reader(file).iter_messages(topics=["/cycle"])
        return [int.from_bytes(message.data[4:12], "little") for _, _, message in found]


def test_every_cycle_is_in_both_files_with_the_values_of_its_record(loop: Loop) -> None:
    recorder = record(loop, formats=("mcap", "csv"))
    mcap_file, csv_file = map(Path, begun(recorder)["recording"]["files"])
    loop.publish(300)
    said = ended(recorder, loop)
    assert (said["records"], said["missing"], said["problem"], said["ended"]) == (300, 0, "", True)
    cycles = messages(mcap_file, "/cycle")
    assert [cycle.number for cycle in cycles] == list(range(1, 301))
    states = messages(mcap_file, "/joint_states")
    assert (states[0].name, states[6].position) == ([joint.name for joint in CONFIG.joints], cycles[6].actual_position)
    assert cycles[6].actual_position == pytest.approx([7e-4 + 0.1 * axis for axis in range(6)], abs=1e-12)
    assert messages(mcap_file, "/joint_targets")[6].effort == cycles[6].sent_torque
    rows = list(csv.reader(csv_file.open()))
    assert rows[0] == ["Time", *(f"J{axis}_{what}" for what in ("pos", "vel", "tor", "tpos") for axis in range(1, 7))]
    assert len(rows) == 301
    for row, cycle in zip(rows[1:], cycles, strict=True):
        wanted = [*cycle.actual_position, *cycle.actual_velocity, *cycle.actual_torque, *cycle.sent_position]
        assert [float(value) for value in row] == pytest.approx([(cycle.time_ns - cycles[0].time_ns) * 1e-9, *wanted])


def test_the_file_explains_itself(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock)
    (path,) = here.files
    loop.publish(3)
    loop.board.event(ResetDone())
    loop.board.event(ErrorReported("drive 3 (slave 4): its lamp is lit"))
    here.finish()
    with open(path, "rb") as file:
        reader = make_reader(file)
        attached = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        (about,) = (entry.metadata for entry in reader.iter_metadata())
        logged = [json.loads(message.data)["message"] for _, _, message in reader.iter_messages(topics=["/log"])]
        (words,) = (json.loads(message.data) for _, _, message in reader.iter_messages(topics=["/machine"]))
    assert json.loads(attached["configuration.json"])["name"] == CONFIG.name
    assert b"<robot" in attached["arm.urdf"]
    assert about["joints"].split(", ") == [joint.name for joint in CONFIG.joints]
    assert len(logged) == 2
    assert logged[1] == "drive 3 (slave 4): its lamp is lit"
    assert words["drives"]["joint1"] == "operation enabled"
    assert words["inputs"]["forward"] is True


def test_the_frames_lead_from_the_base_to_the_tool(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock)
    (path,) = here.files
    loop.publish()
    here.finish()
    (tf,) = messages(path, "/tf")
    q = messages(path, "/cycle")[0].actual_position
    place, rotation = np.zeros(3), np.eye(3)
    parent = "base_link"
    for transform in tf.transforms:
        assert transform.header.frame_id == parent
        parent = transform.child_frame_id
        t, r = transform.transform.translation, transform.transform.rotation
        place = place + rotation @ (t.x, t.y, t.z)
        rotation = rotation @ [
            [1 - 2 * (r.y**2 + r.z**2), 2 * (r.x * r.y - r.z * r.w), 2 * (r.x * r.z + r.y * r.w)],
            [2 * (r.x * r.y + r.z * r.w), 1 - 2 * (r.x**2 + r.z**2), 2 * (r.y * r.z - r.x * r.w)],
            [2 * (r.x * r.z - r.y * r.w), 2 * (r.y * r.z + r.x * r.w), 1 - 2 * (r.x**2 + r.y**2)],
        ]
    assert CONFIG.arm is not None
    tool = forward(CONFIG.arm, q)
    assert parent == "tool0"
    assert place == pytest.approx(tool.position, abs=1e-9)
    assert rotation.ravel() == pytest.approx(tool.rotation, abs=1e-9)


def test_a_killed_recorder_leaves_all_but_what_it_got_since_its_last_report(loop: Loop) -> None:
    recorder = record(loop)
    (path,) = begun(recorder)["recording"]["files"]
    loop.publish(600)
    reported = until(lambda: status(recorder, loop)["records"], "a report")
    loop.publish(50)
    recorder.kill()
    recorder.wait()
    numbers = whole_cycles(path)
    assert numbers == list(range(1, len(numbers) + 1))
    assert 0 < reported <= len(numbers)
    assert FLUSH_S <= 1.0


def whole_cycles(path: str) -> list[int]:
    """Read a file without its end: the numbers of the cycles in it."""
    numbers = []
    cycles = 0
    with open(path, "rb") as file, suppress(EndOfFile):
        for record in StreamReader(file).records:
            if isinstance(record, Channel) and record.topic == "/cycle":
                cycles = record.id
            elif isinstance(record, Message) and record.channel_id == cycles:
                numbers.append(int.from_bytes(record.data[4:12], "little"))
    return numbers


def test_a_full_disk_ends_the_recording_with_a_message(loop: Loop) -> None:
    recorder = record(loop, limit=1_000_000)
    (path,) = begun(recorder)["recording"]["files"]
    while recorder.poll() is None:
        loop.publish(40)
        time.sleep(0.02)
    assert recorder.returncode == 1
    said = status(recorder, loop)
    assert said["problem"] == f"the recording has ended: {path} cannot be written: File too large"
    assert len(whole_cycles(path)) > 50


@pytest.mark.parametrize("what", ["file", "directory"])
def test_a_file_or_directory_that_is_removed_ends_the_recording(loop: Loop, clock: Clock, what: str) -> None:
    directory = loop.directory / "gone"
    directory.mkdir()
    here = Here(loop, clock, out=str(directory))
    (path,) = here.files
    path.unlink() if what == "file" else shutil.rmtree(directory)
    loop.publish(10)
    assert here.finish().problem == f"the recording has ended: {path} cannot be written: it has been removed"


def test_what_was_not_read_in_time_is_a_gap_that_is_reported(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock)
    (path,) = here.files
    loop.publish(10)
    here.take()
    for _ in range(RECORDS + 100):
        loop.board.publish(loop.last)
    for _ in range(EVENTS + 10):
        loop.board.event(ResetDone())
    said = here.finish()
    numbers, last = numbers_in(path), RECORDS + 110
    assert said.missing > 0
    assert len(numbers) + said.missing == last == numbers[-1]
    logged = [
        message["message"].removesuffix(" are missing: they were not read in time")
        for message in json_messages(path, "/log")
    ]
    assert logged[0] == f"{said.missing} of the cycles from 11 to {last}"
    assert logged[1] == "10 of the events from 1 to 10"
    assert len(logged) == 2 + EVENTS


def json_messages(path: Path, topic: str) -> list[Any]:
    with open(path, "rb") as file:
        return [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(topics=[topic])]


def test_chosen_signals_of_each_tenth_cycle(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock, formats=("mcap", "csv"), signals=("*_position", "time_ns"), every=10)
    mcap_file, csv_file = here.files
    loop.publish(100)
    here.finish()
    first = messages(mcap_file, "/cycle")[0]
    assert first.number == 10
    assert hasattr(first, "sent_position")
    assert not hasattr(first, "actual_torque")
    rows = list(csv.reader(csv_file.open()))
    assert len(rows) == 11
    source = [f"J{axis}_{name}" for name in ("pos", "vel", "tor", "tpos") for axis in range(1, 7)]
    assert rows[0][:28] == ["Time", *source, "number", "time_ns", "J1_commanded_position"]
    assert int(rows[1][rows[0].index("time_ns")]) == first.time_ns


def test_changes_between_the_chosen_cycles_are_recorded(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock, every=10)
    (path,) = here.files
    for inputs in (0x3F, 0x3E, 0x3F):
        loop.publish(3, inputs)
    loop.publish(11)
    here.finish()
    assert [message["inputs"]["forward"] for message in json_messages(path, "/machine")] == [True, False, True]
    assert [message.number for message in messages(path, "/cycle")] == [10, 20]


@pytest.mark.parametrize("limit", [{"max_file_mb": 1}, {"max_file_seconds": 1.0}], ids=["size", "age"])
def test_files_rotate_without_a_lost_or_doubled_cycle(loop: Loop, clock: Clock, limit: dict[str, Any]) -> None:
    here = Here(loop, clock, formats=("mcap", "csv"), **limit)
    while here.take().rotations < 2:
        loop.publish(100)
    loop.publish(5)
    said = here.finish()
    parts = sorted(loop.directory.glob("recording-*.mcap"))
    assert str(parts[-1]) == said.files[0]
    assert [number for part in parts for number in numbers_in(part)] == list(range(1, loop.cycles + 1))
    assert said.records == loop.cycles
    assert said.bytes == sum(part.stat().st_size for part in loop.directory.glob("recording-*"))
    rows = [row for part in sorted(loop.directory.glob("recording-*.csv")) for row in csv.reader(part.open())]
    instants = [float(row[0]) for row in rows if row[0] != "Time"]
    assert len(instants) == loop.cycles
    assert instants == sorted(set(instants))
    for part in parts:
        explains_itself(part)


def explains_itself(path: Path) -> None:
    with open(path, "rb") as file:
        reader = make_reader(file)
        assert {attachment.name for attachment in reader.iter_attachments()} == {"configuration.json", "arm.urdf"}
        assert [entry.name for entry in reader.iter_metadata()] == ["rtcp/about"]
        topics = [channel.topic for _, channel, _ in reader.iter_messages(topics=["/robot_description", "/machine"])]
    assert sorted(topics) == ["/machine", "/robot_description"][0 if numbers_in(path) else 1 :]


def test_only_the_newest_files_are_kept(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock, out=str(loop.directory / "arm.mcap"), max_file_seconds=1.0, keep=2)
    while here.take().rotations < 3:
        loop.publish(10)
    said = here.finish()
    names = [f"arm-{said.rotations - away:06d}.mcap" for away in (1, 0)]
    assert sorted(path.name for path in loop.directory.glob("*.mcap")) == names


def test_a_recording_ends_before_the_disk_is_full(loop: Loop, clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [2_001e6]
    monkeypatch.setattr(shutil, "disk_usage", lambda place: SimpleNamespace(free=free[0]))
    here = Here(loop, clock, reserve_mb=2000)
    loop.publish(100)
    free[0] = 1_999e6
    said = here.finish()
    assert said.problem.startswith(f"the recording has ended: {loop.directory}: ")
    assert "less than the reserve of 2000 MB" in said.problem
    assert len(numbers_in(here.files[0])) == 100


@pytest.mark.parametrize(
    ("given", "reason", "fields"),
    [
        (
            {"signals": ("time_ns", "nothing")},
            "unknown_signal",
            {"signal": "nothing", "allowed": [*SCHEMA.names, *POSE, *VELOCITY]},
        ),
        ({"out": "/proc/nowhere"}, "not_writable", {"file": "/proc/nowhere", "error": "No such file or directory"}),
        (
            {"out": "/tmp/one.csv", "formats": ("mcap",)},
            "format_mismatch",
            {"file": "/tmp/one.csv", "formats": ["mcap"]},
        ),
        ({"keep": 3}, "keep_without_limit", {"keep": 3}),
    ],
    ids=lambda case: case if isinstance(case, str) else "",
)
def test_what_cannot_be_recorded_is_refused(
    loop: Loop,
    given: dict[str, Any],
    reason: str,
    fields: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(signal, "signal", lambda number, action: None)
    options = json.dumps(to_json(RecordingConfig(**{"out": str(loop.directory)} | given)))
    assert module.main(["--directory", str(loop.directory), "--options", options]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert answer["reason"] == reason
    assert {name: answer["fields"][name] for name in fields} == fields


def refused_with(recorder: subprocess.Popen[str], reason: str, fields: Mapping[str, Any]) -> None:
    answer = begun(recorder)
    assert recorder.wait() == 1
    assert answer["reason"] == reason
    assert {name: answer["fields"][name] for name in fields} == fields


def test_a_directory_without_rights_is_refused(loop: Loop) -> None:
    closed = loop.directory / "closed"
    closed.mkdir(mode=0o555)
    recorder = record(loop, out=str(closed / "one.mcap"))
    refused_with(recorder, "not_writable", {"file": str(closed / "one.mcap"), "error": "Permission denied"})


def test_a_failed_start_leaves_no_file(loop: Loop) -> None:
    refused_with(record(loop, formats=("csv", "mcap"), limit=2000), "not_writable", {})
    with pytest.raises(RtcpError) as refused:
        Recorder(loop.directory, RecordingConfig(out=str(loop.directory), formats=("csv", "mcap"), reserve_mb=10**9))
    assert refused.value.reason == "disk_reserve"
    assert not list(loop.directory.glob("recording-*"))


def test_a_failed_start_leaves_the_file_that_is_in_its_way(loop: Loop) -> None:
    mine = loop.directory / "mine.csv"
    mine.write_text("mine")
    with pytest.raises(RtcpError) as refused:
        Recorder(loop.directory, RecordingConfig(out=str(mine)))
    assert refused.value.reason == "not_writable"
    assert refused.value.fields == {"file": str(mine), "error": "File exists"}
    assert mine.read_text() == "mine"


def test_a_clock_that_is_set_while_recording_does_not_tear_the_file(loop: Loop, clock: Clock) -> None:
    here = Here(loop, clock)
    (path,) = here.files
    loop.publish(2)
    loop.board.event(ErrorReported("before"))
    clock.set_ns = HOUR_NS
    loop.publish(2)
    here.take()
    loop.board.event(ErrorReported("after"))
    loop.publish()
    here.finish()
    with open(path, "rb") as file:
        messages = [
            (message.log_time, channel.topic, message.data) for _, channel, message in make_reader(file).iter_messages()
        ]
    offsets = {
        time_ns - int.from_bytes(data[20:28], "little") for time_ns, topic, data in messages if topic == "/cycle"
    }
    assert len(offsets) == 1
    assert max(time_ns for time_ns, _, _ in messages) - min(time_ns for time_ns, _, _ in messages) < HOUR_NS / 2
    assert len([topic for _, topic, _ in messages if topic == "/log"]) == 2
