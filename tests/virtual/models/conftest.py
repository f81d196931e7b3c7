"""A bench for a virtual drive: its objects in simulated time, without bus and socket."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from rtcp.virtual import coe as sdo_access
from rtcp.virtual.models import CubemarsDrive, create

OP = 8
COUNTS = 10000
STATES = {
    0x00: "not ready",
    0x40: "disabled",
    0x21: "ready",
    0x23: "switched on",
    0x27: "enabled",
    0x07: "quick stop",
    0x0F: "fault reaction",
    0x08: "fault",
}


class Bench:
    """One drive in OP, by default with the self-test behind it. Values are those on the wire, in counts."""

    def __init__(self, model: str = "orh70", step: float = 0.0005, started: bool = True, **options: object) -> None:
        device = create(f"cubemars-{model}", **options)
        assert isinstance(device, CubemarsDrive)
        self.drive = device
        self.dt = step
        device.set_outputs_valid(True)
        if started:
            self.until(lambda: self.state == "disabled", 1.0)

    def __getitem__(self, key: int | tuple[int, int]) -> int:
        index, subindex = key if isinstance(key, tuple) else (key, 0)
        return int(self.drive.objects[index, subindex].value)

    def __setitem__(self, key: int | tuple[int, int], value: int) -> None:
        """Set an entry as process data do: without the checks of an SDO."""
        index, subindex = key if isinstance(key, tuple) else (key, 0)
        self.drive.objects[index, subindex].value = value

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an entry as an SDO does."""
        sdo_access.write(self.drive.objects, index, subindex, False, OP, data)

    @property
    def state(self) -> str:
        return STATES[self[0x6041] & (0x6F if self[0x6041] & 0x08 == 0 else 0x4F)]

    @property
    def position(self) -> float:
        return self[0x6064] / COUNTS

    @property
    def velocity(self) -> float:
        return self[0x606C] / COUNTS

    def bit(self, number: int) -> bool:
        return bool(self[0x6041] >> number & 1)

    def run(self, seconds: float, each: Callable[[float], None] | None = None) -> None:
        """Let time pass; `each` is called with the time before every step."""
        for n in range(round(seconds / self.dt)):
            if each is not None:
                each(n * self.dt)
            self.drive.step(self.dt)

    def largest(self, seconds: float, value: Callable[[], float]) -> float:
        """Let time pass; return the largest value, at least 0."""
        values = [0.0]
        self.run(seconds, lambda _: values.append(value()))
        return max(values)

    def until(self, condition: Callable[[], bool], seconds: float) -> float:
        """Step until `condition`; return the time it took, and fail after `seconds`."""
        for n in range(round(seconds / self.dt)):
            if condition():
                return n * self.dt
            self.drive.step(self.dt)
        raise AssertionError(f"not within {seconds} s; statusword 0x{self[0x6041]:04X}, position {self.position}")

    def control(self, controlword: int) -> str:
        """Send one controlword for one cycle; return the state that the statusword then shows."""
        self[0x6040] = controlword
        self.drive.step(self.dt)
        return self.state

    def enabled(self, mode: int) -> Bench:
        """Go to Operation Enabled in `mode`, with target = actual and, in CSP, a generous speed limit."""
        self[0x6060] = mode
        self[0x607A] = self[0x6064]
        self[0x60FF] = 30000 if mode == 8 else 0
        assert [self.control(word) for word in (6, 7, 15)] == ["ready", "switched on", "enabled"]
        return self

    def set_in_motion(self, mode: int) -> None:
        """Command a motion in any mode and see that the joint moves."""
        self[0x6098] = 34
        # A slow search finds no index before the stop.
        self[0x6099, 2] = 300
        self[0x607A] = 30000
        self[0x60FF] = 5000
        self[0x6071] = 30000
        self.control(0x1F if mode in (1, 6) else 0x0F)
        self.run(0.3)
        assert abs(self.velocity) > 0.01

    def expect_fault(self, code: int, register: int) -> None:
        """Wait for Fault; see that error code, register, history and emergency say so and the torque is off."""
        self.until(lambda: self.state == "fault", 5.0)
        assert (self[0x603F], self[0x1003], self[0x1003, 1]) == (code, 1, code)
        assert self[0x1001] & register == register
        assert [emergency.error_code for emergency in self.drive.emergencies] == [code]
        assert not self.drive.powered
        assert self[0x6077] == 0

    def smooth_move(self, distance: float, seconds: float, each: Callable[[], None] | None = None) -> None:
        """Stream a fifth-order polynomial to a place `distance` rad away, as a master in CSP does."""
        start = self.position

        def stream(t: float) -> None:
            if each is not None:
                each()
            s = min(1.0, t / seconds)
            self[0x607A] = round((start + distance * s**3 * (10 - 15 * s + 6 * s * s)) * COUNTS)

        self.run(seconds + 0.3, stream)


Maker = type[Bench]


@pytest.fixture
def drive() -> Maker:
    """Return the class of the bench: `drive("orh40", friction=1.0)` makes one."""
    return Bench
