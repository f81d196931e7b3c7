"""The bytes of every message, worked out by hand from the layouts, in either byte order."""

from __future__ import annotations

import contextlib
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder
from rtcp.fieldbus.simple_message.messages import (
    MOST_BODY_BYTES,
    ByteOrder,
    CommType,
    GetVersion,
    JointFeedback,
    JointPoint,
    JointPosition,
    JointTrajPt,
    JointTrajPtFull,
    Message,
    MessageError,
    MessageType,
    Ping,
    ReplyCode,
    RobotMode,
    Status,
    TriState,
    ValidFields,
    Version,
    unpack_message,
)

NO, YES = TriState.FALSE, TriState.TRUE
POINT = JointTrajPt(3, (0.5, -0.25, 1.5, 0.0, 0.75, -1.0), 0.25, 0.125)
STOP = JointTrajPt(-4, (), 0.0, 0.0)
POSITION_AND_TIME = ValidFields.TIME | ValidFields.POSITION


def wire(text: str) -> bytes:
    """Bytes from words of hexadecimal digits; `7x0` is seven words of zeros."""
    words = re.sub(r"(\d+)x0\b", lambda found: "00000000 " * int(found[1]), text.replace("|", " "))
    return bytes.fromhex(words)


LITTLE = [
    (Ping(), CommType.SERVICE_REQUEST, "0C000000 01000000 02000000 00000000"),
    (GetVersion(), CommType.SERVICE_REQUEST, "0C000000 02000000 02000000 00000000"),
    (
        Status(YES, NO, 0, NO, NO, RobotMode.AUTO, YES),
        CommType.TOPIC,
        "28000000 0D000000 01000000 00000000 | 01000000 2x0 00000000 00000000 02000000 01000000",
    ),
    (
        Status(),
        CommType.TOPIC,
        "28000000 0D000000 01000000 00000000 | FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF",
    ),
    (
        POINT,
        CommType.SERVICE_REQUEST,
        "40000000 0B000000 02000000 00000000 | 03000000 0000003F 000080BE 0000C03F 00000000 0000403F 000080BF 4x0"
        " 0000803E 0000003E",
    ),
    (
        JointTrajPtFull(0, 7, POSITION_AND_TIME | ValidFields.VELOCITY, 1.5, (0.5, -2.0), (0.25,)),
        CommType.SERVICE_REQUEST,
        "94000000 0E000000 02000000 00000000 | 00000000 07000000 07000000 0000C03F | 0000003F 000000C0 8x0"
        " | 0000803E 9x0 | 10x0",
    ),
    (
        JointPoint(2, 0.5, (1.0, -2.0), (0.25, 0.0)),
        CommType.SERVICE_REQUEST,
        "40000000 E8FD0000 02000000 00000000 | 02000000 07000000 02000000 00000000 0000E03F"
        " | 00000000 0000F03F 00000000 000000C0 | 00000000 0000D03F 2x0",
    ),
]
BIG = [
    (STOP, CommType.SERVICE_REQUEST, "00000040 0000000B 00000002 00000000 | FFFFFFFC 12x0"),
    (
        JointPosition(0, (1.0, -1.5, 2.5)),
        CommType.TOPIC,
        "00000038 0000000A 00000001 00000000 | 00000000 3F800000 BFC00000 40200000 7x0",
    ),
    (
        JointFeedback(0, POSITION_AND_TIME, 0.125, (0.5,)),
        CommType.TOPIC,
        "00000090 0000000F 00000001 00000000 | 00000000 00000003 3E000000 | 3F000000 9x0 | 20x0",
    ),
    (
        JointPoint(-3, 2.0, (1.0,), accelerations=(0.5,)),
        CommType.TOPIC,
        "00000030 0000FDE8 00000001 00000000 | FFFFFFFD 0000000B 00000001 40000000 00000000 | 3FF00000 00000000"
        " | 3FE00000 00000000",
    ),
]
EXAMPLES = [(*each, ByteOrder.LITTLE) for each in LITTLE] + [(*each, ByteOrder.BIG) for each in BIG]


def filled(message: Message) -> Message:
    """The message as it is read: with ten joints."""
    return unpack_message(message.TYPE, message.pack(ByteOrder.BIG), ByteOrder.BIG)


@pytest.mark.parametrize(("message", "comm_type", "text", "order"), EXAMPLES)
def test_a_message_has_the_bytes_of_its_layout(
    message: Message, comm_type: CommType, text: str, order: ByteOrder
) -> None:
    assert Frame(message.TYPE, comm_type, ReplyCode.INVALID, message.pack(order)).pack(order) == wire(text)


@pytest.mark.parametrize(("message", "comm_type", "text", "order"), EXAMPLES)
def test_the_bytes_of_the_layout_are_read_as_the_message(
    message: Message, comm_type: CommType, text: str, order: ByteOrder
) -> None:
    (frame,) = FrameDecoder().feed(wire(text))
    assert frame.comm_type is comm_type
    assert frame.message(order) == filled(message)


def test_the_reply_to_a_stop_is_a_header() -> None:
    reply = Frame.request(STOP, ByteOrder.BIG).reply(ReplyCode.SUCCESS)
    assert reply.pack(ByteOrder.BIG) == wire("0000000C 0000000B 00000003 00000001")


def test_a_version_is_the_reply_to_its_request() -> None:
    data = wire("00000018 00000002 00000003 00000001 | 00000000 00000002 00000009")
    (frame,) = FrameDecoder().feed(data)
    assert frame.message(ByteOrder.BIG) == Version(0, 2, 9)
    assert frame.pack(ByteOrder.BIG) == data


def test_a_ping_with_ten_zeros_is_read_too() -> None:
    (frame,) = FrameDecoder().feed(wire("34000000 01000000 02000000 00000000 | 10x0"))
    assert frame.message(ByteOrder.LITTLE) == Ping()


def test_joints_that_the_message_has_not_are_read_as_zeros() -> None:
    read = filled(POINT)
    assert isinstance(read, JointTrajPt)
    assert read.positions == (*POINT.positions, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("kind", [kind for kind in MessageType if kind is not MessageType.PING])
@pytest.mark.parametrize("change", [-1, 1, 2])
def test_a_body_of_another_length_is_refused(kind: MessageType, change: int) -> None:
    bodies: dict[MessageType, Message] = {message.TYPE: message for message, *_ in EXAMPLES}
    body = bodies[kind].pack(ByteOrder.LITTLE)
    wrong = body[:change] if change < 0 and body else body + bytes(abs(change))
    with pytest.raises(MessageError, match=kind.name):
        unpack_message(kind, wrong, ByteOrder.LITTLE)


@pytest.mark.parametrize(
    ("message", "length"),
    [(JointPosition(0, (0.1,) * 12), 64), (JointTrajPt(7, (0.5,) * 12, 1.0, 0.25), 72), (JointPosition(0, (0.5,)), 56)],
)
def test_twelve_joints_widen_the_message_and_its_type_tells_which_it_is(message: Message, length: int) -> None:
    body = message.pack(ByteOrder.LITTLE)
    assert len(body) == length - 12
    read = unpack_message(message.TYPE, body, ByteOrder.LITTLE)
    assert isinstance(read, (JointPosition, JointTrajPt))
    assert isinstance(message, (JointPosition, JointTrajPt))
    assert read.positions[: len(message.positions)] == pytest.approx(message.positions)


@pytest.mark.parametrize("number", [0, 12, 20, 21, 2001, 65001])
def test_unknown_and_deprecated_numbers_are_refused(number: int) -> None:
    with pytest.raises(MessageError, match=str(number)):
        unpack_message(number, b"", ByteOrder.LITTLE)


@pytest.mark.parametrize(
    "message",
    [
        JointPosition(0, (0.0,) * 25),
        JointPosition(0, (1e39,)),
        JointPosition(1 << 31, (0.0,)),
        JointPoint(0, 0.0, (0.0,) * 125),
        JointPoint(0, 0.0, (0.0, 0.0), (0.0,)),
    ],
)
def test_what_a_message_cannot_carry_is_refused(message: Message) -> None:
    with pytest.raises(MessageError):
        message.pack(ByteOrder.LITTLE)


def test_a_status_with_a_state_that_does_not_exist_is_refused() -> None:
    with pytest.raises(MessageError, match="STATUS: 7"):
        Status.unpack(wire("07000000 6x0"), ByteOrder.LITTLE)


@pytest.mark.parametrize("valid", ["00000000", "01000000", "02000000"])
def test_our_message_has_a_time_and_positions(valid: str) -> None:
    with pytest.raises(MessageError, match="JOINT_POINT"):
        JointPoint.unpack(wire(f"00000000 {valid} 01000000 2x0 2x0"), ByteOrder.LITTLE)


numbers = st.floats(-1e6, 1e6)


@given(st.data(), st.sampled_from(ByteOrder))
def test_our_message_is_read_as_it_was_written(data: st.DataObject, order: ByteOrder) -> None:
    count = data.draw(st.integers(1, 41))
    row = st.lists(numbers, min_size=count, max_size=count).map(tuple)
    optional = st.one_of(st.just(()), row)
    message = JointPoint(
        data.draw(st.integers(-4, 1 << 20)),
        data.draw(numbers),
        data.draw(row),
        data.draw(optional),
        data.draw(optional),
    )
    body = message.pack(order)
    assert len(body) <= MOST_BODY_BYTES
    assert JointPoint.unpack(body, order) == message


@given(st.binary(max_size=200), st.sampled_from(MessageType), st.sampled_from(ByteOrder), st.booleans())
def test_any_body_is_a_message_or_refused(body: bytes, kind: MessageType, order: ByteOrder, is_reply: bool) -> None:
    with contextlib.suppress(MessageError):
        assert unpack_message(kind, body, order, is_reply).TYPE is kind
