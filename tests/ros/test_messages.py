"""The bytes of every message, worked out by hand from the layouts, in either byte order."""

from __future__ import annotations

import contextlib
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.fieldbus.simple_message import messages
from rtcp.fieldbus.simple_message.framing import Frame, FrameDecoder

NO, YES = messages.TriState.FALSE, messages.TriState.TRUE
POINT = messages.JointTrajPt(3, (0.5, -0.25, 1.5, 0.0, 0.75, -1.0), 0.25, 0.125)
STOP = messages.JointTrajPt(-4, (), 0.0, 0.0)
POSITION_AND_TIME = messages.ValidFields.TIME | messages.ValidFields.POSITION


def wire(text: str) -> bytes:
    """Bytes from words of hexadecimal digits; `7x0` is seven words of zeros."""
    words = re.sub(r"(\d+)x0\b", lambda match: "00000000 " * int(match[1]), text.replace("|", " "))
    return bytes.fromhex(words)


LITTLE: list[tuple[messages.Message, messages.CommType, str]] = [
    (messages.Ping(), messages.CommType.SERVICE_REQUEST, "0C000000 01000000 02000000 00000000"),
    (messages.GetVersion(), messages.CommType.SERVICE_REQUEST, "0C000000 02000000 02000000 00000000"),
    (
        messages.Status(YES, NO, 0, NO, NO, messages.RobotMode.AUTO, YES),
        messages.CommType.TOPIC,
        "28000000 0D000000 01000000 00000000 | 01000000 2x0 00000000 00000000 02000000 01000000",
    ),
    (
        messages.Status(),
        messages.CommType.TOPIC,
        "28000000 0D000000 01000000 00000000 | FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF FFFFFFFF",
    ),
    (
        POINT,
        messages.CommType.SERVICE_REQUEST,
        "40000000 0B000000 02000000 00000000 | 03000000 0000003F 000080BE 0000C03F 00000000 0000403F 000080BF 4x0"
        " 0000803E 0000003E",
    ),
    (
        messages.JointTrajPtFull(0, 7, POSITION_AND_TIME | messages.ValidFields.VELOCITY, 1.5, (0.5, -2.0), (0.25,)),
        messages.CommType.SERVICE_REQUEST,
        "94000000 0E000000 02000000 00000000 | 00000000 07000000 07000000 0000C03F | 0000003F 000000C0 8x0"
        " | 0000803E 9x0 | 10x0",
    ),
    (
        messages.JointPoint(2, 0.5, (1.0, -2.0), (0.25, 0.0)),
        messages.CommType.SERVICE_REQUEST,
        "40000000 E8FD0000 02000000 00000000 | 02000000 07000000 02000000 00000000 0000E03F"
        " | 00000000 0000F03F 00000000 000000C0 | 00000000 0000D03F 2x0",
    ),
]
BIG: list[tuple[messages.Message, messages.CommType, str]] = [
    (STOP, messages.CommType.SERVICE_REQUEST, "00000040 0000000B 00000002 00000000 | FFFFFFFC 12x0"),
    (
        messages.JointPosition(0, (1.0, -1.5, 2.5)),
        messages.CommType.TOPIC,
        "00000038 0000000A 00000001 00000000 | 00000000 3F800000 BFC00000 40200000 7x0",
    ),
    (
        messages.JointFeedback(0, POSITION_AND_TIME, 0.125, (0.5,)),
        messages.CommType.TOPIC,
        "00000090 0000000F 00000001 00000000 | 00000000 00000003 3E000000 | 3F000000 9x0 | 20x0",
    ),
    (
        messages.JointPoint(-3, 2.0, (1.0,), accelerations=(0.5,)),
        messages.CommType.TOPIC,
        "00000030 0000FDE8 00000001 00000000 | FFFFFFFD 0000000B 00000001 40000000 00000000 | 3FF00000 00000000"
        " | 3FE00000 00000000",
    ),
]
EXAMPLES = [(*each, messages.ByteOrder.LITTLE) for each in LITTLE] + [(*each, messages.ByteOrder.BIG) for each in BIG]


def filled(message: messages.Message) -> messages.Message:
    """The message as it is read: with ten joints."""
    return messages.unpack_message(message.TYPE, message.pack(messages.ByteOrder.BIG), messages.ByteOrder.BIG)


@pytest.mark.parametrize(("message", "comm_type", "text", "order"), EXAMPLES)
def test_a_message_has_the_bytes_of_its_layout(
    message: messages.Message, comm_type: messages.CommType, text: str, order: messages.ByteOrder
) -> None:
    assert Frame(message.TYPE, comm_type, messages.ReplyCode.INVALID, message.pack(order)).pack(order) == wire(text)


@pytest.mark.parametrize(("message", "comm_type", "text", "order"), EXAMPLES)
def test_the_bytes_of_the_layout_are_read_as_the_message(
    message: messages.Message, comm_type: messages.CommType, text: str, order: messages.ByteOrder
) -> None:
    (frame,) = FrameDecoder().feed(wire(text))
    assert frame.comm_type is comm_type
    assert frame.message(order) == filled(message)


def test_the_reply_to_a_stop_is_a_header() -> None:
    reply = Frame.request(STOP, messages.ByteOrder.BIG).reply(messages.ReplyCode.SUCCESS)
    assert reply.pack(messages.ByteOrder.BIG) == wire("0000000C 0000000B 00000003 00000001")


def test_a_version_is_the_reply_to_its_request() -> None:
    data = wire("00000018 00000002 00000003 00000001 | 00000000 00000002 00000009")
    (frame,) = FrameDecoder().feed(data)
    assert frame.message(messages.ByteOrder.BIG) == messages.Version(0, 2, 9)
    assert frame.pack(messages.ByteOrder.BIG) == data


def test_a_ping_with_ten_zeros_is_read_too() -> None:
    (frame,) = FrameDecoder().feed(wire("34000000 01000000 02000000 00000000 | 10x0"))
    assert frame.message(messages.ByteOrder.LITTLE) == messages.Ping()


def test_joints_that_the_message_has_not_are_read_as_zeros() -> None:
    read = filled(POINT)
    assert isinstance(read, messages.JointTrajPt)
    assert read.positions == (*POINT.positions, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("kind", [kind for kind in messages.MessageType if kind is not messages.MessageType.PING])
@pytest.mark.parametrize("change", [-1, 1, 2])
def test_a_body_of_another_length_is_refused(kind: messages.MessageType, change: int) -> None:
    bodies: dict[messages.MessageType, messages.Message] = {message.TYPE: message for message, *_ in EXAMPLES}
    body = bodies[kind].pack(messages.ByteOrder.LITTLE)
    wrong = body[:change] if change < 0 and body else body + bytes(abs(change))
    with pytest.raises(messages.MessageError, match=kind.name):
        messages.unpack_message(kind, wrong, messages.ByteOrder.LITTLE)


@pytest.mark.parametrize(
    ("message", "length"),
    [
        (messages.JointPosition(0, (0.1,) * 12), 64),
        (messages.JointTrajPt(7, (0.5,) * 12, 1.0, 0.25), 72),
        (messages.JointPosition(0, (0.5,)), 56),
    ],
)
def test_twelve_joints_widen_the_message_and_its_type_tells_which_it_is(message: messages.Message, length: int) -> None:
    body = message.pack(messages.ByteOrder.LITTLE)
    assert len(body) == length - 12
    read = messages.unpack_message(message.TYPE, body, messages.ByteOrder.LITTLE)
    assert isinstance(read, (messages.JointPosition, messages.JointTrajPt))
    assert isinstance(message, (messages.JointPosition, messages.JointTrajPt))
    assert read.positions[: len(message.positions)] == pytest.approx(message.positions)


@pytest.mark.parametrize("number", [0, 12, 20, 21, 2001, 65001])
def test_unknown_and_deprecated_numbers_are_refused(number: int) -> None:
    with pytest.raises(messages.MessageError, match=str(number)):
        messages.unpack_message(number, b"", messages.ByteOrder.LITTLE)


@pytest.mark.parametrize(
    "message",
    [
        messages.JointPosition(0, (0.0,) * 25),
        messages.JointPosition(0, (1e39,)),
        messages.JointPosition(1 << 31, (0.0,)),
        messages.JointPoint(0, 0.0, (0.0,) * 125),
        messages.JointPoint(0, 0.0, (0.0, 0.0), (0.0,)),
    ],
)
def test_what_a_message_cannot_carry_is_refused(message: messages.Message) -> None:
    with pytest.raises(messages.MessageError):
        message.pack(messages.ByteOrder.LITTLE)


def test_a_status_with_a_state_that_does_not_exist_is_refused() -> None:
    with pytest.raises(messages.MessageError, match="STATUS: 7"):
        messages.Status.unpack(wire("07000000 6x0"), messages.ByteOrder.LITTLE)


@pytest.mark.parametrize("valid", ["00000000", "01000000", "02000000"])
def test_our_message_has_a_time_and_positions(valid: str) -> None:
    with pytest.raises(messages.MessageError, match="JOINT_POINT"):
        messages.JointPoint.unpack(wire(f"00000000 {valid} 01000000 2x0 2x0"), messages.ByteOrder.LITTLE)


numbers = st.floats(-1e6, 1e6)


@given(st.data(), st.sampled_from(messages.ByteOrder))
def test_our_message_is_read_as_it_was_written(data: st.DataObject, order: messages.ByteOrder) -> None:
    count = data.draw(st.integers(1, 41))
    row = st.lists(numbers, min_size=count, max_size=count).map(tuple)
    optional = st.one_of(st.just(()), row)
    message = messages.JointPoint(
        data.draw(st.integers(-4, 1 << 20)),
        data.draw(numbers),
        data.draw(row),
        data.draw(optional),
        data.draw(optional),
    )
    body = message.pack(order)
    assert len(body) <= messages.MOST_BODY_BYTES
    assert messages.JointPoint.unpack(body, order) == message


@given(
    st.binary(max_size=200), st.sampled_from(messages.MessageType), st.sampled_from(messages.ByteOrder), st.booleans()
)
def test_any_body_is_a_message_or_refused(
    body: bytes, kind: messages.MessageType, order: messages.ByteOrder, is_reply: bool
) -> None:
    with contextlib.suppress(messages.MessageError):
        assert messages.unpack_message(kind, body, order, is_reply).TYPE is kind
