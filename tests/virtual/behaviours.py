"""Behaviours as a user writes them for a segment."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rtcp.virtual.behaviour import Behaviour, FileBusy, FileRefused, FoeError, Option, SdoAbort


class Echo(Behaviour):
    """Answers outputs of the device with two sync managers a direction."""

    options = {"gain": Option(1, 0, 10, "factor of the counter", whole=True)}

    def on_outputs(self, dt: float) -> None:
        self[0x6000, 1] = -int(self.option("gain")) * self[0x7000, 1]
        self[0x6000, 2] = 0.5 * self[0x7000, 2]
        self[0x6010] = sum(self[0x7010])


class Talkative(Behaviour):
    """Refuses, answers and reports."""

    def on_sdo_read(self, index: int, subindex: int) -> int | None:
        return 4711 if (index, subindex) == (0x6064, 0) else None

    def on_sdo_write(self, index: int, subindex: int, value: object) -> None:
        if index == 0x607A and value == 13:
            raise SdoAbort(0x06090030)
        if index == 0x607A:
            self.emergency(0x5000, data=b"late")

    def on_file(self, name: str, data: bytes) -> None:
        if name == "secret":
            raise FileRefused(FoeError.NO_RIGHTS, "not yours")
        if name == "slow" and not self.files.get("asked"):
            self.files["asked"] = b"once"
            raise FileBusy(1, 2)
        self.files[name] = data


class Raises(Behaviour):
    """Fails in OP."""

    def on_outputs(self, dt: float) -> None:
        if self.outputs_valid:
            raise RuntimeError("out of order")


class Hangs(Behaviour):
    """Never returns in OP, and catches every Exception."""

    def on_outputs(self, dt: float) -> None:
        while self.outputs_valid:
            try:
                time.sleep(0)
            except Exception:
                continue


class Swallows(Behaviour):
    """Never returns, and catches everything."""

    def on_outputs(self, dt: float) -> None:
        while True:
            try:
                time.sleep(0.001)
            except:  # noqa: E722
                continue


class HangsInC(Behaviour):
    """Stays in C code."""

    def on_outputs(self, dt: float) -> None:
        sum(range(10**11))


class Breaks(Behaviour):
    """Breaks the slave's own state."""

    def on_outputs(self, dt: float) -> None:
        if self.outputs_valid:
            self.device.objects = None
            self.fail()


class Rubbish(Behaviour):
    """Returns or raises whatever `act` does."""

    act: Callable[[], Any]

    def read_file(self, name: str) -> Any:
        return self.act()

    def on_sdo_read(self, index: int, subindex: int) -> Any:
        return self.act()


class FailsEverywhere(Behaviour):
    """Raises in every hook of services."""

    def on_sdo_read(self, index: int, subindex: int) -> int | None:
        if index == 0x6064:
            raise KeyError(index)
        return None

    def on_sdo_write(self, index: int, subindex: int, value: object) -> None:
        self[0x6041] = 1 << 20

    def on_file(self, name: str, data: bytes) -> None:
        raise SystemExit
