"""The black box: what it writes of a blackboard, and when; the loop is fake, or runs in simulated time."""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.gateway import black_box
from rtcp.gateway.black_box import BlackBox
from rtcp.ipc import events
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.layout import EVENTS
from rtcp.ipc.observer import Observer
from rtcp.ipc.recording import FaultRecording, listed, read, write
from rtcp.ipc.runtime_directory import stop_marker
from rtcp.ipc.schema import arm_schema
from rtcp.ipc.session import Pid, Processes, Session, identify
from rtcp.ipc.states import DriveState, State
from rtcp.launch import launcher
from rtcp.testing.simulation import Simulation
from tests import simulated_time
from tests.records import numbers

JOINTS = 6
BEGAN_NS = 77
LOST, DRIVE = events.ProcessDataLost(5, 3), events.DriveFault(2, DriveState.FAULT_REACTION_ACTIVE, 0x21F)


@pytest.fixture(scope="module")
def config() -> ArmConfig:
    return load(default_config())


WriteBoard = Callable[..., "Written"]


class Written:
    """A blackboard whose last cycle is now, and a black box that reads it."""

    def __init__(self, path: Path, directory: Path, config: ArmConfig, period_ns: int = 500_000) -> None:
        self.period_ns = period_ns
        self.directory = directory
        self.session = Session(config, "virtual", "ecat0", 0, BEGAN_NS)
        self.board = Blackboard(path, arm_schema(JOINTS), period_ns)
        self.observer = Observer(path)
        self.reports: list[str] = []

    def fill(
        self, cycles: int, *, fault_at: int = 0, event: type[events.Event] = events.ProcessDataLost, ends_ns: int = 0
    ) -> int:
        """Publish `cycles` records, the last of them now (CLOCK_MONOTONIC); from `fault_at` on they are in fault."""
        ends_ns = ends_ns or time.monotonic_ns()
        for cycle in range(1, cycles + 1):
            broken = 0 < fault_at <= cycle
            values = numbers(
                self.board.schema,
                cycle=cycle,
                time_ns=ends_ns - (cycles - cycle) * self.period_ns,
                state=State.FAULT if broken else State.MOVING,
                fault=event.number if broken else 0,
                actual_position=[cycle * 1e-4, *[0.0] * (JOINTS - 1)],
            )
            self.board.publish(values)
        return ends_ns

    def watched(self) -> BlackBox:
        return BlackBox(self.observer, self.session, self.directory, self.reports.append)

    def lost(self, box: BlackBox) -> FaultRecording:
        """Cause lost frames; return the only recording after the box has finished."""
        self.board.event(LOST)
        box.finish()
        (recording,) = self.recordings
        return recording

    @property
    def recordings(self) -> list[FaultRecording]:
        return [read(recording.path) for recording in listed(self.directory)]

    def close(self) -> None:
        self.observer.close()
        self.board.close()


@pytest.fixture
def write_board(path: Path, tmp_path: Path, config: ArmConfig) -> Iterator[WriteBoard]:
    made: list[Written] = []

    def make(period_ns: int = 500_000) -> Written:
        made.append(Written(path, tmp_path / "faults", config, period_ns))
        return made[-1]

    yield make
    for each in made:
        each.close()


def messages(recording: FaultRecording) -> list[str]:
    return [moment.message for moment in recording.about.timeline]


def test_a_fault_is_written_with_the_ten_seconds_before_it(write_board: WriteBoard, config: ArmConfig) -> None:
    written = write_board()
    box = written.watched()
    written.fill(24_000, fault_at=23_990)
    written.board.event(LOST)
    written.board.event(events.ErrorReported("the drive's error code is 0x8611"))
    box.poll()
    box.finish()
    (recording,) = written.recordings
    about, records = recording.about, recording.records
    assert (about.number, about.before, about.arm, about.bus) == (1, "moving", config.name, "virtual")
    assert about.joints == tuple(joint.name for joint in config.joints)
    assert "the last 5 in a row" in about.what
    assert int(records["cycle"][about.at]) == 23_990
    assert int(records["cycle"][0]) == 23_990 - 20_000
    assert int(records["cycle"][-1]) == 24_000
    assert np.array_equal(records["actual_position"][:, 0], records["cycle"] * 1e-4)
    assert [about.what, "the drive's error code is 0x8611"] == messages(recording)
    assert any("number 1 (`rtcp faults show 1`)" in message for message in written.reports)


def test_further_fault_events_are_in_the_same_file_until_a_reset(write_board: WriteBoard) -> None:
    written = write_board()
    box = written.watched()
    written.fill(100, fault_at=50)
    written.board.event(LOST)
    box.poll()
    written.board.event(DRIVE)
    box.poll()
    written.board.event(events.ResetDone())
    written.board.event(events.EmergencyStopActivated())
    box.poll()
    box.finish()
    first, second = written.recordings
    assert len(messages(first)) == 4
    assert "process data lost" in first.about.what
    assert "emergency stop" in second.about.what.lower()


class Clock:
    """Fake clock of the black box and of a blackboard's events: an hour of faults in an instant."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.s = 0.0
        self.set_s = 0.0
        """Change of the wall clock meanwhile, s."""
        self._began_ns, self._wall_ns = time.monotonic_ns(), time.time_ns()
        monkeypatch.setattr(time, "monotonic_ns", self.now_ns)
        monkeypatch.setattr(time, "time_ns", self.wall_ns)
        monkeypatch.setattr(black_box, "AFTER_S", 0.1)
        monkeypatch.setattr(black_box, "SILENT_S", 1e9)  # it is measured by the clock of the host, which may be busy

    def now_ns(self) -> int:
        return self._began_ns + round(self.s * 1e9)

    def wall_ns(self) -> int:
        return self._wall_ns + round((self.s + self.set_s) * 1e9)


def test_a_fault_event_after_the_end_of_the_file_begins_a_new_one_at_most_every_ten_seconds(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    written.fill(100, fault_at=50)
    clock = Clock(monkeypatch)
    box = written.watched()
    happens = {
        0.0: LOST, 0.05: DRIVE, 3.0: DRIVE, 5.0: events.EmergencyStopActivated(),
        130.0: events.ResetTimeout(0, DriveState.UNKNOWN, 0),
        131.5: events.ResetWhileMoving(0, 0.1), 131.6: events.ResetDone(), 131.7: events.EmergencyStopActivated(),
    }  # fmt: skip
    for at_s in sorted({*happens, 9.9, 10.0, 20.0, 140.0}):
        clock.s = at_s
        if at_s in happens:
            written.board.event(happens[at_s])
        box.poll()
        # The file of 5.0 s is written not before 10 s, that of 131.5 s at the reset.
        seen = {9.9: [1], 10.0: [1, 4], 131.5: [1, 4, 5]}.get(at_s)
        if seen:
            box._writer.submit(int).result()
            assert [recording.about.event for recording in written.recordings] == seen
    box.finish()
    assert [recording.about.event for recording in written.recordings] == [1, 4, 5, 6, 8]
    second = written.recordings[1]
    assert len(messages(second)) == 4, "the events of the ten seconds before are in it"
    # A new gateway divides them in the same way, and finds each of them written.
    written.watched().finish()
    assert len(written.recordings) == 5


@pytest.mark.parametrize("set_s", [-3600.0, 3600.0])
def test_a_wall_clock_that_is_set_neither_puts_a_recording_off_nor_brings_it_forward(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch, set_s: float
) -> None:
    written = write_board()
    written.fill(100, fault_at=50)
    clock = Clock(monkeypatch)
    box = written.watched()

    def recorded_at(at_s: float, event: events.Event | None = None) -> list[int]:
        clock.s = at_s
        if event is not None:
            written.board.event(event)
        box.poll()
        box._writer.submit(int).result()
        return [recording.about.event for recording in written.recordings]

    assert recorded_at(0.0, LOST) == [1]
    clock.set_s = set_s
    assert recorded_at(9.0, DRIVE) == [1]
    assert recorded_at(10.0) == [1, 2]
    # The emergency stop half a minute into a fault, while its ten seconds are in the ring.
    assert recorded_at(30.0, events.EmergencyStopActivated()) == [1, 2, 3]
    box.finish()
    first, _, third = written.recordings
    assert third.about.time_ns == first.about.time_ns + round((30.0 + set_s) * 1e9), "people are shown the wall clock"


def test_a_fault_that_no_gateway_saw_is_made_up_for_although_the_wall_clock_was_set_forward(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    clock = Clock(monkeypatch)
    written.fill(2000, fault_at=1000, ends_ns=clock.now_ns() + 500_000_000)
    written.board.event(LOST)
    clock.s, clock.set_s = 0.25, 3600.0
    written.board.event(events.ResetDone())
    written.board.event(events.EmergencyStopActivated())
    clock.s = 2.0
    written.watched().finish()
    first, second = written.recordings
    assert int(first.records["cycle"][first.about.at]) == 1000
    assert first.about.time_ns == clock.wall_ns() - round((2.0 + 3600.0) * 1e9)
    # No cycle shows the second fault's code: its own is the one of its instant, 0.25 s before the last.
    assert int(second.records["cycle"][second.about.at]) == 1500


def test_what_is_reported_while_the_wall_clock_is_set_stands_where_it_was_said(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    written.fill(100, fault_at=50)
    clock = Clock(monkeypatch)
    box = written.watched()
    written.board.event(events.Arrived())
    clock.s, clock.set_s = 5.0, -3600.0
    written.board.event(LOST)
    clock.s, clock.set_s = 5.05, 3600.0
    written.board.event(DRIVE)
    clock.s = 6.0
    box.poll()
    box.finish()
    (recording,) = written.recordings
    about = recording.about
    away_s = [(moment.time_ns - about.time_ns) * 1e-9 for moment in about.timeline]
    assert away_s == pytest.approx([-5.0, 0.0, 0.05])


def test_what_was_put_off_is_written_when_the_gateway_ends(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    written.fill(100, fault_at=50)
    clock = Clock(monkeypatch)
    box = written.watched()
    written.board.event(LOST)
    box.poll()
    clock.s = 4.0
    written.board.event(events.EmergencyStopActivated())
    box.poll()
    box.finish()
    assert [recording.about.event for recording in written.recordings] == [1, 2]


@pytest.fixture
def host() -> Iterator[simulated_time.Clock]:
    """The clocks of this process, which the test moves."""
    with simulated_time.Clock().shown() as shown:
        yield shown


def test_what_follows_a_fault_is_waited_for(
    write_board: WriteBoard, host: simulated_time.Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    box = written.watched()
    waits: queue.Queue[float] = queue.Queue()
    is_over = threading.Event()

    def wait(seconds: float) -> bool:
        waits.put(seconds)
        return is_over.wait(60)

    monkeypatch.setattr(box._over, "wait", wait)
    written.fill(100, fault_at=100)
    written.board.event(LOST)
    box.poll()
    assert waits.get(timeout=60) == pytest.approx(black_box.AFTER_S)
    assert written.recordings == []
    host.advance(0.5)
    written.fill(900, fault_at=1)
    host.advance(0.5)
    is_over.set()
    box.finish()
    (recording,) = written.recordings
    assert len(recording.records["cycle"]) == 1000


def test_the_shortest_cycle_has_its_ten_seconds_too(write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    written = write_board(100_000)
    overwritten, since = threading.Event(), written.observer.since

    def reports(number: int) -> Any:
        records = since(number)
        overwritten.set()
        return records

    box = written.watched()
    cycles = written.observer.records + 1000
    written.fill(cycles, fault_at=cycles)
    written.board.event(LOST)
    monkeypatch.setattr(written.observer, "since", reports)
    box.poll()
    # Read at once: the records of the following second do not overwrite those before.
    assert overwritten.wait(20)
    written.fill(40_000, fault_at=1)
    box.finish()
    (recording,) = listed(written.directory)
    assert recording.about is not None
    assert recording.seconds >= 10.0
    assert not any("before the fault" in note for note in recording.about.notes)


def test_cycles_that_were_overwritten_before_they_were_read_are_reported(write_board: WriteBoard) -> None:
    written = write_board()
    box = written.watched()
    written.fill(16_410, fault_at=16_410)
    for number in range(1, 11):
        written.observer._ring[number]["_number_again"] = 0
    recording = written.lost(box)
    note = "8.2 s before the fault instead of 10 s: older cycles had been overwritten"
    assert note in recording.about.notes


def test_a_loop_that_had_hung_before_its_fault_has_overwritten_nothing(write_board: WriteBoard) -> None:
    written = write_board()
    box = written.watched()
    now = time.monotonic_ns()
    written.fill(1000, ends_ns=now - 13_000_000_000)
    written.fill(600, fault_at=600, ends_ns=now)
    recording = written.lost(box)
    note = "0.3 s before the fault instead of 10 s: the loop had published nothing for 12.7 s before them"
    assert note in recording.about.notes


def test_torn_records_are_reported_and_not_taken(write_board: WriteBoard) -> None:
    written = write_board()
    box = written.watched()
    written.fill(1000, fault_at=900)
    for number in (10, 11, 500):
        slot = written.observer._ring[number % written.observer.records]
        slot["_number_again"] = 0
    recording = written.lost(box)
    assert "3 cycles were overwritten before they were read, or torn" in recording.about.notes
    assert len(recording.records["cycle"]) == 997
    assert int(recording.records["cycle"][recording.about.at]) == 900


def test_events_that_the_ring_no_longer_holds_are_reported(write_board: WriteBoard) -> None:
    written = write_board()
    box = written.watched()
    written.fill(100, fault_at=90)
    for _ in range(EVENTS):
        written.board.event(events.Arrived())
    recording = written.lost(box)
    assert any(note.startswith(f"more than {EVENTS} events came") for note in recording.about.notes)


def test_a_loop_that_has_died_is_a_fault_of_its_own_and_one_that_was_commanded_to_end_is_none(
    write_board: WriteBoard,
) -> None:
    written = write_board()
    box = written.watched()
    written.fill(100)
    box.loop_has_ended()
    box.loop_has_ended()
    box.finish()
    (recording,) = written.recordings
    assert "ended unexpectedly" in recording.about.what
    assert (recording.about.before, recording.about.at, recording.about.event) == ("moving", 99, 0)
    assert messages(recording) == [recording.about.what]
    told_to_end = written.watched()
    told_to_end.end_is_wanted()
    told_to_end.loop_has_ended()
    told_to_end.finish()
    assert len(written.recordings) == 1


def test_a_loop_that_publishes_nothing_for_a_second_is_a_fault(
    write_board: WriteBoard, host: simulated_time.Clock
) -> None:
    written = write_board()
    written.fill(100)
    box = written.watched()
    for _ in range(5):
        host.advance(0.999)
        written.fill(1)
        box.poll()
    host.advance(0.999)
    box.poll()
    assert written.reports == []
    host.advance(0.002)
    box.poll()
    assert "has published nothing for 1 s" in written.reports[0]
    written.fill(1)
    box.poll()
    assert any("publishes again" in message for message in written.reports)
    box.finish()
    (recording,) = written.recordings
    assert "has published nothing for 1 s" in recording.about.what
    assert int(recording.records["cycle"][recording.about.at]) == 1


def test_a_loop_that_hangs_and_goes_on_into_a_fault_makes_one_recording_until_the_reset(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    monkeypatch.setattr(black_box, "SILENT_S", 1.0)
    monkeypatch.setattr(time, "monotonic", lambda: clock.s)
    written = write_board()
    written.fill(100)
    box = written.watched()

    def recorded_at(at_s: float) -> int:
        clock.s = at_s
        box.poll()
        box._writer.submit(int).result()
        return len(written.recordings)

    assert [recorded_at(at_s) for at_s in (0.5, 1.5, 2.5, 3.0)] == [0, 1, 1, 1]
    written.fill(1, fault_at=1)
    assert recorded_at(3.1) == 1
    written.board.event(events.SlaveLost(3))
    assert recorded_at(3.2) == 1
    assert "has published nothing" in written.recordings[0].about.what
    # The rest is written at the reset, and a silence after that is a new fault.
    written.board.event(events.ResetDone())
    assert recorded_at(3.3) == 2
    assert recorded_at(5.0) == 3
    box.finish()


def test_a_fault_that_no_gateway_saw_is_written_by_the_next_one_and_only_once(
    write_board: WriteBoard,
) -> None:
    written = write_board()
    written.fill(2000, fault_at=1000)
    written.board.event(LOST)
    for _ in range(3):
        written.watched().finish()
    (recording,) = written.recordings
    assert int(recording.records["cycle"][recording.about.at]) == 1000


def test_a_loop_that_died_with_its_gateway_is_recorded_at_the_next_start_and_only_once(
    write_board: WriteBoard, tmp_path: Path, config: ArmConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    written.fill(500)
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path))
    monkeypatch.setattr(launcher, "blackboard_file", lambda directory: written.board.path)
    reports: list[str] = []
    # This process made the blackboard, so it was the loop; another process has its number now.
    for processes in (Processes(), Processes(loop=identify(os.getpid())), Processes(loop=Pid(os.getpid(), 1))):
        assert written.recordings == []
        processes.write(tmp_path)
        launcher._record_unseen_end(tmp_path, reports.append)
        written.session.write(tmp_path)
    launcher._record_unseen_end(tmp_path, reports.append)
    (recording,) = written.recordings
    assert "ended unexpectedly" in recording.about.what
    assert (recording.about.before, recording.about.at) == ("moving", 499)
    stop_marker(tmp_path).touch()
    recording_file = listed(written.directory)[0].path
    recording_file.unlink()
    launcher._record_unseen_end(tmp_path, reports.append)
    assert written.recordings == []


def test_a_new_gateway_reads_the_list_once_and_the_ring_not_at_all_for_faults_that_are_written(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    written.fill(100, fault_at=50)
    for _ in range(5):
        written.board.event(LOST)
        written.board.event(events.ResetDone())
    written.watched().finish()
    assert len(written.recordings) == 5
    asked: list[str] = []

    def heard(name: str, answer: Callable[..., Any]) -> Callable[..., Any]:
        def ask(given: Any) -> Any:
            asked.append(name)
            return answer(given)

        return ask

    monkeypatch.setattr(black_box, "listed", heard("list", listed))
    monkeypatch.setattr(written.observer, "since", heard("ring", written.observer.since))
    written.watched().finish()
    assert asked == ["list"]
    assert len(written.recordings) == 5


def test_a_list_that_cannot_be_made_is_reported_and_the_next_fault_is_recorded(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    written.fill(100, fault_at=50)
    written.board.event(LOST)

    def broken(directory: Path) -> object:
        raise TypeError("odd")

    monkeypatch.setattr(black_box, "listed", broken)
    box = written.watched()
    written.board.event(events.ResetDone())
    written.board.event(events.EmergencyStopActivated())
    box.poll()
    box.finish()
    assert any("by a defect: TypeError odd" in message for message in written.reports)
    assert [recording.about.event for recording in written.recordings] == [3]


def test_a_fault_before_the_first_cycle_is_recorded_with_the_cycles_that_follow(
    write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_board()
    box = written.watched()
    read_once, since = threading.Event(), written.observer.since

    def followed(number: int) -> object:
        records = since(number)
        read_once.set()
        return records

    monkeypatch.setattr(written.observer, "since", followed)
    box._process_fault(time.monotonic_ns(), "has published nothing")
    assert read_once.wait(60)
    written.fill(100)
    box.finish()
    (recording,) = written.recordings
    assert (recording.about.at, len(recording.records["cycle"])) == (0, 100)


def test_a_fault_that_has_left_the_ring_is_not_made_up(write_board: WriteBoard, host: simulated_time.Clock) -> None:
    written = write_board()
    written.board.event(LOST)
    host.advance(0.1)
    written.fill(100, fault_at=1)
    written.watched().finish()
    assert written.recordings == []


def test_a_fault_of_another_start_is_not_taken_for_this_ones(write_board: WriteBoard) -> None:
    written = write_board()
    written.fill(200, fault_at=100)
    written.board.event(LOST)
    written.watched().finish()
    written.session = replace(written.session, began_ns=BEGAN_NS + 1)
    written.watched().finish()
    assert len(written.recordings) == 2


def test_a_disk_that_refuses_is_a_sentence_and_the_next_fault_is_tried_again(
    write_board: WriteBoard,
) -> None:
    written = write_board()
    written.directory.write_text("no directory")
    box = written.watched()
    written.fill(100, fault_at=50)
    written.board.event(LOST)
    while not written.reports:
        written.fill(1)
        box.poll()
        time.sleep(0.01)
    assert str(written.directory) in written.reports[0]
    assert "no recording can be written" in written.reports[0]
    written.directory.unlink()
    written.board.event(events.ResetDone())
    written.board.event(events.EmergencyStopActivated())
    box.poll()
    box.finish()
    assert len(written.recordings) == 1


def test_a_look_does_not_wait_for_the_disk(write_board: WriteBoard, monkeypatch: pytest.MonkeyPatch) -> None:
    written = write_board()
    box = written.watched()
    written.fill(20_000, fault_at=19_000)
    asked, gate = threading.Event(), threading.Event()

    def slow(*arguments: Any) -> object:
        asked.set()
        assert gate.wait(60)
        return write(*arguments)

    monkeypatch.setattr(black_box, "write", slow)
    monkeypatch.setattr(black_box, "AFTER_S", 0.0)
    written.board.event(LOST)
    box.poll()
    assert asked.wait(20)
    box.poll()
    assert written.reports == []
    gate.set()
    box.finish()
    assert len(written.recordings) == 1


@pytest.mark.parametrize("break_it", ["drive", "frames"])
def test_the_loops_own_fault_is_recorded_cycle_by_cycle(config: ArmConfig, tmp_path: Path, break_it: str) -> None:
    quick = replace(config, cycle=replace(config.cycle, period_us=2000.0))
    with Simulation(quick, follow_clock=False) as simulation:
        reports: list[str] = []
        session = Session(quick, "inprocess", "", 0, BEGAN_NS)
        box = BlackBox(simulation.observer, session, tmp_path, reports.append)
        simulation.hold()
        simulation.send(MoveJoints((0.5,) * 6, 0.3, True))
        simulation.run(0.8)
        first = simulation.observer.head
        if break_it == "drive":
            simulation.models[2].inject_fault(0x8611)
        else:
            simulation.data.lose(200)
        simulation.bring_to(State.FAULT, 2.0)
        box.poll()
        simulation.run(0.3)
        box.finish()
        (kept,) = listed(tmp_path)
        recording = read(kept.path)
        about, records = recording.about, recording.records
        assert about.before == "moving"
        ring, _ = simulation.observer.since(0)
        whole = ring[np.isin(ring["number"], records["number"])]
        for name in recording.schema.names:
            assert name.startswith("tool_") or np.array_equal(records[name], whole[name]), name
        assert recording.records["tool_z"][about.at] > 0.0
        assert int(records["number"][about.at]) > first
        assert int(records["state"][about.at]) == State.FAULT
        assert int(records["state"][about.at - 1]) == State.MOVING
        assert about.what in messages(recording)
        assert reports
