"""What a segment's file may say of a model, as tables, and the check of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, pi
from types import MappingProxyType


@dataclass(frozen=True)
class Option:
    """A number that a model takes: default, range and what it means. Default None: it follows from the model's size."""

    default: float | None
    low: float
    high: float
    meaning: str
    whole: bool = False


NEUTRAL = 0x003F
"""The IO box's inputs with nothing pressed: the pull-ups of the joystick's six lines, and nothing on the others."""

_SERIAL = Option(1, 0, 0xFFFFFFFF, "serial number (0x1018:4)", whole=True)

DRIVE_OPTIONS: Mapping[str, Option] = MappingProxyType({
    "serial": _SERIAL,
    "load_inertia": Option(None, 0.0, 50.0, "inertia of the load at the joint, kg m^2"),
    "load_mass_moment": Option(0.0, -50.0, 50.0, "mass of the load times its distance from the axis, kg m"),
    "gravity_phase": Option(0.0, -2 * pi, 2 * pi, "0: the load stands upright at q = 0, pi: it hangs, rad"),
    "friction": Option(None, 0.0, 50.0, "Coulomb friction, Nm"),
    "viscous_friction": Option(None, 0.0, 50.0, "viscous friction, Nm s/rad"),
    "holding_torque": Option(None, 0.0, 500.0, "torque of the brake that closes with the power stage off, Nm"),
    "initial_position": Option(0.0, -20.0, 20.0, "position of the encoder at power-on, rad"),
    "temperature": Option(30.0, -40.0, 200.0, "temperature of the surroundings and of the motor at power-on, C"),
    "bus_voltage": Option(48.0, 0.0, 100.0, "supply, V"),
})  # fmt: skip
IO_BOX_OPTIONS: Mapping[str, Option] = MappingProxyType({
    "serial": _SERIAL,
    "counter_rate": Option(0.0, -1e6, 1e6, "AB edges a second that the encoder turns by itself"),
    "inputs": Option(NEUTRAL, 0, 0xFFFF, "levels at the inputs at power-on, bit 0 is input 1", whole=True),
})  # fmt: skip


def read_options(model: str, table: Mapping[str, Option], given: Mapping[str, object]) -> dict[str, float | None]:
    """Return the value of every option of `table`.

    Raises:
        ValueError: an option that does not exist, is no number or is out of range; says which, and what is allowed.
    """
    read = {name: option.default for name, option in table.items()}
    for name, value in given.items():
        option = table.get(name)
        if option is None:
            raise ValueError(f"model {model} has no option {name!r}; it has: {', '.join(table)}")
        kind = "a whole number" if option.whole else "a number"
        what = f"option {name} of model {model} ({option.meaning})"
        if isinstance(value, bool) or not isinstance(value, int if option.whole else (int, float)):
            raise ValueError(f"{what} is {value!r}, and must be {kind} from {option.low:g} to {option.high:g}")
        if not (isfinite(value) and option.low <= value <= option.high):
            raise ValueError(f"{what} is {value!r}, and must be {kind} from {option.low:g} to {option.high:g}")
        read[name] = value
    return read
