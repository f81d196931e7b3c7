"""EGM's bytes against examples that were worked out by hand."""

from __future__ import annotations

import pytest

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from google.protobuf import descriptor_pool

from rtcp.virtual.irc5.geometry import FlangePose
from rtcp.virtual.irc5.messages import EgmCodec, ForeignDatagram, GarbledDatagram, MciState, Reference, UnitState
from tests.virtual.irc5.wire import doubles, entry, sensor

ONE, TWO, HALF, THIRTY, ZERO = (
    "000000000000f03f", "0000000000000040", "000000000000e0bf", "0000000000003e40", "0000000000000000",
)  # fmt: skip
"""1, 2, -0.5, 30 and 0 as doubles, lowest byte first."""
HEADER = "0a04 0805 1803"
"""seqno 5, mtype 3."""
POSITION = f"1238 0a36 09{ONE} 09{TWO} 09{HALF} 09{ZERO} 09{THIRTY} 09{ONE}"
SPEED = f"1a38 0a36 09{HALF} 09{ZERO} 09{ZERO} 09{ZERO} 09{TWO} 09{ZERO}"
JOINTS = (1.0, 2.0, -0.5, 0.0, 30.0, 1.0)

STATE = UnitState(
    seqno=300,
    clock_s=12.25,
    actual=JOINTS,
    planned=JOINTS,
    actual_pose=FlangePose((1.0, 2.0, 30.0), (1.0, 0.0, 0.0, 0.0)),
    planned_pose=FlangePose((2.0, 2.0, 2.0), (0.0, 1.0, 0.0, 0.0)),
    motors_on=True,
    rapid_running=True,
    mci=MciState.RUNNING,
    converged=True,
    utilization=30.0,
    move_index=1,
    collision=False,
)
_BODY = f"0a36 09{ONE} 09{TWO} 09{HALF} 09{ZERO} 09{THIRTY} 09{ONE}"
_TIME = "2206 080c 1090a10f"
"""12 s, 250000 us."""
ROBOT = (
    "0a08 08ac02 10da5f 1802"  # header: 300, 12250 ms, DATA
    f"1285 01 {_BODY} 1243 0a1b 09{ONE} 11{TWO} 19{THIRTY} 1224 09{ONE} 11{ZERO} 19{ZERO} 21{ZERO} {_TIME}"  # feedBack
    f"1a85 01 {_BODY} 1243 0a1b 09{TWO} 11{TWO} 19{TWO} 1224 09{ZERO} 11{ONE} 19{ZERO} 21{ZERO} {_TIME}"  # planned
    "2202 0801 2a02 0803 3001 4202 0802"  # motors on, MCI running, converged, RAPID running
)
FORCES_7 = f"4a38 0800 {f'11{ZERO}' * 6}"
FORCES_6 = f"4a36 {f'09{ZERO}' * 6}"
REST_7 = f"51{THIRTY} 5801 6238 0800 {f'11{ZERO}' * 6}"  # utilizationRate, moveIndex, CollisionInfo
REST_6 = f"51{THIRTY}"


@pytest.mark.parametrize(
    ("robotware", "forces", "rest"), [(7, FORCES_7, REST_7), (6, FORCES_6, REST_6)], ids=["7", "6"]
)
def test_the_robots_message_is_the_example_byte_for_byte(robotware: int, forces: str, rest: str) -> None:
    assert EgmCodec(robotware).encode(STATE) == bytes.fromhex(ROBOT + forces + rest)


@pytest.mark.parametrize("robotware", [6, 7])
def test_a_pcs_message_with_positions_and_speeds_is_read(robotware: int) -> None:
    reference = EgmCodec(robotware).decode(bytes.fromhex(HEADER + POSITION + SPEED), 6)
    assert reference == Reference(5, JOINTS, (-0.5, 0.0, 0.0, 0.0, 2.0, 0.0))


def test_positions_alone_and_speeds_alone_are_read() -> None:
    codec = EgmCodec(7)
    assert codec.decode(bytes.fromhex(HEADER + POSITION), 6) == Reference(5, JOINTS, None)
    assert codec.decode(bytes.fromhex(HEADER + SPEED), 6) == Reference(5, None, (-0.5, 0.0, 0.0, 0.0, 2.0, 0.0))


def test_joints_beside_a_pose_are_read_as_abb_libegm_sends_them() -> None:
    pose = entry(2, entry(1, doubles(1, JOINTS)) + entry(2, entry(1, entry(1, 1.0) + entry(2, 1.0) + entry(3, 1.0))))
    assert EgmCodec(7).decode(bytes.fromhex(HEADER) + pose, 6).position == JOINTS


def test_unknown_fields_are_skipped() -> None:
    assert EgmCodec(7).decode(sensor(1, JOINTS) + entry(99, b"from a later RobotWare"), 6).position == JOINTS


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        sensor(1, JOINTS, mtype=2),
        entry(1, entry(1, 5) + entry(3, 4)) + entry(2, doubles(1, JOINTS[:3]) + entry(2, 5)),
        sensor(1),
        sensor(1, JOINTS[:5]),
        sensor(1, (*JOINTS, 7.5)),
        sensor(1, JOINTS, (1.0,)),
    ],
    ids=["empty", "of a robot", "path correction", "without joints", "five joints", "seven joints", "one speed"],
)
def test_what_does_not_correct_six_joints_is_foreign(datagram: bytes) -> None:
    with pytest.raises(ForeignDatagram):
        EgmCodec(7).decode(datagram, 6)


@pytest.mark.parametrize(
    "datagram",
    [
        sensor(1, JOINTS)[:-1],
        b"\xff" * 40,
        b"hello",
        sensor(1, (float("nan"),) * 6),
        sensor(1, (float("inf"),) * 6),
        sensor(1, JOINTS, (1e300,) * 6),
        sensor(1, JOINTS) + entry(2, entry(4, entry(1, 5))),
    ],
    ids=["cut", "ones", "text", "NaN", "infinite", "huge", "clock without usec"],
)
def test_what_is_no_message_or_no_number_is_garbled(datagram: bytes) -> None:
    with pytest.raises(GarbledDatagram):
        EgmCodec(7).decode(datagram, 6)


def test_nothing_is_registered_where_other_egm_packages_of_the_process_register() -> None:
    EgmCodec(6), EgmCodec(7)
    with pytest.raises(KeyError):
        descriptor_pool.Default().FindMessageTypeByName("rtcp.virtual.egm.EgmRobot")
