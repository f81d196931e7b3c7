"""Frames from a stream of bytes in any parts, and streams that are no frames."""

from __future__ import annotations

import contextlib
import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rtcp.fieldbus.simple_message.framing import (
    LEAST_LENGTH,
    MOST_LENGTH,
    Frame,
    FrameDecoder,
    FrameError,
    HeaderError,
    LengthError,
    TruncatedFrameError,
)
from rtcp.fieldbus.simple_message.messages import ByteOrder, CommType, MessageError, Ping, ReplyCode

replies = st.sampled_from([ReplyCode.SUCCESS, ReplyCode.FAILURE])
frames = st.one_of(
    st.builds(
        Frame,
        st.integers(-(1 << 31), (1 << 31) - 1),
        st.sampled_from([CommType.TOPIC, CommType.SERVICE_REQUEST]),
        st.just(ReplyCode.INVALID),
        st.binary(max_size=MOST_LENGTH - LEAST_LENGTH),
    ),
    st.builds(Frame, st.integers(0, 70000), st.just(CommType.SERVICE_REPLY), replies, st.binary(max_size=100)),
)
orders = st.sampled_from(ByteOrder)
PING = Frame.request(Ping(), ByteOrder.LITTLE)


def cut(data: bytes, places: list[int]) -> list[bytes]:
    bounds = sorted({place % (len(data) + 1) for place in places} | {0, len(data)})
    return [data[begin:end] for begin, end in itertools.pairwise(bounds)]


@given(st.lists(frames, max_size=8), orders, st.lists(st.integers(0, 1 << 16), max_size=20))
def test_frames_come_out_as_they_went_in_however_the_stream_is_cut(
    sent: list[Frame], order: ByteOrder, places: list[int]
) -> None:
    decoder = FrameDecoder()
    data = b"".join(frame.pack(order) for frame in sent)
    assert [frame for part in cut(data, places) for frame in decoder.feed(part)] == sent
    decoder.end()
    assert decoder.order is (order if sent else None)


@given(frames, orders, st.integers(1, 1 << 16))
def test_an_end_within_a_frame_is_an_error(frame: Frame, order: ByteOrder, at: int) -> None:
    data = frame.pack(order)
    decoder = FrameDecoder()
    rest = data[: 1 + at % (len(data) - 1)]
    assert list(decoder.feed(rest)) == []
    with pytest.raises(TruncatedFrameError, match=f"{len(rest)} bytes"):
        decoder.end()


@given(st.integers(-(1 << 31), (1 << 31) - 1), orders)
def test_exactly_one_byte_order_fits_a_length_or_none_does(length: int, order: ByteOrder) -> None:
    head = struct.pack(f"{order.value}i", length)
    readings = [struct.unpack(f"{each.value}i", head)[0] for each in ByteOrder]
    fitting = [each for each in readings if LEAST_LENGTH <= each <= MOST_LENGTH]
    decoder = FrameDecoder()
    if fitting:
        assert len(fitting) == 1
        assert list(decoder.feed(head)) == []
    else:
        with pytest.raises(LengthError, match=r"outside 12\.\.1023"):
            list(decoder.feed(head))


@given(frames, st.integers(-(1 << 31), (1 << 31) - 1).filter(lambda n: not 12 <= n <= 1023), orders)
def test_frames_before_a_wrong_length_are_delivered(frame: Frame, length: int, order: ByteOrder) -> None:
    stream = FrameDecoder().feed(frame.pack(order) + struct.pack(f"{order.value}i", length))
    assert next(stream) == frame
    with pytest.raises(LengthError, match=f"length {length} "):
        next(stream)


@given(frames, frames, orders)
def test_a_frame_in_the_other_byte_order_is_an_error(first: Frame, second: Frame, order: ByteOrder) -> None:
    (other,) = set(ByteOrder) - {order}
    stream = FrameDecoder().feed(first.pack(order) + second.pack(other))
    assert next(stream) == first
    with pytest.raises(LengthError):
        next(stream)


def test_a_frame_in_another_order_than_the_option_says_is_an_error() -> None:
    with pytest.raises(LengthError, match="big endian"):
        list(FrameDecoder(ByteOrder.BIG).feed(PING.pack(ByteOrder.LITTLE)))


@pytest.mark.parametrize(("comm_type", "reply_code"), [(0, 0), (4, 0), (-1, 0), (1, 1), (2, 1), (2, 2), (3, 0), (3, 3)])
def test_a_kind_of_communication_that_does_not_exist_is_an_error(comm_type: int, reply_code: int) -> None:
    with pytest.raises(HeaderError, match=f"comm_type {comm_type} with reply_code {reply_code}"):
        list(FrameDecoder().feed(struct.pack("<4i", 12, 1, comm_type, reply_code)))


def test_a_frame_above_1023_bytes_is_not_packed() -> None:
    assert len(Frame(1, CommType.TOPIC, ReplyCode.INVALID, bytes(1011)).pack(ByteOrder.BIG)) == 4 + MOST_LENGTH
    with pytest.raises(MessageError, match="1024 is above 1023"):
        Frame(1, CommType.TOPIC, ReplyCode.INVALID, bytes(1012)).pack(ByteOrder.BIG)


@given(st.lists(st.binary(max_size=60), max_size=10))
def test_any_bytes_are_frames_or_one_error(parts: list[bytes]) -> None:
    decoder = FrameDecoder()
    with contextlib.suppress(FrameError):
        for part in parts:
            for frame in decoder.feed(part):
                assert frame.pack(decoder.order or ByteOrder.LITTLE)
