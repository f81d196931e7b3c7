"""The kinds of faults of the frames between the segment's socket and its first slave."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from types import MappingProxyType
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le

from rtcp.virtual.faults.fault import MOST_AT_ONCE, FrameFault, Frames, Seed, Send, StrikingFault
from rtcp.virtual.protocol import DATAGRAM_HEADER, ETHERTYPE, HEADER, LENGTH_MASK, MORE_FOLLOWS

LONGEST_BEHIND = 20_000_000
"""Noise that is late by more than this many ns, because the process was stopped, is left out."""


# -- the kinds that strike frames that pass -------------------------------------------------------------------------


@dataclass
class Loss(StrikingFault, FrameFault):
    """Frames are lost: each with the probability `rate`, or the next `burst` of them and no more.

    Half of what is lost never reaches the slaves, the other half is lost on its way back.
    """

    name = "loss"
    counted = ("lost_before", "lost_behind")

    def prepare(self, t: int) -> None:
        """Begin anew."""
        super().prepare(t)
        self._behind = False

    @property
    def over(self) -> bool:
        """Whether the burst has passed, and the answers that it takes."""
        return super().over and not self._behind

    def arrives(self) -> bool:
        """Choose whether the frame is lost, and where."""
        self._behind = False
        if not self._next():
            return True
        self._behind = self.random.random() < 0.5
        if not self._behind:
            self.counts["lost_before"] += 1
        return self._behind

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Lose the answer, where that was chosen."""
        if not self._behind:
            return answers
        self._behind = False
        self.counts["lost_behind"] += 1
        return []


@dataclass
class AnswerFault(StrikingFault, FrameFault):
    """Base of the faults that strike answers alone."""

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Strike some of the answers."""
        passing: list[bytes] = []
        for frame in answers:
            passing += self.strike(frame, t, frames) if self.strikes() else (frame,)
        return passing

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Return what goes back to the master now instead of `frame`."""
        raise NotImplementedError


@dataclass
class Garble(AnswerFault):
    """`bits` bits of answers are turned over behind the last checksum: what no Ethernet card would notice."""

    name = "garble"
    counted = ("garbled",)
    stage = 1
    bits: Annotated[int, Ge(1), Le(1000)] = 1

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Turn bits over."""
        turned = bytearray(frame)
        count = 8 * len(frame)
        for bit in self.random.sample(range(count), min(self.bits, count)):
            turned[bit >> 3] ^= 1 << (bit & 7)
        return (bytes(turned),)


@dataclass
class Reorder(StrikingFault, FrameFault):
    """An answer comes after the one that follows it."""

    name = "reorder"
    counted = ("reordered",)
    stage = 2

    def prepare(self, t: int) -> None:
        """Begin anew."""
        super().prepare(t)
        self._kept: bytes | None = None

    @property
    def over(self) -> bool:
        """Whether the burst has passed, and nothing is kept of it."""
        return super().over and self._kept is None

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Keep one answer until the next one has gone."""
        passing: list[bytes] = []
        for frame in answers:
            if self._kept is not None:
                passing += [frame, self._kept]
                self._kept = None
            elif self.strikes():
                self._kept = frame
            else:
                passing.append(frame)
        return passing

    def kept(self) -> list[bytes]:
        """Return the answer that it has kept."""
        kept, self._kept = self._kept, None
        return [] if kept is None else [kept]


@dataclass
class Duplicate(AnswerFault):
    """Answers come twice."""

    name = "duplicate"
    counted = ("duplicated",)
    stage = 3

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Send it twice."""
        return frame, frame


@dataclass
class Delay(AnswerFault):
    """Answers come `ms` late."""

    name = "delay"
    counted = ("delayed",)
    stage = 4
    ms: Annotated[float, Gt(0), Le(1000)]

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Send it later."""
        frames.send_later(frame, t + round(self.ms * 1e6))
        return ()


# -- noise ----------------------------------------------------------------------------------------------------------


@dataclass
class Noise(FrameFault):
    """Frames of other protocols, and malformed ones of EtherCAT's type, `rate_hz` of them a second."""

    name = "noise"
    strikes_passing = False
    rate_hz: Annotated[float, Gt(0), Le(10_000)] = 100.0
    protocol: Literal["arp", "ip", "lldp", "ethercat", "any"] = "any"
    seed: Seed = 0

    def prepare(self, t: int) -> None:
        """Begin anew."""
        self._random = Random(self.seed)
        self._period = max(1, round(1e9 / self.rate_hz))
        self.due = t + self._period
        self.counts: dict[str, int] = {"sent": 0}

    def tick(self, now: int, send: Send) -> None:
        """Send what is due."""
        if now - self.due > LONGEST_BEHIND:
            self.due = now
        for _ in range(MOST_AT_ONCE):
            if self.due > now:
                break
            self.due += self._period
            protocol = self._random.choice(tuple(MAKERS)) if self.protocol == "any" else self.protocol
            send(MAKERS[protocol](self._random))
            self.counts["sent"] += 1


_BROADCAST = b"\xff" * 6
_LLDP_GROUP = bytes.fromhex("0180c200000e")
"""Nearest bridge (IEEE 802.1AB, 7.1)."""
_SHORTEST, _LONGEST = 60, 1514
_ARP = struct.Struct(">HHBBH6s4s6s4s")
_IP = struct.Struct(">BBHHHBBH4s4s")
_UDP = struct.Struct(">HHHH")


def _ethernet(random: Random, to: bytes, ethertype: int, content: bytes) -> bytes:
    source = b"\x02" + random.randbytes(5)
    return (to + source + ethertype.to_bytes(2, "big") + content).ljust(_SHORTEST, b"\0")


def _address(random: Random) -> bytes:
    return bytes((192, 168, random.randrange(256), random.randrange(1, 255)))


def arp(random: Random) -> bytes:
    """Return a request for somebody's address (RFC 826)."""
    source = b"\x02" + random.randbytes(5)
    asked = _ARP.pack(1, 0x0800, 6, 4, 1, source, _address(random), bytes(6), _address(random))
    return _ethernet(random, _BROADCAST, 0x0806, asked)


def ip(random: Random) -> bytes:
    """Return a UDP datagram to everybody (RFC 791, 768)."""
    said = random.randbytes(random.randrange(1, 600))
    udp = _UDP.pack(random.randrange(1024, 65536), 5353, _UDP.size + len(said), 0) + said
    header = bytearray(
        _IP.pack(0x45, 0, _IP.size + len(udp), random.randrange(65536), 0, 64, 17, 0, _address(random), b"\xff" * 4)
    )
    total = sum(struct.unpack(">10H", header))
    total = (total & 0xFFFF) + (total >> 16)
    header[10:12] = (~(total + (total >> 16)) & 0xFFFF).to_bytes(2, "big")
    return _ethernet(random, _BROADCAST, 0x0800, bytes(header) + udp)


def lldp(random: Random) -> bytes:
    """Return what a switch tells its neighbour: chassis, port, how long that holds (IEEE 802.1AB, 8.5)."""
    chassis = b"\x02\x07\x04" + b"\x02" + random.randbytes(5)
    port = b"\x04\x04\x05" + f"e{random.randrange(10)}".encode().ljust(3, b"0")
    return _ethernet(random, _LLDP_GROUP, 0x88CC, chassis + port + b"\x06\x02\x00\x78" + b"\x00\x00")


def ethercat(random: Random) -> bytes:
    """Return a frame of EtherCAT's type that no slave and no master may take for one."""
    length = random.randrange(1, 200)
    header = HEADER.pack(random.randrange(15, 256), random.randrange(256), random.randrange(65536),
                         random.randrange(65536), length, 0)  # fmt: skip
    datagram = header + random.randbytes(length) + bytes(2)
    of_datagrams = 1 << 12
    forms: tuple[bytes, ...] = (
        # of no known command; longer than it is; of another type; with a datagram longer than the frame
        (len(datagram) | of_datagrams).to_bytes(2, "little") + datagram,
        (LENGTH_MASK | of_datagrams).to_bytes(2, "little") + datagram,
        (len(datagram) | random.randrange(2, 16) << 12).to_bytes(2, "little") + datagram,
        (len(datagram) | of_datagrams).to_bytes(2, "little")
        + datagram[:6] + (LENGTH_MASK | MORE_FOLLOWS).to_bytes(2, "little") + datagram[8:],
        # cut in the header of its first datagram; nothing but chance
        (DATAGRAM_HEADER | of_datagrams).to_bytes(2, "little") + header[: random.randrange(DATAGRAM_HEADER)],
        random.randbytes(random.randrange(2, 1500)),
    )  # fmt: skip
    return _ethernet(random, _BROADCAST, ETHERTYPE, random.choice(forms))[:_LONGEST]


MAKERS: MappingProxyType[str, Callable[[Random], bytes]] = MappingProxyType(
    {"arp": arp, "ip": ip, "lldp": lldp, "ethercat": ethercat}
)
"""What makes a frame, by the protocol's name."""
