"""The interlocks of the heater as one table, rows x (Off, Manual, Auto), and their evaluation.

Modelled on IEC 60204-1, 9.2 (mode selector, start, stop, reset), hold-to-run and two-channel inputs of ISO 13849-1, and
feedback of contactors (EDM). Software is no safety function: relay chain, fuse and key are hardware
(docs/shape_setting.md).
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final, NamedTuple


class Mode(IntEnum):
    """Position of the key switch."""

    OFF = 0
    MANUAL = 1
    """The button is held; the heater works without arms."""
    AUTO = 2
    """The robot's safety circuit takes the place of the button."""


class Row(IntEnum):
    """Statements about a cycle; the first rows are the operator's, those from `KEY_DISCREPANCY` on are faults."""

    KEY = 0
    BUTTON = 1
    ROBOT_CIRCUIT = 2
    ARMS_PERMITTED = 3
    ARMS_ENGAGED = 4
    PLATFORM = 5
    COMMANDER = 6
    KEY_DISCREPANCY = 7
    BUTTON_DISCREPANCY = 8
    CIRCUIT_DISCREPANCY = 9
    ARM_LOST = 10
    RELAY_FEEDBACK = 11
    GATE_FEEDBACK = 12
    FUSE = 13
    OVER_CURRENT = 14
    OVER_VOLTAGE = 15
    OPEN_CIRCUIT = 16
    SHORT_CIRCUIT = 17
    IMPLAUSIBLE_TEMPERATURE = 18
    STEEP_GRADIENT = 19
    INSULATION = 20
    LOST_CYCLE = 21
    STALE_INPUT = 22
    EXCESS_HEAT = 23
    NONE = 31
    """No row: nothing has ended a heating."""


class Cell(IntEnum):
    """Requirement of a mode on a row."""

    IGNORED = 0
    MUST_HOLD = 1
    FORBIDDEN = 2
    NO_HEAT = 3
    """Neither: the mode permits no heat at all."""


class Rule(NamedTuple):
    """A row of the table."""

    row: Row
    cells: tuple[Cell, Cell, Cell]
    """Off, Manual, Auto."""
    statement: str


_I, _M, _F, _N = Cell.IGNORED, Cell.MUST_HOLD, Cell.FORBIDDEN, Cell.NO_HEAT
TABLE: Final = (
    Rule(Row.KEY, (_N, _M, _M), "the key is at Manual or at Auto, and where it was when the relay closed"),
    Rule(Row.BUTTON, (_I, _M, _I), "both channels of the remote's button are closed"),
    Rule(Row.ROBOT_CIRCUIT, (_I, _I, _M), "both channels of the robot's safety circuit are closed"),
    Rule(Row.ARMS_PERMITTED, (_I, _I, _M), "each arm may move: in Hand mode its enabling device is held"),
    Rule(Row.ARMS_ENGAGED, (_I, _I, _M), "each arm holds and does not move, and its emergency stop is released"),
    Rule(Row.PLATFORM, (_I, _M, _M), "the heater's platform is enabled: it holds or moves"),
    Rule(Row.COMMANDER, (_I, _M, _M), "who commanded pulses or heat holds the lease"),
    Rule(Row.KEY_DISCREPANCY, (_F, _F, _F), "the key is at Manual and at Auto for longer than `discrepancy_s`"),
    Rule(Row.BUTTON_DISCREPANCY, (_I, _F, _I), "the button's channels differ for longer than `discrepancy_s`"),
    Rule(Row.CIRCUIT_DISCREPANCY, (_I, _I, _F), "the circuit's channels differ for longer than `discrepancy_s`"),
    Rule(Row.ARM_LOST, (_I, _I, _F), "an arm's newest record is older than `arm_silence_s`"),
    Rule(Row.RELAY_FEEDBACK, (_F, _F, _F), "the mirror contact differs from the relay's command after its time"),
    Rule(
        Row.GATE_FEEDBACK,
        (_F, _F, _F),
        "the gate's state differs from its command, or with the gate off a current exceeds `leakage_current`, for "
        "`gate_cycles`",
    ),
    Rule(Row.FUSE, (_I, _M, _M), "the fuse is good"),
    Rule(Row.OVER_CURRENT, (_F, _F, _F), "the current exceeds `over_current`"),
    Rule(Row.OVER_VOLTAGE, (_F, _F, _F), "rod or battery have more than `over_voltage`"),
    Rule(Row.OPEN_CIRCUIT, (_I, _F, _F), "the gate is on, and the resistance exceeds `open_resistance`"),
    Rule(Row.SHORT_CIRCUIT, (_I, _F, _F), "the gate is on, and the resistance is below `short_resistance`"),
    Rule(
        Row.IMPLAUSIBLE_TEMPERATURE,
        (_I, _F, _F),
        "the mean temperature by the resistance is outside the temperatures that the measured power allows, by more "
        "than `temperature_tolerance`",
    ),
    Rule(
        Row.STEEP_GRADIENT,
        (_I, _F, _F),
        "the ratio changes faster than `greatest_gradient`, or falls faster than a rod cools",
    ),
    Rule(Row.INSULATION, (_M, _M, _M), "the monitor between chucks and robot shows its voltage: they are insulated"),
    Rule(Row.LOST_CYCLE, (_I, _F, _F), "the inputs are missing for `lost_cycles`; the gate is off meanwhile"),
    Rule(Row.STALE_INPUT, (_I, _F, _F), "a slave's counter stands still for `stale_cycles`"),
    Rule(
        Row.EXCESS_HEAT,
        (_I, _F, _F),
        "by the measured power the middle of the rod may exceed the target by more than `excess_temperature`",
    ),
)
"""While the relay is open the column Off decides which rows latch; that of the mode decides whether it may close."""
OPERATOR: Final = (1 << Row.KEY_DISCREPANCY) - 1
"""Rows, a bit each, that end heating; a new start is needed. The others latch until they are reset."""


def _mask(mode: Mode, cell: Cell) -> int:
    return sum(1 << rule.row for rule in TABLE if rule.cells[mode] & cell)


_MUST_HOLD: Final = tuple(_mask(mode, Cell.MUST_HOLD) for mode in Mode)
_FORBIDDEN: Final = tuple(_mask(mode, Cell.FORBIDDEN) for mode in Mode)


def violated(mode: int, holds: int) -> int:
    """Return the rows that forbid heat in a mode, a bit each; `holds`: the rows whose statement is true."""
    return (_MUST_HOLD[mode] & ~holds) | (_FORBIDDEN[mode] & holds)


def first_row(rows: int) -> Row:
    """Return the first row of a set of bits: `Row.NONE` of none."""
    return Row((rows & -rows).bit_length() - 1) if rows else Row.NONE


class Interlocks:
    """The latch of the table's rows, and the permission of relay and gate.

    Relay and gate are permitted from `close` on, until the first cycle in which a row forbids it: nothing but another
    `close` permits them again.
    """

    def __init__(self) -> None:
        self.mode = Mode.OFF
        self.closed = False
        """Whether the relay is commanded to close."""
        self.latched = 0
        """Rows, a bit each, that were violated and are not reset."""
        self.cause = Row.NONE
        """Row that ended the last heating."""

    def update(self, mode: Mode, holds: int) -> bool:
        """Walk the table; return whether a row has opened the relay, or has latched, in this cycle."""
        if mode is not self.mode and self.closed:
            # Also from Manual straight to Auto: a choice of the mode starts nothing.
            holds &= ~(1 << Row.KEY)
        self.mode = mode
        rows = violated(mode if self.closed else Mode.OFF, holds)
        latches = rows & ~OPERATOR & ~self.latched
        self.latched |= latches
        if not (latches or (self.closed and rows)):
            return False
        self.cause = first_row(latches or rows)
        self.closed = False
        return True

    def forbids(self, holds: int) -> int:
        """Return the rows, a bit each, that keep the relay from closing now, the latched ones among them."""
        return violated(self.mode, holds) | self.latched

    def close(self, holds: int) -> bool:
        """Permit relay and gate, unless a row forbids it; return whether it does not."""
        if self.forbids(holds):
            return False
        self.closed, self.cause = True, Row.NONE
        return True

    def open(self) -> None:
        """Permit nothing from now on."""
        self.closed = False

    def reset(self, holds: int) -> int:
        """Forget the latched rows whose cause is gone; return the others, a bit each."""
        self.latched &= violated(Mode.OFF, holds) | (violated(self.mode, holds) & ~OPERATOR)
        return self.latched


def markdown() -> str:
    """Return the table for docs/shape_setting.md."""
    lines = ["| row | what it says | Off | Manual | Auto | violated |", "|---|---|---|---|---|---|"]
    for row, cells, statement in TABLE:
        words = " | ".join(cell.name.lower().replace("_", " ") for cell in cells)
        effect = "ends heating" if OPERATOR >> row & 1 else "latches"
        lines.append(f"| {row.name.lower().replace('_', ' ')} | {statement} | {words} | {effect} |")
    return "\n".join(lines)
