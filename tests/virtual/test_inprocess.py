"""The in-process bus: what it does with frames, states, watchdogs and objects; and the loop on it."""

from __future__ import annotations

import gc
import inspect
import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.config.segment import SegmentConfig, load_segment
from rtcp.fieldbus import bus as protocol
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.ipc.commands import MoveJoints, Reset
from rtcp.ipc.events import SlaveLost
from rtcp.ipc.states import State as MachineState
from rtcp.testing.bus import InProcessBus, InProcessData
from rtcp.testing.simulation import Frame, Simulation
from rtcp.virtual.described import DescribedDevice
from rtcp.virtual.models import CubemarsDrive, DiewuIoBox
from rtcp.virtual.models.cubemars import CubemarsOrh60, CubemarsOrh70
from rtcp.virtual.protocol import AlState
from tests.fieldbus.terminals import DEVICES, Echo, slave

PERIOD_NS = 1_000_000
MS = 1_000_000
DRIVE = struct.Struct("<Hiiib")
CSP = 8
WATCHDOG_MS = 20
SYNC_LIMIT = 120
"""Sync error limit in the drive's start-up SDOs."""


@pytest.fixture(scope="module")
def config() -> ArmConfig:
    """The IO box and the first two joints of the default arm; no geometry, which is one of six."""
    whole = load(default_config())
    return replace(
        whole,
        arm=None,
        slaves=whole.slaves[:3],
        joints=whole.joints[:2],
        cycle=replace(whole.cycle, period_us=PERIOD_NS / 1000),
    )


@pytest.fixture(scope="module")
def segment(config: ArmConfig) -> SegmentConfig:
    """The slaves of `config`."""
    whole = load_segment(config.source.parent / config.bus.segment)
    return replace(whole, slaves=whole.slaves[:3])


class Master:
    """A bus in OP, with frames half a cycle before SYNC0."""

    def __init__(self, config: ArmConfig, seed: int = 1, start: bool = True) -> None:
        self.box = DiewuIoBox()
        self.drives: list[CubemarsDrive] = [CubemarsOrh70(initial_position=0.5), CubemarsOrh60()]
        self.bus = InProcessBus([self.box, *self.drives], seed)
        self.config = config
        if start:
            self.data = self.bus.configure(config.slaves, PERIOD_NS)
            self.bus.now_ns = 0
            self.now = (-self.bus.offset_ns) % PERIOD_NS + PERIOD_NS // 2
            self.exchange()
            self.bus.request_state(AlState.OP)

    def exchange(self, cycles: int = 1) -> int:
        """Send and receive once a cycle; return the last working counter."""
        wkc = 0
        for _ in range(cycles):
            self.bus.advance_to(self.now)
            self.data.send()
            wkc = self.data.receive()
            self.now += PERIOD_NS
        return wkc

    def silence(self, cycles: int) -> None:
        """Let time pass without frames."""
        self.now += cycles * PERIOD_NS
        self.bus.advance_to(self.now - PERIOD_NS)

    def set_outputs(self, slot: int, control: int, position: int = 0, velocity: int = 0, mode: int = CSP) -> None:
        """Set a drive's outputs."""
        self.data.set_output(slot, DRIVE.pack(control, position, velocity, 0, mode))

    def shown(self, slot: int) -> tuple[int, ...]:
        """A drive's statusword, position, velocity, torque and mode in the last answer."""
        return DRIVE.unpack(self.data.input(slot))

    def states(self) -> list[tuple[int, bool, int]]:
        return [(slave.state, slave.error, slave.code) for slave in self.bus.read_states()]


@pytest.fixture
def master(config: ArmConfig) -> Master:
    return Master(config)


def parameters(member: object) -> list[str]:
    return list(inspect.signature(member).parameters)  # type: ignore[arg-type]


# -- what it offers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("implementation", "promised"),
    # Compiled, the methods of a class that tests may change have no signature.
    [
        (InProcessBus, protocol.Bus),
        pytest.param(InProcessData, protocol.ProcessData, marks=pytest.mark.interpreted),
    ],
)
def test_it_has_every_method_of_the_protocol_with_the_same_parameters(implementation: type, promised: type) -> None:
    methods = {name: member for name, member in vars(promised).items() if inspect.isfunction(member) and name[0] != "_"}
    assert {name: parameters(getattr(implementation, name)) for name in methods} == {
        name: parameters(member) for name, member in methods.items()
    }


def test_it_has_every_attribute_of_the_protocols(master: Master) -> None:
    assert [name for name in protocol.ProcessData.__annotations__ if not hasattr(master.data, name)] == []
    assert [name for name in protocol.Bus.__annotations__ if not hasattr(master.bus, name)] == []


# -- on to OP ------------------------------------------------------------------------------------------------------


def test_the_slaves_go_from_init_over_safe_op_to_op(config: ArmConfig) -> None:
    master = Master(config, start=False)
    assert [slave.state for slave in master.bus.read_states()] == [AlState.INIT] * 3
    assert [facts.state for facts in master.bus.scan()] == ["PRE-OP"] * 3
    master.data = master.bus.configure(config.slaves, PERIOD_NS)
    assert [slave.state for slave in master.bus.read_states()] == [AlState.SAFE_OP] * 3
    master.bus.request_state(AlState.OP)
    master.now = PERIOD_NS
    master.exchange(2)
    assert master.bus.wait_for_state(AlState.OP, 1.0) == ()
    master.bus.close()
    assert [slave.state for slave in master.bus.read_states()] == [AlState.INIT] * 3


def test_every_slave_counts_three_in_the_working_counter(master: Master) -> None:
    assert (master.data.expected_wkc, master.exchange()) == (9, 9)


def test_the_start_up_objects_are_written_and_the_interpolation_time_is_the_cycle(master: Master) -> None:
    assert int.from_bytes(master.bus.sdo_read(2, 0x605A, 0), "little") == 6
    assert int.from_bytes(master.bus.sdo_read(2, 0x6065, 0), "little") == 2000
    assert (master.bus.sdo_read(2, 0x60C2, 1), master.bus.sdo_read(2, 0x60C2, 2)) == (b"\x01", b"\xfd")


def test_another_slave_than_the_configuration_lists_is_refused_with_both_named(config: ArmConfig) -> None:
    bus = InProcessBus([CubemarsOrh70(), DiewuIoBox(), CubemarsOrh70()])
    with pytest.raises(BusError, match=r"position 1 \(io\): expected DIEWU 16DI16DO.*found Cubemars ORH70"):
        bus.configure(config.slaves, PERIOD_NS)
    with pytest.raises(BusError, match=r"3 slaves answer, the configuration .* lists 2"):
        bus.configure(config.slaves[:2], PERIOD_NS)


def test_slaves_without_mailbox_or_with_several_sync_managers_a_direction_carry_their_process_data() -> None:
    kinds = ("coupler", "bits4", "areas", "emulated", "pairs", "input", "output", "files")
    bus = InProcessBus([DescribedDevice(DEVICES[kind], lambda alias: b"", Echo) for kind in kinds], 1)
    data = bus.configure([slave(kind, kind) for kind in kinds], PERIOD_NS)
    sent = [bytes(0xA1 + n for n in range(length)) for length in data._lengths]

    def exchange(cycles: int) -> int:
        for _ in range(cycles):
            bus.advance_to(bus.now_ns + PERIOD_NS)
            data.send()
            wkc = data.receive()
        return wkc

    exchange(1)
    bus.request_state(AlState.OP)
    assert bus.wait_for_state(AlState.OP, 0.0) == ()
    for index, output in enumerate(sent):
        data.set_output(index, output)
    assert exchange(4) == data.expected_wkc == 5 * 3 + 1 + 2
    four_bits, first_of_three = bytes((sent[1][0] & 0x0F,)), sent[2][:1] + b"\0"
    assert data.inputs == [b"", four_bits, first_of_three, bytes((sent[3][0] & 0x0F,)), sent[4], b"\0", b"", sent[7]]


def test_a_slave_whose_file_has_other_lengths_or_services_is_refused_in_a_sentence() -> None:
    for kind, config, message in (
        ("bits4", slave("t", "areas"), "position 1 (t): expected Terminal 30"),
        (
            "areas",
            replace(slave("t", "areas"), device=replace(slave("t", "areas").device, coe=False, rpdo=())),
            "bytes",
        ),
        ("bits4", replace(slave("t", "bits4"), device=replace(slave("t", "bits4").device, coe=True)), "has no CoE"),
    ):
        bus = InProcessBus([DescribedDevice(DEVICES[kind], lambda alias: b"", None)], 1)
        with pytest.raises(BusError) as refused:
            bus.configure([config], PERIOD_NS)
        assert message in str(refused.value)


def test_a_description_that_a_fixed_mapping_does_not_fit_is_refused(config: ArmConfig) -> None:
    box = config.slaves[0]
    (pdo,) = box.device.tpdo
    cut = replace(box, device=replace(box.device, tpdo=(replace(pdo, channels=pdo.channels[:1]),)))
    with pytest.raises(BusError, match=r"slave 1 \(io\).*0x1C13.*`tpdo`.*expected 16 bits.*found 48 bits"):
        Master(config, start=False).bus.configure([cut, *config.slaves[1:]], PERIOD_NS)


def test_op_needs_outputs_that_have_come_lately(master: Master) -> None:
    master.bus.request_state(AlState.SAFE_OP)
    master.silence(WATCHDOG_MS + 1)
    master.bus.request_state(AlState.OP, [2])
    master.silence(1001)
    assert master.states()[1] == (AlState.SAFE_OP, True, 0x001B)
    assert "slave 2 (drive1) is in SAFE-OP + ERROR (0x001B" in master.bus.wait_for_state(AlState.OP, 0.0, [2])[0]


# -- an exchange ----------------------------------------------------------------------------------------------------


def test_a_drive_takes_outputs_over_at_the_sync0_after_the_frame_and_answers_in_the_next(master: Master) -> None:
    master.exchange(200)
    master.set_outputs(1, 0x06)
    assert master.exchange() == 9
    assert master.shown(1)[0] & 0x6F == 0x40
    master.exchange()
    assert master.shown(1)[0] & 0x6F == 0x21
    assert master.shown(2)[0] & 0x6F == 0x40


def test_a_drive_shows_where_it_stands(master: Master) -> None:
    master.exchange(2)
    assert [master.shown(slot)[1] for slot in (1, 2)] == [5000, 0]


def test_the_io_box_shows_its_inputs_in_the_next_frame_and_takes_its_outputs(master: Master) -> None:
    master.box.inputs = 0x1234
    master.data.set_output(0, b"\x21\x43")
    master.exchange(2)
    assert master.data.input(0)[:2] == b"\x34\x12"
    assert master.box.outputs == 0x4321


def test_outputs_of_another_length_are_not_taken(master: Master) -> None:
    master.data.set_output(0, b"\x01\x00")
    master.data.set_output(0, b"\x02")
    master.exchange(2)
    assert master.box.outputs == 1


def test_a_frame_that_is_lost_on_its_way_back_was_heard_and_one_on_its_way_out_was_not(master: Master) -> None:
    for heard, outputs in ((True, 1), (False, 0)):
        master.data.set_output(0, b"\x00\x00")
        master.exchange(2)
        before = master.data.dc_time
        master.data.lose(1, heard)
        master.data.set_output(0, b"\x01\x00")
        assert master.exchange() == -1
        assert (master.data.heard, master.box.outputs, master.data.dc_time) == (heard, outputs, before)
    assert master.data.missed == 2
    assert master.exchange() == 9


def test_the_reference_clock_runs_with_the_simulated_time(master: Master) -> None:
    master.exchange()
    before = master.data.dc_time
    master.exchange(7)
    assert master.data.dc_time - before == 7 * PERIOD_NS
    # Half a cycle before SYNC0, which comes at whole cycles of that clock.
    assert master.data.dc_time % PERIOD_NS == PERIOD_NS // 2


def test_a_drive_lives_through_every_cycle_also_without_frames(master: Master) -> None:
    drive = master.drives[0]
    drive.mechanics.braked = False
    drive.mechanics.velocity = 1.0
    drive.mechanics.coulomb = drive.mechanics.viscous = drive.mechanics.holding_torque = 0.0
    before = drive.mechanics.position
    master.silence(10)
    assert drive.mechanics.position == pytest.approx(before + 0.010, abs=0.0011)


def test_sync0_comes_at_whole_cycles_of_the_reference_clock(master: Master) -> None:
    drive = master.drives[0]
    drive.mechanics.braked = False
    drive.mechanics.velocity = 1.0
    drive.mechanics.coulomb = drive.mechanics.viscous = drive.mechanics.holding_torque = 0.0
    master.exchange()
    frame = master.now - PERIOD_NS
    before = drive.mechanics.position
    master.bus.advance_to(frame + PERIOD_NS // 2 - 1)
    assert drive.mechanics.position == before
    master.bus.advance_to(frame + PERIOD_NS // 2)
    assert drive.mechanics.position == pytest.approx(before + 0.001)


def test_outputs_do_not_count_below_op(config: ArmConfig) -> None:
    master = Master(config)
    master.bus.request_state(AlState.SAFE_OP, [2])
    master.set_outputs(1, 0x06, position=77)
    assert master.exchange(3) == 9
    assert master.drives[0].objects[0x607A, 0].value == 0
    master.bus.request_state(AlState.OP, [2])
    master.exchange(3)
    assert master.drives[0].objects[0x607A, 0].value == 77


def test_a_drive_without_sync0_steps_with_the_frames_and_knows_no_sync_error(config: ArmConfig) -> None:
    box, first, second = config.slaves
    free = (box, replace(first, device=replace(first.device, assign_activate=0)), second)
    master = Master(replace(config, slaves=free))
    master.set_outputs(1, 0, position=55)
    master.exchange()
    assert master.drives[0].objects[0x607A, 0].value == 55
    for _ in range(SYNC_LIMIT):
        master.data.lose(1, heard=False)
        master.exchange(2)
    assert master.states()[1:] == [(AlState.OP, False, 0), (AlState.SAFE_OP, True, 0x001A)]


# -- what goes wrong ------------------------------------------------------------------------------------------------


def test_without_frames_the_watchdog_takes_the_drives_out_of_op_and_their_outputs_no_longer_count(
    master: Master,
) -> None:
    master.exchange()
    master.silence(WATCHDOG_MS)
    assert [state for state, _, _ in master.states()] == [AlState.OP] * 3
    master.silence(2)
    # The box's own watchdog takes 100 ms.
    assert master.states() == [(AlState.OP, False, 0), *[(AlState.SAFE_OP, True, 0x001B)] * 2]
    assert master.exchange() == 3 + 1 + 1
    assert not master.shown(1)[0] & 0x0200


def test_a_slave_whose_error_is_acknowledged_takes_outputs_again_and_goes_to_op(master: Master) -> None:
    master.bus.drop(2, AlState.SAFE_OP, 0x001A)
    assert master.exchange() == 7
    master.bus.request_state(AlState.OP, [2])
    assert master.states()[1] == (AlState.SAFE_OP, True, 0x001A)
    master.bus.acknowledge(2)
    assert master.exchange() == 9
    master.bus.request_state(AlState.OP, [2])
    assert master.states()[1] == (AlState.OP, False, 0)


def test_a_slave_that_comes_back_to_op_does_not_obey_what_it_was_sent_before(master: Master) -> None:
    master.exchange(200)
    master.set_outputs(1, 0x06)
    master.exchange(3)
    assert master.drives[0].state == 2
    master.bus.drop(2, AlState.SAFE_OP, 0x001A)
    master.exchange(2)
    assert master.drives[0].state == 1
    master.bus.acknowledge(2)
    master.bus.request_state(AlState.OP, [2])
    master.silence(2)
    assert master.drives[0].state == 1


def test_more_missed_sync0_than_the_limit_allows_are_a_sync_error(master: Master) -> None:
    master.exchange()
    missed = 0
    while master.states()[1][0] == AlState.OP:
        master.data.lose(1, heard=False)
        master.exchange(2)
        missed += 1
    # Each missed SYNC0 adds three, each met one subtracts one.
    assert missed == SYNC_LIMIT // 2
    assert master.states()[1] == (AlState.SAFE_OP, True, 0x001A)
    assert master.states()[0] == (AlState.OP, False, 0)


def test_a_drive_that_loses_its_outputs_while_enabled_faults_and_sends_an_emergency(master: Master) -> None:
    master.exchange(200)
    for word in (6, 7, 15, 15):
        master.set_outputs(1, word, 5000)
        master.exchange(2)
    assert master.shown(1)[0] & 0x6F == 0x27
    master.bus.drop(2, AlState.SAFE_OP, 0x001A)
    master.exchange(3)
    assert [(sent.slave, sent.error_code) for sent in master.bus.emergencies()] == [(2, 0x8130)]
    assert master.bus.emergencies() == ()


def test_objects_are_read_and_written_with_the_rights_of_the_state(master: Master) -> None:
    master.bus.sdo_write(2, 0x6085, 0, (50_000).to_bytes(4, "little"))
    assert master.bus.sdo_read(2, 0x6085, 0) == (50_000).to_bytes(4, "little")
    with pytest.raises(SdoAborted, match=r"slave 2 \(drive1\) refused to read 0x7777:0 .*0x06020000") as refused:
        master.bus.sdo_read(2, 0x7777, 0)
    assert refused.value.code == 0x06020000
    with pytest.raises(SdoAborted, match="0x08000022"):
        master.bus.sdo_write(2, 0x1600, 0, b"\0")
    with pytest.raises(BusError, match="there is no slave 4; the bus has slaves 1 to 3"):
        master.bus.sdo_read(4, 0x1000, 0)


def test_an_object_written_by_a_service_holds_until_the_next_frame(master: Master) -> None:
    master.exchange(2)
    master.bus.sdo_write(2, 0x60FF, 0, (77).to_bytes(4, "little"))
    master.exchange(2)
    assert master.drives[0].objects[0x60FF, 0].value == 0


# -- the loop on it -------------------------------------------------------------------------------------------------


@pytest.fixture
def simulation(config: ArmConfig, segment: SegmentConfig) -> Iterator[Simulation]:
    with Simulation(config, 1, positions=[0.1, -0.2], segment=segment) as simulation:
        yield simulation


def move(*target: float) -> MoveJoints:
    return MoveJoints(target, 0.4, True)


def test_the_loop_follows_the_clock_brings_the_slaves_to_op_and_moves_the_arm(simulation: Simulation) -> None:
    simulation.hold()
    simulation.do(move(0.4, 0.3))
    simulation.bring_to(MachineState.HOLDING)
    simulation.run(0.3)
    assert [model.axis.position for model in simulation.models] == pytest.approx([0.4, 0.3], abs=1e-3)


def test_a_simulation_leaves_no_file_however_it_ends(
    config: ArmConfig, segment: SegmentConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rtcp.testing.simulation._SHARED_MEMORY", tmp_path)
    with pytest.raises(ValueError, match="found 1 numbers, allowed are 2"):
        Simulation(config, positions=[0.1], segment=segment)
    with pytest.raises((AttributeError, TypeError)):
        Simulation(config, segment=segment, partners="none")  # type: ignore[arg-type]
    with Simulation(config, segment=segment) as simulation:
        simulation.close()
        own = os.open(config.source, os.O_RDONLY)
    os.fstat(own)  # not closed a second time
    os.close(own)
    del simulation
    gc.collect()
    assert list(tmp_path.iterdir()) == []


def test_a_lease_that_is_not_renewed_runs_out_in_simulated_time(simulation: Simulation) -> None:
    simulation.hold()
    simulation.do(move(1.5, 1.5))
    simulation.fall_silent()
    simulation.bring_to(MachineState.STOPPING, 0.7)
    simulation.bring_to(MachineState.HOLDING, 1.0)


def test_slaves_that_left_op_are_reported_and_come_back_after_a_reset_and_not_before(
    config: ArmConfig, segment: SegmentConfig
) -> None:
    # 1000 lost cycles are allowed, so that the service notices the slave first.
    patient = replace(config, bus=replace(config.bus, lost_cycles=1000))
    with Simulation(patient, 1, segment=segment) as simulation:
        simulation.hold()
        simulation.bus.drop(2, AlState.SAFE_OP, 0x001A)
        simulation.bring_to(MachineState.FAULT, 0.3)
        assert [record.event for record in simulation.events if record.event.is_fault] == [SlaveLost(2)]
        simulation.run(0.5)
        assert simulation.state is MachineState.FAULT
        simulation.do(Reset())
        simulation.bring_to(MachineState.READY, 1.0)
        simulation.run(0.3)
        assert simulation.state is MachineState.READY


def story(config: ArmConfig, segment: SegmentConfig, seed: int) -> list[Frame]:
    frames: list[Frame] = []
    with Simulation(config, seed, segment=segment) as simulation:
        simulation.on_frame = frames.append
        simulation.hold()
        simulation.send(move(0.2, 0.1))
        simulation.run(0.1)
        simulation.data.lose(3)
        simulation.run(0.2)
        simulation.models[0].inject_fault(0x8400)
        simulation.run(0.3)
    return frames


def test_the_same_seed_and_the_same_calls_give_the_same_bytes_at_the_same_instants(
    config: ArmConfig, segment: SegmentConfig
) -> None:
    first = story(config, segment, 7)
    assert first == story(config, segment, 7)
    assert [frame.now_ns for frame in first] != [frame.now_ns for frame in story(config, segment, 8)]


def test_nothing_of_it_is_left_when_it_is_closed(config: ArmConfig, segment: SegmentConfig) -> None:
    simulation = Simulation(config, segment=segment)
    path: Path = simulation.board.path
    assert path.exists()
    simulation.close()
    assert not path.parent.exists()


def test_the_example_of_the_page_about_testing_runs() -> None:
    page = Path(__file__).parents[2] / "docs" / "testing.md"
    exec(page.read_text().split("```python\n")[1].split("```")[0], {})
