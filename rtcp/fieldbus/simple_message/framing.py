"""Frames of Simple Message: bytes in, frames out. No sockets here.

A frame is `length, msg_type, comm_type, reply_code`, int32 each, and a body; the length counts all but itself
(REP-I0006). Frames have no mark and no checksum: after one wrong length nothing can be read any more.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from rtcp.fieldbus.simple_message.messages import (
    ByteOrder,
    CommType,
    Message,
    MessageError,
    MessageType,
    ReplyCode,
    unpack_message,
)

LEAST_LENGTH = 12
MOST_LENGTH = 1023
"""The reference client receives into 1024 bytes and does not check."""
_LENGTH_BYTES = 4


class FrameError(Exception):
    """Bytes that are no frame: the connection cannot be read on."""


class LengthError(FrameError):
    """A length outside 12..1023, negative ones among them; also a frame in the other byte order."""

    def __init__(self, head: bytes, order: ByteOrder | None) -> None:
        readings = " or ".join(
            f"{_length(head, each)} ({each.name.lower()} endian)" for each in ([order] if order else ByteOrder)
        )
        super().__init__(f"length {readings} is outside {LEAST_LENGTH}..{MOST_LENGTH}")


class HeaderError(FrameError):
    """A kind of communication that does not exist, or a reply code that does not belong to it."""


class TruncatedFrameError(FrameError):
    """The connection ended within a frame."""


@dataclass(frozen=True)
class Frame:
    """One frame; the numbers of its message may be unknown ones."""

    msg_type: int
    comm_type: CommType
    reply_code: ReplyCode
    body: bytes = b""

    @classmethod
    def topic(cls, message: Message, order: ByteOrder) -> Frame:
        """Return a message that nobody answers; raises MessageError."""
        return cls(message.TYPE, CommType.TOPIC, ReplyCode.INVALID, message.pack(order))

    @classmethod
    def request(cls, message: Message, order: ByteOrder) -> Frame:
        """Return a message that the peer answers; raises MessageError."""
        return cls(message.TYPE, CommType.SERVICE_REQUEST, ReplyCode.INVALID, message.pack(order))

    def reply(self, code: ReplyCode, body: bytes = b"") -> Frame:
        """Return the answer to this request."""
        return Frame(self.msg_type, CommType.SERVICE_REPLY, code, body)

    def pack(self, order: ByteOrder) -> bytes:
        """Return the bytes; raises MessageError for a length above 1023."""
        length = LEAST_LENGTH + len(self.body)
        if length > MOST_LENGTH:
            raise MessageError(f"message {self.msg_type}: length {length} is above {MOST_LENGTH}")
        return struct.pack(f"{order.value}4i", length, self.msg_type, self.comm_type, self.reply_code) + self.body

    def message(self, order: ByteOrder) -> Message:
        """Return what it carries; raises MessageError."""
        return unpack_message(self.msg_type, self.body, order, self.comm_type is CommType.SERVICE_REPLY)

    @property
    def name(self) -> str:
        """Name of the message, or its number where it is unknown."""
        known = self.msg_type in MessageType._value2member_map_
        return MessageType(self.msg_type).name if known else f"message {self.msg_type}"


class FrameDecoder:
    """Cuts a stream of bytes into frames.

    Args:
        order: of the peer; None: that in which the first length lies in 12..1023, which only one can.

    Attributes:
        order: None before it is known.
    """

    def __init__(self, order: ByteOrder | None = None) -> None:
        self.order = order
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Take bytes, and return the frames that are complete now; going through them raises FrameError."""
        self._bytes += data
        return self._frames()

    def end(self) -> None:
        """The connection has ended; raises TruncatedFrameError within a frame."""
        if self._bytes:
            raise TruncatedFrameError(f"it ended after {len(self._bytes)} bytes of a frame")

    def _frames(self) -> Iterator[Frame]:
        while len(self._bytes) >= _LENGTH_BYTES:
            head = bytes(self._bytes[:_LENGTH_BYTES])
            order = self.order = self.order or _order_of(head)
            length = _length(head, order)
            if not LEAST_LENGTH <= length <= MOST_LENGTH:
                raise LengthError(head, order)
            if len(self._bytes) < (end := _LENGTH_BYTES + length):
                return
            frame = bytes(self._bytes[:end])
            del self._bytes[:end]
            yield _frame(frame, order)


def _length(head: bytes, order: ByteOrder) -> int:
    return int.from_bytes(head, "little" if order is ByteOrder.LITTLE else "big", signed=True)


def _order_of(head: bytes) -> ByteOrder:
    for order in ByteOrder:
        if LEAST_LENGTH <= _length(head, order) <= MOST_LENGTH:
            return order
    raise LengthError(head, None)


def _frame(data: bytes, order: ByteOrder) -> Frame:
    _, msg_type, comm_type, reply_code = struct.unpack_from(f"{order.value}4i", data)
    is_reply = comm_type == CommType.SERVICE_REPLY
    codes = (ReplyCode.SUCCESS, ReplyCode.FAILURE) if is_reply else (ReplyCode.INVALID,)
    if comm_type not in CommType._value2member_map_ or reply_code not in codes:
        raise HeaderError(f"message {msg_type}: comm_type {comm_type} with reply_code {reply_code} does not exist")
    return Frame(msg_type, CommType(comm_type), ReplyCode(reply_code), data[16:])
