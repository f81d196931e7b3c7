"""What a drive holds beside its process data: read at the start, explained, and compared with what the joints need."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from rtcp.config import default_config, load
from rtcp.config.drive_limits import with_limits
from rtcp.config.model import ArmConfig, DeviceDescription, FeedForwardConfig, Pdo, PdoEntry
from rtcp.config.segment import SegmentConfig
from rtcp.fieldbus.drive_settings import check_settings, compare, settings_of
from rtcp.fieldbus.errors import BusError, SdoAborted
from rtcp.fieldbus.mailbox import SdoClient
from rtcp.fieldbus.registers import finish
from rtcp.testing.bus import InProcessBus
from rtcp.testing.simulation import Simulation
from rtcp.virtual.models import CubemarsDrive, create
from rtcp.virtual.models.servo import ServoAxis
from rtcp.virtual.objects import Access, DataType, Entry
from tests.control.test_standard_drives import BENT, arm_of
from tests.drive_esi import ARMS

SHIPPED = load(default_config())
RAIL = load(default_config().parent / "linear_axis.yaml")
REMEDY = "write another value among the start-up SDOs of synapticon-somanet.yaml"


def arm(directory: Path, options: Mapping[str, object], **keys: object) -> tuple[ArmConfig, SegmentConfig]:
    """An arm of drives with these options of the segment, whose file lacks the start-up SDOs."""
    config, segment = arm_of(directory, "synapticon")
    device = replace(config.slaves[1].device, sdo=(), **keys)  # type: ignore[arg-type]
    slaves = (config.slaves[0], *(replace(slave, device=device) for slave in config.slaves[1:]))
    first, second = segment.slaves[:2]
    second = replace(second, options={**ARMS["synapticon"][2], "quick_stop_option": 6, **options})
    return replace(config, slaves=slaves), replace(segment, slaves=(first, *[second] * 6))


def notes(directory: Path, options: Mapping[str, object], **keys: object) -> list[str]:
    """The notes on the drive of joint 2 at the start."""
    config, segment = arm(directory, options, **keys)
    with Simulation(config, follow_clock=False, positions=BENT, segment=segment) as made:
        prefix = "slave 3 (drive2): "
        return [
            note.removeprefix(prefix)
            for note in made.bus.notes
            if note.startswith(prefix) and "interpolation" not in note
        ]


def test_a_drive_whose_settings_fit_its_joint_is_no_note(tmp_path: Path) -> None:
    assert notes(tmp_path, {"max_torque": 128.0, "quick_stop_deceleration": 10.0, "fault_reaction_option": 2}) == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"max_torque": 16.0}, "max torque (0x6072) is 250, 16 Nm, and joint2 needs 23.38 Nm to carry the arm in the "
         "worst pose of its range: enabled there, the arm sags"),
        ({"negative_torque_limit": 32.0}, "negative torque limit (0x60E1) is 500, 32 Nm, and the supervision stops "
         "joint2 at 73.5 Nm, which the drive never gives"),
        ({"max_profile_velocity": math.pi / 10}, "max profile velocity (0x607F) is 300, 0.3142 rad/s, and the speed "
         "limit of joint2 is 0.5 rad/s, which it does not reach"),
        ({"max_motor_speed": 300.0}, "max motor speed (0x6080) is 300, 0.3142 rad/s, and the speed limit"),
        ({"following_error_window": 0.05}, "rad, and the supervision of joint2 allows 0.15 rad: the drive goes to "
         "fault first"),
        ({"quick_stop_deceleration": 0.1}, "quick stop deceleration (0x6085) is 95, 0.09948 rad/s^2, and a quick stop "
         "of joint2 needs at least 0.25 rad/s^2"),
        ({"quick_stop_option": 0}, "after a quick stop it does not hold: quick stop option code (0x605A) is 0, the "
         "torque goes off at once; 5 to 8 hold; `stops` has it for lost_frames, slave_lost, drive_fault"),
        ({"quick_stop_option": 5}, "quick stop option code (0x605A) is 5, slows down by 0x6084, then holds; the times "
         "and distances of the stop reactions follow from 0x6085, which it does not use"),
        ({"fault_reaction_option": 0}, "fault reaction option code (0x605E) is 0, the torque goes off at once; in a "
         "fault, and when frames no longer reach it, the torque goes off at once, and the joint moves on until"),
        ({"torque_offset": 6.4}, "torque offset (0x60B2) is 100, 6.4 Nm, which it adds to the output of its loops"),
    ],
)  # fmt: skip
def test_a_drive_that_holds_something_else_than_its_joint_needs_is_named_before_it_is_enabled(
    tmp_path: Path, options: Mapping[str, object], said: str
) -> None:
    (note,) = notes(tmp_path, options)
    assert said in note
    assert note.endswith(REMEDY)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"max_torque": 0.0}, "max torque (0x6072) is 0, 0 Nm: enabled, joint1 has no torque, and the arm falls"),
        ({"wrap_low": -math.pi / 2, "wrap_high": math.pi / 2}, "its position wraps at -1.571 and 1.571 rad"),
    ],
)  # fmt: skip
def test_a_drive_that_would_let_its_joint_fall_or_turn_the_other_way_is_refused(
    tmp_path: Path, options: Mapping[str, object], said: str
) -> None:
    with pytest.raises(BusError) as refused:
        notes(tmp_path, options)
    assert any(f"slave 2 (drive1): {said}" in sentence for sentence in refused.value.sentences)


def test_an_axis_that_wraps_outside_the_range_of_its_joint_moves(tmp_path: Path) -> None:
    config, segment = arm(tmp_path, {"wrap_low": -math.pi, "wrap_high": 3 * math.pi})
    with Simulation(config, follow_clock=False, positions=BENT, segment=segment) as made:
        made.hold()
        assert made.loop.arm.state.actual[2] == pytest.approx(BENT[2], abs=1e-3)


def mapped(device: DeviceDescription, *entries: PdoEntry) -> tuple[Pdo, ...]:
    """The outputs of a device with further ones."""
    first, *others = device.rpdo
    return (replace(first, channels=(*first.channels, *entries)), *others)


TORQUE_LIMIT = PdoEntry(0x6072, 0, "uint16", "max_torque_sent")
SPEED_LIMIT = PdoEntry(0x607F, 0, "uint32", "max_speed_sent")


def first_servo(made: Simulation) -> ServoAxis:
    return made.bus.slaves[1].device.servos[0]


@pytest.mark.parametrize("stated", [None, 1500.0])
def test_a_mapped_object_that_the_platform_does_not_drive_gets_the_files_value_or_the_drives_own(
    tmp_path: Path, stated: float | None
) -> None:
    rpdo = mapped(arm_of(tmp_path, "synapticon")[0].slaves[1].device, replace(TORQUE_LIMIT, safe=stated), SPEED_LIMIT)
    config, segment = arm(tmp_path, {"max_torque": 128.0, "max_profile_velocity": 1.0}, rpdo=rpdo)
    with Simulation(config, follow_clock=False, positions=BENT, segment=segment) as made:
        made.hold()
        objects = first_servo(made).objects
        assert objects.number(0x6072).value == (stated or 2000)
        assert objects.number(0x607F).value == round(1.0 / (2 * math.pi / 60 / 100))


def test_a_mapped_limit_that_is_zero_in_the_drive_is_refused_unless_the_file_states_another(tmp_path: Path) -> None:
    rpdo = mapped(arm_of(tmp_path, "synapticon")[0].slaves[1].device, TORQUE_LIMIT)
    with pytest.raises(BusError, match=r"0x6072:0 \(max_torque_sent\) is 0 in the drive, and 0 would always be sent"):
        notes(tmp_path, {"max_torque": 0.0}, rpdo=rpdo)


def test_an_own_value_that_cannot_be_read_has_to_be_stated() -> None:
    class WriteOnly:
        position, name = 2, "drive1"

        def reading(self, index: int, subindex: int) -> Iterator[None]:
            raise SdoAborted("attempt to read a write only object", 0x06010001)
            yield

    def check(safe: float | None) -> DeviceDescription:
        slave = SHIPPED.slaves[1]
        device = replace(slave.device, rpdo=mapped(slave.device, replace(SPEED_LIMIT, safe=safe)))
        return finish(check_settings(cast(SdoClient, WriteOnly()), replace(slave, device=device)))[0]

    with pytest.raises(BusError, match=r"0x607F:0 \(max_speed_sent\) is always sent to it, and its own value cannot"):
        check(None)
    assert check(0.0).rpdo[0].channels[-1].safe == 0.0


def test_the_arms_own_weight_is_looked_for_in_all_of_its_range() -> None:
    needed = [slave.needs[0].holding_torque for slave in with_limits(SHIPPED)[1:]]
    assert needed == pytest.approx([0.0, 23.379, 9.937, 0.326, 0.326, 0.0], abs=1e-3)


def words(values: Mapping[tuple[int, int], tuple[int, int]], axis: int = 1) -> Sequence[str]:
    data = {at: value.to_bytes(length, "little", signed=value < 0) for at, (value, length) in values.items()}
    return [setting.text for setting in settings_of(data, axis)]


def test_a_drive_without_a_device_file_is_shown_in_its_own_units() -> None:
    units = {
        (0x608F, 1): (65536, 4), (0x608F, 2): (1, 4), (0x6091, 1): (100, 4), (0x6091, 2): (1, 4),
        (0x6076, 0): (1270, 4), (0x60A9, 0): (0x00B44700, 4),
    }  # fmt: skip
    held = {
        (0x6065, 0): (0xFFFFFFFF, 4), (0x6066, 0): (50, 2), (0x6072, 0): (2000, 2), (0x6080, 0): (3000, 4),
        (0x6085, 0): (9549, 4), (0x605A, 0): (-3, 2), (0x605C, 0): (1, 2),
    }  # fmt: skip
    assert words(units | held, 2) == [
        "quick stop option code (0x685A) is -3, by the manual of the drive",
        "disable operation option code (0x685C) is 1, slows down by 0x6084, then the torque goes off",
        "following error window (0x6865) is 4294967295, not supervised",
        "following error time out (0x6866) is 50, 0.05 s",
        "max torque (0x6872) is 2000, 2.54 Nm",
        "max motor speed (0x6880) is 3000, 3.142 rad/s",
        "quick stop deceleration (0x6885) is 9549, 10 rad/s^2",
    ]
    assert "quick stop deceleration (0x6085) is 9549" in words({**units, **held, (0x60AA, 0): (0x00B55700, 4)})


def rail(sdos: Mapping[int, int], rpdo: Sequence[PdoEntry] = (), **keys: object) -> ArmConfig:
    """The platform of a rail and a conveyor; values of their start-up SDOs and further outputs differ."""

    def changed(device: DeviceDescription) -> DeviceDescription:
        startup = tuple(replace(sdo, value=sdos.get(sdo.index, sdo.value)) for sdo in device.sdo)
        return replace(device, sdo=startup, rpdo=mapped(device, *rpdo) if rpdo else device.rpdo)

    slaves = tuple(
        replace(slave, device=changed(slave.device)) if slave.device.kind == "cia402" else slave
        for slave in RAIL.slaves
    )
    return replace(RAIL, slaves=slaves, **keys)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("sdos", "said"),
    [
        ({0x6084: 5000}, "profile deceleration (0x6084) is 5000, 0.05 m/s^2, and `acceleration` of rail is 0.5 m/s^2: "
         "halted, it would need a longer way than is kept to the end of its range"),
        ({0x605D: 2, 0x6085: 20000}, "quick stop deceleration (0x6085) is 20000, 0.2 m/s^2, and `acceleration`"),
    ],
)  # fmt: skip
def test_an_external_axis_whose_drive_halts_otherwise_than_the_platform_computes_is_refused(
    sdos: Mapping[int, int], said: str
) -> None:
    with pytest.raises(BusError) as refused:
        Simulation(rail(sdos), follow_clock=False).close()
    assert any(f"slave 2 (drive1): {said}" in sentence for sentence in refused.value.sentences)


def test_a_halt_whose_deceleration_nothing_states_is_refused_for_an_external_axis_alone() -> None:
    held = {(0x605D, 0): b"\x03\x00"}
    slave = with_limits(RAIL)[1]
    _, (refused,) = compare(held, slave.device, slave.needs[0], "drive1", "its file")
    assert refused.startswith(
        "drive1: halt option code (0x605D) is 3, slows down at the current limit, then holds, and rail is halted "
        "before the end of its range: allowed are 1 and 2"
    )
    joint = with_limits(SHIPPED)[1]
    assert compare(held, joint.device, joint.needs[0], "drive1", "its file") == ([], [])


def test_the_settings_of_an_axis_in_metres_are_compared_in_metres() -> None:
    with Simulation(rail({0x6065: 2000, 0x6085: 1000}), follow_clock=False) as made:
        (note,) = (note for note in made.bus.notes if "drive1" in note)
    assert "quick stop deceleration (0x6085) is 1000, 0.01 m/s^2, and a quick stop of rail needs at least" in note
    assert "m/s^2 to end" in note


def test_an_offset_that_feed_forward_does_not_drive_keeps_the_drives_own_value() -> None:
    """Feed-forward is of the arm's joints; the speed of a profile is driven, though its object may be write-only."""
    own = PdoEntry(0x60B2, 0, "int16", "torque_offset")

    class Slave:
        position, name = 2, "drive1"

        def reading(self, index: int, subindex: int) -> Iterator[None]:
            if index == 0x60B2:
                return (7).to_bytes(2, "little")  # type: ignore[return-value]
            raise SdoAborted("attempt to read a write only object", 0x06010001)
            yield

    def safe(config: ArmConfig) -> float | None:
        slave = next(slave for slave in with_limits(config) if slave.name == "drive1")
        slave = replace(slave, device=replace(slave.device, rpdo=mapped(slave.device, own)))
        device, _ = finish(check_settings(cast(SdoClient, Slave()), slave))
        return device.rpdo[0].channels[-1].safe

    gravity = FeedForwardConfig(gravity=1.0)
    assert safe(rail({}, feed_forward=gravity)) == 7.0
    assert safe(replace(SHIPPED, feed_forward=gravity)) is None


@pytest.mark.parametrize("moves", [True, False])
def test_a_drive_that_makes_its_own_profiles_need_not_interpolate_over_the_cycle(moves: bool) -> None:
    model = create("cubemars-orh60")
    assert isinstance(model, CubemarsDrive)
    model.objects.remove(0x60C2)
    model.objects.record(0x60C2, "Interpolation time period", [
        Entry(0x60C2, 1, "Value", DataType.UNSIGNED8, 4, Access.RO),
        Entry(0x60C2, 2, "Exponent", DataType.INTEGER8, -3, Access.RO),
    ])  # fmt: skip
    slave, bus = with_limits(RAIL)[1], InProcessBus([model])
    if moves:
        bus.configure([slave], 1_000_000)
        (note,) = (note for note in bus.notes if "0x60C2" in note)
        assert "is 4000 us, the cycle (`cycle.period_us`) is 1000 us" in note
        assert note.endswith("; its own profiles do not use it")
    else:
        with pytest.raises(BusError, match="they must be equal"):
            bus.configure([replace(slave, needs=())], 1_000_000)
