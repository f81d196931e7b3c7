"""Frames that have no business on the cable: other protocols, and what only looks like EtherCAT."""

from __future__ import annotations

import struct
from collections.abc import Callable
from random import Random
from types import MappingProxyType

from rtcp.virtual.protocol import DATAGRAM_HEADER, ETHERTYPE, HEADER, LENGTH_MASK, MORE_FOLLOWS

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


def make(protocol: str, random: Random) -> bytes:
    """Return the next frame of a protocol, or of any."""
    return MAKERS[random.choice(tuple(MAKERS)) if protocol == "any" else protocol](random)
