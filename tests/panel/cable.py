"""A cable between two network namespaces that delays, loses and cuts: frames on veth pairs, real TCP at both ends.

The kernel's own way to do this (tc netem) is not built into every kernel.
"""

from __future__ import annotations

import array
import fcntl
import heapq
import random
import selectors
import socket
import struct
import subprocess
import threading
import time
from pathlib import Path

NEAR, FAR = "10.137.0.1", "10.137.0.2"
_NEAR_END, _FAR_END = "rtcp-near", "rtcp-far"
_ENDS = ("rtcp-cable0", "rtcp-cable1")
_SIOCETHTOOL, _ETHTOOL_STXCSUM = 0x8946, 0x17


class Cable:
    """From this namespace (`NEAR`) to a new one (`FAR`); `delay_s` and `loss` (0 to 1) hold for each way."""

    def __init__(self, namespace: str) -> None:
        self.delay_s, self.loss = 0.0, 0.0
        self._namespace = namespace
        self._ended = threading.Event()
        self._run(f"ip netns add {namespace}")
        for end, interface in zip((_NEAR_END, _FAR_END), _ENDS, strict=True):
            self._run(f"ip link add {end} type veth peer name {interface}")
            self._run(f"ip link set {interface} up")
            _send_whole_checksums(end)
        self._run(f"ip addr add {NEAR}/24 dev {_NEAR_END}")
        self._run(f"ip link set {_NEAR_END} up")
        self._run(f"ip link set {_FAR_END} netns {namespace}")
        self._run(f"ip -n {namespace} addr add {FAR}/24 dev {_FAR_END}")
        self._run(f"ip -n {namespace} link set {_FAR_END} up")
        self._run(f"ip -n {namespace} link set lo up")
        self._sockets = [socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3)) for _ in _ENDS]
        for port, end in zip(self._sockets, _ENDS, strict=True):
            port.bind((end, 0))
            port.setblocking(False)
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def far(self, program: str, directory: Path) -> Path:
        """Write a script that runs a program at the far end; return its path."""
        script = directory / "far"
        script.write_text(f'#!/bin/sh\nexec ip netns exec {self._namespace} {program} "$@"\n')
        script.chmod(0o700)
        return script

    def cut(self) -> None:
        """Cut the cable."""
        self.loss = 1.0

    def close(self) -> None:
        """Remove everything."""
        self._ended.set()
        self._thread.join()
        for port in self._sockets:
            port.close()
        subprocess.run(["ip", "link", "del", _NEAR_END], check=False)
        subprocess.run(["ip", "link", "del", _ENDS[1]], check=False)
        subprocess.run(["ip", "netns", "del", self._namespace], check=False)

    def _carry(self) -> None:
        chance = random.Random(1)
        waiting: list[tuple[float, int, int, bytes]] = []
        count = 0
        with selectors.DefaultSelector() as selector:
            for at, port in enumerate(self._sockets):
                selector.register(port, selectors.EVENT_READ, at)
            while not self._ended.is_set():
                wait_s = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 0.05
                for key, _ in selector.select(min(wait_s, 0.05)):
                    frame, (_, _, kind, *_) = self._sockets[key.data].recvfrom(65536)
                    if kind != socket.PACKET_OUTGOING and chance.random() >= self.loss:
                        count += 1
                        heapq.heappush(waiting, (time.monotonic() + self.delay_s, count, 1 - key.data, frame))
                while waiting and waiting[0][0] <= time.monotonic():
                    _, _, to, frame = heapq.heappop(waiting)
                    self._sockets[to].send(frame)

    @staticmethod
    def _run(command: str) -> None:
        subprocess.run(command.split(), check=True, capture_output=True)


def _send_whole_checksums(interface: str) -> None:
    """Switch off offloading: the kernel completes each frame, which is forwarded unchanged."""
    value = array.array("I", [_ETHTOOL_STXCSUM, 0])
    address, _ = value.buffer_info()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, _SIOCETHTOOL, struct.pack("16sP", interface.encode(), address))
