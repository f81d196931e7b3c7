"""A port for registers whose frames reach virtual slave controllers without a socket between."""

from __future__ import annotations

from rtcp.fieldbus.registers import Answer, DatagramCommand, RegisterPort, build_frame
from rtcp.virtual.segment import Segment


class Direct(RegisterPort):
    """Exchanges frames with `segment`; those that a test wants lost do not get there."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment
        self._t = 0
        self.lost: set[tuple[DatagramCommand, int]] = set()
        """Command and register of datagrams that get lost."""
        self.hole = 0
        """How many of the next frames get lost, whatever is in them."""

    def exchange(
        self,
        command: DatagramCommand,
        station: int,
        address: int,
        data: bytes,
        *,
        timeout_s: float = 0.02,
        tries: int = 3,
    ) -> Answer:
        if (command, address) in self.lost:
            return Answer(b"", -1)
        if self.hole:
            lost = min(self.hole, tries)
            self.hole -= lost
            if lost == tries:
                return Answer(b"", -1)
        frame = bytearray(build_frame(command, 0x80, station, address, data))
        self._t += 1_000_000
        self._segment.process(frame, len(frame), self._t)
        self._segment.settle(self._t)
        end = 26 + len(data)
        return Answer(bytes(frame[26:end]), int.from_bytes(frame[end : end + 2], "little"))
