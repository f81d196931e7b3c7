"""A port for registers whose frames reach virtual slave controllers without a socket between."""

from __future__ import annotations

from rtcp.fieldbus.registers import Answer, DatagramCommand, RegisterPort, build_frame
from rtcp.virtual.segment import Segment


class Direct(RegisterPort):
    """Exchanges frames with `segment`; a test may lose some before they arrive."""

    def __init__(self, segment: Segment) -> None:
        self.segment = segment
        self.now = 0
        """Time of the last frame, ns."""
        self.lost: set[tuple[DatagramCommand, int]] = set()
        """Command and register of datagrams that get lost."""
        self.losses = 0
        """Number of the next frames that get lost, whatever their content."""

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
        if self.losses:
            lost = min(self.losses, tries)
            self.losses -= lost
            if lost == tries:
                return Answer(b"", -1)
        frame = bytearray(build_frame(command, 0x80, station, address, data))
        self.now += 1_000_000
        self.segment.process(frame, len(frame), self.now)
        self.segment.settle(self.now)
        end = 26 + len(data)
        return Answer(bytes(frame[26:end]), int.from_bytes(frame[end : end + 2], "little"))
