"""Encoder and decoder of Simple Message frames, without sockets.

A frame is `length, msg_type, comm_type, reply_code`, int32 each, and a body; the length excludes itself (REP-I0006).
Frames have no start mark and no checksum: after one wrong length the stream cannot be read any more.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from rtcp.fieldbus.simple_message import messages

LEAST_LENGTH = 12
MOST_LENGTH = 1023
"""Greatest length: the reference client receives into 1024 bytes without a check."""
_LENGTH_BYTES = 4


class FrameError(Exception):
    """Invalid bytes: the rest of the connection cannot be read."""


class LengthError(FrameError):
    """A length outside 12..1023, also due to the other byte order."""

    def __init__(self, head: bytes, order: messages.ByteOrder | None) -> None:
        readings = " or ".join(
            f"{_length(head, each)} ({each.name.lower()} endian)" for each in ([order] if order else messages.ByteOrder)
        )
        super().__init__(f"length {readings} is outside {LEAST_LENGTH}..{MOST_LENGTH}")


class HeaderError(FrameError):
    """An unknown communication type, or a reply code that does not match it."""


class TruncatedFrameError(FrameError):
    """The connection ended within a frame."""


@dataclass(frozen=True)
class Frame:
    """One frame; its message type may be unknown."""

    msg_type: int
    comm_type: messages.CommType
    reply_code: messages.ReplyCode
    body: bytes = b""

    @classmethod
    def topic(cls, message: messages.Message, order: messages.ByteOrder) -> Frame:
        """Return the frame of a message without an answer; raises MessageError."""
        return cls(message.TYPE, messages.CommType.TOPIC, messages.ReplyCode.INVALID, message.pack(order))

    @classmethod
    def request(cls, message: messages.Message, order: messages.ByteOrder) -> Frame:
        """Return the frame of a message that the peer answers; raises MessageError."""
        return cls(message.TYPE, messages.CommType.SERVICE_REQUEST, messages.ReplyCode.INVALID, message.pack(order))

    def reply(self, code: messages.ReplyCode, body: bytes = b"") -> Frame:
        """Return the answer to this request."""
        return Frame(self.msg_type, messages.CommType.SERVICE_REPLY, code, body)

    def pack(self, order: messages.ByteOrder) -> bytes:
        """Return the bytes; raises MessageError for a length above 1023."""
        length = LEAST_LENGTH + len(self.body)
        if length > MOST_LENGTH:
            raise messages.MessageError(f"message {self.msg_type}: length {length} is above {MOST_LENGTH}")
        return struct.pack(f"{order.value}4i", length, self.msg_type, self.comm_type, self.reply_code) + self.body

    def message(self, order: messages.ByteOrder) -> messages.Message:
        """Return its message; raises MessageError."""
        return messages.unpack_message(
            self.msg_type, self.body, order, self.comm_type is messages.CommType.SERVICE_REPLY
        )

    @property
    def name(self) -> str:
        """Name of the message type, or its number where it is unknown."""
        known = self.msg_type in messages.MessageType._value2member_map_
        return messages.MessageType(self.msg_type).name if known else f"message {self.msg_type}"


class FrameDecoder:
    """Splits a stream of bytes into frames.

    Args:
        order: byte order of the peer; None: the one in which the first length lies in 12..1023.

    Attributes:
        order: byte order; None before it is known.
    """

    def __init__(self, order: messages.ByteOrder | None = None) -> None:
        self.order = order
        self._bytes = bytearray()

    def feed(self, data: bytes) -> Iterator[Frame]:
        """Add bytes; the iterator yields the frames that are complete now and raises FrameError."""
        self._bytes += data
        return self._frames()

    def end(self) -> None:
        """Mark the end of the connection; raises TruncatedFrameError within a frame."""
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


def _length(head: bytes, order: messages.ByteOrder) -> int:
    return int.from_bytes(head, "little" if order is messages.ByteOrder.LITTLE else "big", signed=True)


def _order_of(head: bytes) -> messages.ByteOrder:
    for order in messages.ByteOrder:
        if LEAST_LENGTH <= _length(head, order) <= MOST_LENGTH:
            return order
    raise LengthError(head, None)


def _frame(data: bytes, order: messages.ByteOrder) -> Frame:
    _, msg_type, comm_type, reply_code = struct.unpack_from(f"{order.value}4i", data)
    is_reply = comm_type == messages.CommType.SERVICE_REPLY
    codes = (messages.ReplyCode.SUCCESS, messages.ReplyCode.FAILURE) if is_reply else (messages.ReplyCode.INVALID,)
    if comm_type not in messages.CommType._value2member_map_ or reply_code not in codes:
        raise HeaderError(f"message {msg_type}: comm_type {comm_type} with reply_code {reply_code} does not exist")
    return Frame(msg_type, messages.CommType(comm_type), messages.ReplyCode(reply_code), data[16:])
