"""Digests of what the hot functions return for random inputs: `python -m tests.compiled_results SAMPLES`.

Run once as it is and once with RTCP_PURE=1: the digests must be the same, bit for bit. The inputs include NaN,
infinities, the largest and smallest floats, zeros of both signs, and integers beyond 64 bits.
"""

# ruff: noqa: B023  each call is made before the next inputs are drawn
from __future__ import annotations

import hashlib
import json
import math
import struct
import sys
from collections.abc import Callable, Iterator
from random import Random
from typing import Any

from kinematics import InverseKinematics
from kinematics.capsules import from_box
from kinematics.compiled import BUILD
from kinematics.forward import forward, frames
from kinematics.gravity import gravity_torques
from kinematics.jacobian import jacobian, joint_velocity
from kinematics.solution import six
from rtcp.config import default_config, load
from rtcp.control.cycle import make_drives
from rtcp.control.part import make_devices
from rtcp.devices.cia402 import Cia402Drive
from rtcp.devices.drive import TargetState
from rtcp.devices.io_box import IoBox
from rtcp.motion.controllers.jog import ScaledTwist, TwistRamp
from rtcp.motion.controllers.jog_inverse import JogInverse
from rtcp.motion.drive_writers import CspWriter, CstWriter, CsvWriter
from rtcp.motion.guards.braking import fastest_stoppable, travel
from rtcp.motion.guards.output_limiter import OutputLimiter
from rtcp.motion.guards.supervision import Supervision
from rtcp.motion.guards.trajectory_guard import TrajectoryGuard
from rtcp.motion.guards.zones import Zones, inside
from rtcp.motion.limits import Limits
from rtcp.motion.planning.interpolation import cubic, quaternion, quintic, turn_between, turned_by, value
from rtcp.motion.state import ArmState, Setpoint
from rtcp.realtime.discipline import Discipline

BLOCK = 1000
"""Samples of a digest."""
SPECIAL: tuple[float, ...] = (
    0.0, -0.0, math.nan, math.inf, -math.inf, 1.7e308, -1.7e308, 5e-324, 1e-300, 1.0, 2.0**31, -(2.0**63), 2.0**64,
)  # fmt: skip
SPECIAL_INTS = (0, 1, -1, 2**31 - 1, -(2**31), 2**62 - 1, 2**62, -(2**62) - 1, 2**63 - 1, 2**63, 2**64, 10**30)
DT = 0.0005
CONFIG = load(default_config())
ARM = CONFIG.arm


class Inputs:
    """Random inputs."""

    def __init__(self, seed: int) -> None:
        self.random = Random(seed)

    def number(self, scale: float, special: float = 0.02) -> float:
        if self.random.random() < special:
            return self.random.choice(SPECIAL)
        return self.random.uniform(-scale, scale)

    def six(self, scale: float, special: float = 0.02) -> list[float]:
        return [self.number(scale, special) for _ in range(6)]

    def integer(self, size: int) -> int:
        if self.random.random() < 0.05:
            return self.random.choice(SPECIAL_INTS)
        return self.random.randrange(-size, size)

    def axis(self) -> tuple[float, float, float]:
        return self.number(1.0), self.number(1.0), self.number(1.0)


def flat(result: Any) -> Iterator[float | int | str]:
    """Every number of a result."""
    if result is None:
        yield "None"
    elif isinstance(result, (bool, int, float, str)):
        yield result
    elif isinstance(result, bytes):
        yield result.hex()
    elif isinstance(result, (list, tuple)):
        for part in result:
            yield from flat(part)
    else:
        yield repr(result)


def packed(result: Any) -> bytes:
    """A result, bit for bit; all NaN are the same."""
    parts = []
    for number in flat(result):
        if isinstance(number, float):
            parts.append(b"nan" if math.isnan(number) else struct.pack("<d", number))
        else:
            parts.append(f"{type(number).__name__} {number}".encode())
    return b"|".join(parts)


def kinematic(inputs: Inputs) -> Iterator[tuple[str, Callable[[], Any]]]:
    inverse, jog_inverse = InverseKinematics(ARM), JogInverse(ARM)
    while True:
        q, near, speeds = inputs.six(3.2), inputs.six(3.2), inputs.six(1.0)
        sound = inputs.six(2.0, 0.0)
        beside = [angle + inputs.number(0.002, 0.0) for angle in sound]
        pose = forward(ARM, sound)
        yield "forward", lambda: forward(ARM, q)
        yield "frames", lambda: frames(ARM, q)
        yield "solve_near", lambda: inverse.solve_near(pose, beside)
        yield "solve_near_anywhere", lambda: inverse.solve_near(pose, near)
        yield "jacobian", lambda: jacobian(ARM, q)
        yield "joint_velocity", lambda: joint_velocity(ARM, sound, speeds)
        yield "gravity", lambda: gravity_torques(ARM, q)

        def jog() -> Any:
            usable = jog_inverse.at(frames(ARM, sound if q[0] > 0 else q))
            return usable, jog_inverse.rows, jog_inverse.distance, jog_inverse.rate, jog_inverse.lost

        yield "jog_inverse", jog


def motions(inputs: Inputs) -> Iterator[tuple[str, Callable[[], Any]]]:
    limits = Limits(CONFIG)
    guard, limiter, supervision = (
        TrajectoryGuard(CONFIG, limits, DT),
        OutputLimiter(limits, DT),
        Supervision(CONFIG, limits),
    )
    zones = Zones(ARM, limits, 0.01)
    ramp, scaled = TwistRamp(CONFIG.cartesian), ScaledTwist(limits)
    writers = CspWriter(CONFIG.joints, DT), CsvWriter(CONFIG.joints, DT), CstWriter(CONFIG.joints, DT, limits.torque)
    drives = [drive for _, drive in make_drives(CONFIG)]
    state, target = ArmState(6), Setpoint(6)
    while True:
        a, b, c = inputs.number(3.0), inputs.number(1.0), abs(inputs.number(0.01))
        q, v, tau = inputs.six(2.0), inputs.six(0.6), inputs.six(20.0)
        box = six(inputs.number(0.5) for _ in range(6))
        yield "fastest_stoppable", lambda: fastest_stoppable(a, b, c)
        yield "travel", lambda: travel(v, limits.acceleration, zones.reach, DT)
        yield "from_box", lambda: [from_box(zones.before, body, box) for body in range(4)]
        yield "inside", lambda: inside(a, b, c, box)
        yield "zones", lambda: zones.distance(frames(ARM, q))
        yield "clearances", lambda: zones.clearances(frames(ARM, q), 0.3)

        def guarded() -> Any:
            target.position = [x + y * DT for x, y in zip(state.commanded, v, strict=True)]
            target.velocity = v
            result = guard.apply(state, target, a > 0.0)
            shown = int(result), state.commanded, state.commanded_velocity, state.commanded_acceleration, guard.held
            if not all(abs(x) < 3.0 for x in state.commanded):
                state.commanded[:] = [0.1] * 6
                guard.latch(state)
            return shown

        yield "trajectory_guard", guarded

        def limited() -> Any:
            for i, drive in enumerate(drives):
                drive.target_position, drive.target_velocity, drive.target_torque = q[i], v[i], tau[i]
            limiter.check(drives)
            return limiter.held, [
                (drive.target_position, drive.target_velocity, drive.target_torque) for drive in drives
            ]

        yield "output_limiter", limited

        def supervised() -> Any:
            state.actual[:], state.actual_velocity[:], state.actual_torque[:] = q, v, tau
            return repr(supervision.check(state))

        yield "supervision", supervised

        def written() -> Any:
            for writer in writers:
                writer.update(q, v, drives)
            return [(drive.target_position, drive.target_velocity, drive.target_torque) for drive in drives]

        yield "drive_writers", written

        def ramped() -> Any:
            ramp.step(v, DT)
            if not all(abs(speed) < 10.0 for speed in ramp.velocity):
                ramp.begin([0.0] * 6)
            return ramp.velocity, ramp.acceleration

        yield "twist_ramp", ramped

        def scaled_twist() -> Any:
            scaled.speeds[:], scaled.twist[:] = v, tau
            return scaled.limit(state, DT), scaled.speeds, scaled.twist

        yield "scaled_twist", scaled_twist
        yield "cubic", lambda: cubic(a, b, q[0], v[0], c)
        yield "quintic", lambda: value(quintic(a, b, c, q[0], v[0], v[1], c), q[2])
        rotation = forward(ARM, inputs.six(2.0, 0.0)).rotation
        yield "turned_by", lambda: turned_by(rotation, (q[0], q[1], q[2]), a)
        yield "turn_between", lambda: turn_between(quaternion(rotation), q[:4])


def devices(inputs: Inputs) -> Iterator[tuple[str, Callable[[], Any]]]:
    drives = [drive for _, drive in make_drives(CONFIG) if isinstance(drive, Cia402Drive)]
    box = next(device.driver for device in make_devices(CONFIG) if isinstance(device.driver, IoBox))
    discipline = Discipline(500_000, 250_000)
    targets = tuple(TargetState)
    planned = sent = 10**15
    while True:
        drive = inputs.random.choice(drives)
        image = inputs.random.randbytes(drive.input_bytes)
        numbers, goal, mode = inputs.six(20.0, 0.1), inputs.random.choice(targets), inputs.random.choice((8, 9, 10))

        def exchanged() -> Any:
            drive.decode(image)
            drive.mode = mode
            drive.target_position, drive.target_velocity, drive.target_torque = numbers[:3]
            reached = drive.advance(goal)
            shown = (
                drive.position,
                drive.velocity,
                drive.torque,
                drive.statusword,
                drive.state.value,
                drive.mode_display,
            )
            return reached, shown, drive.controlword, drive.encode()

        yield "cia402", exchanged
        inside_box, number = inputs.random.randbytes(box.input_bytes), inputs.random.randrange(0, 16)

        def boxed() -> Any:
            box.decode(inside_box)
            box.set_output(number, numbers[0] > 0)
            return box.inputs, box.outputs, box.counter, box.encode()

        yield "io_box", boxed
        drift, odd = inputs.random.randrange(-2000, 2000), inputs.integer(10**9)
        odd = odd if inputs.random.random() < 0.02 else 0

        def disciplined() -> Any:
            nonlocal planned, sent
            sent += 500_000 + drift
            discipline.observe(sent, sent * 1_000_010 // 1_000_000 + odd)
            if drift % 50 == 0:
                discipline.holdover()
            planned = discipline.next_wakeup(planned)
            clock = planned, discipline.raw_ns, discipline.filtered_ns, discipline.locked, discipline.aligned
            planned = sent
            return clock

        yield "discipline", disciplined


def main() -> int:
    samples = int(sys.argv[1])
    digests: dict[str, list[str]] = {}
    errors: dict[str, int] = {}
    for source in (kinematic, motions, devices):
        running: dict[str, Any] = {}
        counts: dict[str, int] = {}
        for name, call in source(Inputs(1)):
            try:
                digest = packed(call())
            except (ArithmeticError, ValueError, struct.error) as error:
                # A TypeError ends the run: compiled code would refuse what interpreted code accepts.
                digest = type(error).__name__.encode()
                errors[name] = errors.get(name, 0) + 1
            running.setdefault(name, hashlib.sha256()).update(digest)
            counts[name] = counts.get(name, 0) + 1
            if counts[name] % BLOCK == 0 or counts[name] == samples:
                digests.setdefault(name, []).append(running[name].hexdigest()[:16])
            if len(counts) > 1 and min(counts.values()) == samples:
                break
    print(json.dumps({"is_compiled": BUILD.is_used, "digests": digests, "errors": errors}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
