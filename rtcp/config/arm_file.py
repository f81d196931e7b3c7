"""An arm's file and the segment's beside it, made of a drive's file and of numbers, with the unit beside each value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

from rtcp.config.model import DeviceDescription
from rtcp.config.scaling import OBJECTS_PER_AXIS, DriveScaling
from rtcp.esi.model import Device

_MOST_PARTS = 1_000_000
"""Largest divisor of a ratio in 0x608F, 0x6091 or 0x6092."""


class Quantity(NamedTuple):
    """A number that is asked for each joint."""

    key: str
    unit: str
    meaning: str


QUANTITIES = (
    Quantity("position_min", "rad", "lower end of the range"),
    Quantity("position_max", "rad", "upper end of the range"),
    Quantity("velocity", "rad/s", "largest speed"),
    Quantity("acceleration", "rad/s^2", "largest acceleration"),
    Quantity("jerk", "rad/s^3", "largest jerk"),
    Quantity("torque", "Nm", "largest torque at the joint, behind all gears"),
)
_UNITS = {quantity.key: quantity.unit for quantity in QUANTITIES}
Numbers = Sequence[Mapping[str, float]]
"""For each joint the value of every quantity."""


def places(device: DeviceDescription, joints: int) -> list[tuple[str, int]]:
    """Return for each joint the name of its drive and its axis; the axes of a drive move neighbours."""
    axes = device.axes
    return [(f"drive{n // len(axes) + 1}", axes[n % len(axes)]) for n in range(joints)]


def arm_text(name: str, file: str, device: DeviceDescription, numbers: Numbers, period_us: float, segment: str) -> str:
    """Return the text of an arm's file.

    Args:
        name: of the arm.
        file: name of the drives' file in `devices/`.
        device: its content.
        numbers: limits of each joint.
        period_us: period of the cycle, us.
        segment: name of the segment's file; empty: there is none.
    """
    of_joints = places(device, len(numbers))
    drives = dict.fromkeys(drive for drive, _ in of_joints)
    bus = f"\n  segment: {segment}\n  timeout_scale: 100        # on the bus `virtual` alone" if segment else ""
    return f"""# The arm {name}, written by `rtcp arm new`. Every key: docs/configuration.md.

name: {name}

cycle:
  period_us: {period_us:g}           # us

bus:
  interface: {"virtual" if segment else "eth0   "}        # or a network interface, as eth0{bus}

# In the order of the cable: the first is next to the master. An IO box is a slave,
# too: {{name: io, device: diewu-io}}.
slaves:
{"".join(f"  - {{name: {drive}, device: {file}}}{chr(10)}" for drive in drives)}
# From the base to the tool. No target beyond these limits reaches a drive.
joints:
{"".join(_joint(n, *place, values) for n, (place, values) in enumerate(zip(of_joints, numbers, strict=True), 1))}
# The geometry is left out: the arm moves by joints, in control mode joint. Poses, lines and jogs in space need it;
# docs/kinematics.md describes `kinematics`.
"""


def _joint(number: int, drive: str, axis: int, values: Mapping[str, float]) -> str:
    lines = [f"  - name: joint{number}", f"    slave: {drive}"]
    if axis != 1:
        lines.append(f"    axis: {axis}")
    low, high = values["position_min"], values["position_max"]
    rows = {"position": f"{{min: {low:.15g}, max: {high:.15g}}}"} | {
        key: f"{values[key]:.15g}" for key in ("velocity", "acceleration", "jerk", "torque")
    }
    units = _UNITS | {"position": "rad"}
    lines += [f"    {f'{key}: {value}':32}# {units[key]}" for key, value in rows.items()]
    return "\n".join(lines) + "\n"


def segment_text(
    esi: str, description: Device, device: DeviceDescription, joints: int, choice: int | None = None
) -> str:
    """Return the text of a segment's file whose drives behave as the drives' file says.

    Args:
        esi: path of the maker's ESI file, relative to the segment's file.
        description: the device in it.
        device: the drives' file.
        joints: number of joints.
        choice: number of the device among those of its identity; None: it is the only one.
    """
    options: dict[str, float] = {"sync_error_limit": 0}
    for axis in device.axes:
        if scaling := device.scaling_of(axis):
            options |= _stored(description, scaling, axis)
            prefix = "" if len(device.axes) == 1 else f"axis{axis}_"
            options |= {prefix + key: value for key, value in _behaviour(scaling)}
    drives = len(dict.fromkeys(drive for drive, _ in places(device, joints)))
    identity = description.identity
    lines = "".join(
        f"      {key if key.isidentifier() else repr(key)}: {int(value) if value == int(value) else repr(value)}\n"
        for key, value in options.items()
    )
    slave = (
        f"  - esi: {esi}\n    product: 0x{identity.product_code:X}\n    revision: 0x{identity.revision:X}\n"
        f"{'' if choice is None else f'    choice: {choice}' + chr(10)}    behaviour: cia402\n    options:\n{lines}"
    )
    return f"""# The drives in software, in the order of the cable, written by `rtcp arm new` from the drives' file.
# All options: docs/behaviours.md.
#   sync_error_limit  0: missed SYNC0 pulses do not end OP, as this host may stop master and drives
#   '0x6091:1', ...   what a drive holds after it was set up in its maker's own tool: the values of `scaling`
#   counts_per_turn   position counts of a turn of the joint; velocity_ratio: turns that 0x60A9 counts in for one of it
#   rated_torque      Nm at the joint for 1000 per mille; torque_ratio: what 0x6076 is multiplied by to get it

slaves:
{slave * drives}"""


def _stored(description: Device, scaling: DriveScaling, axis: int) -> Iterator[tuple[str, float]]:
    """Yield the ratios that a drive must hold, for each object that it has with another value."""
    held = {(item.index, entry.sub_index): entry.default for item in description.objects for entry in item.entries}
    wanted = [(0x608F, scaling.encoder_increments), (0x6091, scaling.gear_ratio)]
    if scaling.feed_constant != 0:
        wanted.append((0x6092, scaling.counts_per_output_turn))
    for base, value in wanted:
        index = base + (axis - 1) * OBJECTS_PER_AXIS
        ratio = Fraction(value).limit_denominator(_MOST_PARTS)
        for sub_index, part in ((1, ratio.numerator), (2, ratio.denominator)):
            default = held.get((index, sub_index), b"")
            if default is None or ((index, sub_index) in held and int.from_bytes(default, "little") != part):
                yield f"0x{index:04X}:{sub_index}", part


def _behaviour(scaling: DriveScaling) -> Iterator[tuple[str, float]]:
    """Yield the options of the behaviour `cia402` that have no object, or not in every drive."""
    external = abs(scaling.external_gear_ratio)
    yield "counts_per_turn", scaling.counts_per_output_turn * external
    yield "velocity_ratio", external * (scaling.gear_ratio if scaling.velocity_at == "motor" else 1.0)
    if scaling.rated_torque is not None:
        turns = external * (scaling.gear_ratio if scaling.torque_at == "motor" else 1.0)
        yield "torque_ratio", turns
        yield "rated_torque", scaling.rated_torque * turns
