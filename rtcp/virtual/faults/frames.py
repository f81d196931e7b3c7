"""Faults of the frames between the segment's socket and its first slave."""

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
"""Upper bound on the lateness of noise, ns; later noise (the process was stopped) is dropped."""


# -- faults of passing frames -------------------------------------------------------------------------


@dataclass
class Loss(StrikingFault, FrameFault):
    """Frames are lost: each with the probability `rate`, or the next `burst` of them and no more.

    Half of them never reach the slaves; the other half is lost on the return path.
    """

    name = "loss"
    counted = ("lost_before", "lost_behind")

    def prepare(self, t: int) -> None:
        """Reset."""
        super().prepare(t)
        self._behind = False

    @property
    def over(self) -> bool:
        """Whether the burst and its answers are complete."""
        return super().over and not self._behind

    def arrives(self) -> bool:
        """Decide whether and where the frame is lost."""
        self._behind = False
        if not self._next():
            return True
        self._behind = self.random.random() < 0.5
        if not self._behind:
            self.counts["lost_before"] += 1
        return self._behind

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Drop the answer if so decided."""
        if not self._behind:
            return answers
        self._behind = False
        self.counts["lost_behind"] += 1
        return []


@dataclass
class AnswerFault(StrikingFault, FrameFault):
    """Base of the faults of answers."""

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Affect some of the answers."""
        passing: list[bytes] = []
        for frame in answers:
            passing += self.strike(frame, t, frames) if self.strikes() else (frame,)
        return passing

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Return the frames to send now in place of `frame`."""
        raise NotImplementedError


@dataclass
class Garble(AnswerFault):
    """`bits` bits of answers are inverted after the last checksum, unnoticed by an Ethernet card."""

    name = "garble"
    counted = ("garbled",)
    stage = 1
    bits: Annotated[int, Ge(1), Le(1000)] = 1

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Invert bits."""
        turned = bytearray(frame)
        count = 8 * len(frame)
        for bit in self.random.sample(range(count), min(self.bits, count)):
            turned[bit >> 3] ^= 1 << (bit & 7)
        return (bytes(turned),)


@dataclass
class Reorder(StrikingFault, FrameFault):
    """An answer arrives after the following one."""

    name = "reorder"
    counted = ("reordered",)
    stage = 2

    def prepare(self, t: int) -> None:
        """Reset."""
        super().prepare(t)
        self._kept: bytes | None = None

    @property
    def over(self) -> bool:
        """Whether the burst is complete and no answer is retained."""
        return super().over and self._kept is None

    def answer(self, answers: list[bytes], t: int, frames: Frames) -> list[bytes]:
        """Retain an answer until the next one is sent."""
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
        """Return the retained answer."""
        frame, self._kept = self._kept, None
        return [] if frame is None else [frame]


@dataclass
class Duplicate(AnswerFault):
    """Answers arrive twice."""

    name = "duplicate"
    counted = ("duplicated",)
    stage = 3

    def strike(self, frame: bytes, t: int, frames: Frames) -> tuple[bytes, ...]:
        """Send it twice."""
        return frame, frame


@dataclass
class Delay(AnswerFault):
    """Answers arrive `ms` late."""

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
    """Frames of other protocols, malformed EtherCAT frames (any of these), or a second master's, at `rate_hz`."""

    name = "noise"
    strikes_passing = False
    rate_hz: Annotated[float, Gt(0), Le(10_000)] = 100.0
    protocol: Literal["arp", "ip", "lldp", "ethercat", "other_master", "other_soem", "any"] = "any"
    seed: Seed = 0

    def prepare(self, t: int) -> None:
        """Reset."""
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
            protocol = self._random.choice(_NOISE) if self.protocol == "any" else self.protocol
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
    """Return an ARP request (RFC 826)."""
    source = b"\x02" + random.randbytes(5)
    request = _ARP.pack(1, 0x0800, 6, 4, 1, source, _address(random), bytes(6), _address(random))
    return _ethernet(random, _BROADCAST, 0x0806, request)


def ip(random: Random) -> bytes:
    """Return a UDP broadcast (RFC 791, 768)."""
    payload = random.randbytes(random.randrange(1, 600))
    udp = _UDP.pack(random.randrange(1024, 65536), 5353, _UDP.size + len(payload), 0) + payload
    header = bytearray(
        _IP.pack(0x45, 0, _IP.size + len(udp), random.randrange(65536), 0, 64, 17, 0, _address(random), b"\xff" * 4)
    )
    total = sum(struct.unpack(">10H", header))
    total = (total & 0xFFFF) + (total >> 16)
    header[10:12] = (~(total + (total >> 16)) & 0xFFFF).to_bytes(2, "big")
    return _ethernet(random, _BROADCAST, 0x0800, bytes(header) + udp)


def lldp(random: Random) -> bytes:
    """Return an LLDP frame: chassis, port, time to live (IEEE 802.1AB, 8.5)."""
    chassis = b"\x02\x07\x04" + b"\x02" + random.randbytes(5)
    port = b"\x04\x04\x05" + f"e{random.randrange(10)}".encode().ljust(3, b"0")
    return _ethernet(random, _LLDP_GROUP, 0x88CC, chassis + port + b"\x06\x02\x00\x78" + b"\x00\x00")


def ethercat(random: Random) -> bytes:
    """Return an invalid frame with the EtherCAT EtherType, which every slave and master must ignore."""
    length = random.randrange(1, 200)
    header = HEADER.pack(random.randrange(15, 256), random.randrange(256), random.randrange(65536),
                         random.randrange(65536), length, 0)  # fmt: skip
    datagram = header + random.randbytes(length) + bytes(2)
    of_datagrams = 1 << 12
    forms: tuple[bytes, ...] = (
        # unknown command; excessive length; other type; datagram longer than the frame
        (len(datagram) | of_datagrams).to_bytes(2, "little") + datagram,
        (LENGTH_MASK | of_datagrams).to_bytes(2, "little") + datagram,
        (len(datagram) | random.randrange(2, 16) << 12).to_bytes(2, "little") + datagram,
        (len(datagram) | of_datagrams).to_bytes(2, "little")
        + datagram[:6] + (LENGTH_MASK | MORE_FOLLOWS).to_bytes(2, "little") + datagram[8:],
        # truncated in the header of the first datagram; random bytes
        (DATAGRAM_HEADER | of_datagrams).to_bytes(2, "little") + header[: random.randrange(DATAGRAM_HEADER)],
        random.randbytes(random.randrange(2, 1500)),
    )  # fmt: skip
    return _ethernet(random, _BROADCAST, ETHERTYPE, random.choice(forms))[:_LONGEST]


def other_master(random: Random, source: bytes = bytes.fromhex("00155d2a4b01")) -> bytes:
    """Return a frame that a second master sent: it reads the AL status of all slaves (ETG.1000.4, 5.4.3)."""
    datagram = HEADER.pack(7, random.randrange(16), 0, 0x0130, 2, 0) + bytes(4)
    frame = _BROADCAST + source + ETHERTYPE.to_bytes(2, "big") + (len(datagram) | 1 << 12).to_bytes(2, "little")
    return (frame + datagram).ljust(_SHORTEST, b"\0")


def other_soem(random: Random) -> bytes:
    """Return a frame of a second master that is SOEM, which sends from an address of its own, not the card's."""
    return other_master(random, b"\x01" * 6)


_NOISE = ("arp", "ip", "lldp", "ethercat")
MAKERS: MappingProxyType[str, Callable[[Random], bytes]] = MappingProxyType(
    {"arp": arp, "ip": ip, "lldp": lldp, "ethercat": ethercat, "other_master": other_master, "other_soem": other_soem}
)
"""Protocol -> function that makes a frame."""
