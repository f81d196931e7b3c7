"""The state machine and the stop reactions for the documentation; `python docs/generate.py` writes them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar, get_args, get_type_hints

from rtcp.config.model import ArmConfig, StopsConfig
from rtcp.control.machine import STATES
from rtcp.control.states import Signal
from rtcp.ipc.commands import COMMANDS, Shutdown
from rtcp.ipc.events import EVENTS, EmergencyStop, FaultEvent
from rtcp.ipc.message import Message
from rtcp.ipc.stop_reactions import Bound, StopReaction, bounds, tool_bounds, watchdog_bounds

M = TypeVar("M", bound=Message)
_EVERYWHERE = (FaultEvent, EmergencyStop, Shutdown)
"""Causes that lead out of nearly every state: in the table, left out of the diagram."""
_SIGNALS = {
    Signal.JOYSTICK_DEFLECTED: "joystick deflected",
    Signal.JOYSTICK_AT_REST: "joystick at rest",
    Signal.STOP_FOR_CLOCK: "clock lost",
    Signal.CLOSED: "closed",
}
_STOP_EVENTS = {
    "lost_frames": "`bus.lost_cycles` lost cycles in a row, or that many more lost than good ones",
    "slave_lost": "a slave left OP, or does not answer",
    "drive_fault": "a drive is in fault, or left Operation Enabled by itself: the reaction of all others",
    "clock_lost": "the cycle was not locked to the reference clock for `bus.clock_lost_s`",
    "emergency_stop": "its input is active",
    "supervision": "speed, torque or following error exceeded its limit for `supervision.cycles`",
    "lease_ended": "the commander of a motion fell silent or released its lease",
    "enabling_switch": "it was released while something moves",
}


def _ours(kinds: Iterable[type[M]]) -> list[type[M]]:
    """Leave out those of other packages."""
    return [kind for kind in kinds if kind.__module__.startswith("rtcp.")]


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _words(cause: type[Message] | Signal) -> str:
    if isinstance(cause, Signal):
        return _SIGNALS[cause]
    name = getattr(cause, "name", "") or "".join(f" {c.lower()}" if c.isupper() else c for c in cause.__name__).strip()
    name = name.removesuffix(" event")
    return name.replace("_", " ")


def diagram() -> str:
    """Return the Mermaid diagram of states and causes."""
    lines = ["stateDiagram-v2", "    [*] --> STARTING", "    OFF : off"]
    for one in STATES:
        lines.append(f"    {one.state.name} : {one.state.words}")
        for cause, target in one.leads_to.items():
            if cause not in _EVERYWHERE and target is not one.state:
                lines.append(f"    {one.state.name} --> {target.name} : {_words(cause)}")
    return "\n".join(lines)


def states() -> str:
    """Return the table of states: what the drives are commanded, and where each cause leads."""
    rows = [
        [
            one.state.words,
            one.drives,
            "; ".join(f"{_words(cause)}: {target.words}" for cause, target in one.leads_to.items()),
        ]
        for one in STATES
    ]
    return _table(["state", "what the drives are commanded", "left by"], rows)


def commands() -> str:
    """Return the table of commands: who may send each, and in which states it is accepted."""
    rows = []
    for command in _ours(COMMANDS):
        accepted = ", ".join(one.state.words for one in STATES if one.state in command.states)
        rows.append([f"`{command.name}`", "the holder of the lease" if command.needs_lease else "anyone", accepted])
    return _table(["command", "who may send it", "in the states"], rows)


def faults() -> str:
    """Return the table of faults: number, kind, the key that sets the reaction."""
    rows = [
        [str(kind.number), f"`{kind.name}`", f"`stops.{kind.stop_key}`" if kind.stop_key else "quick stop"]
        for kind in sorted(_ours(EVENTS), key=lambda kind: kind.number)
        if kind.is_fault
    ]
    return _table(["error code", "event", "reaction"], rows)


def _largest(found: tuple[Bound, ...]) -> tuple[str, str]:
    return f"{1000 * max(one.time_s for one in found):.0f} ms", f"{max(one.way_rad for one in found):.3f} rad"


def reactions(config: ArmConfig) -> str:
    """Return the table of stop reactions: what happens, how long and how far at most, and the way out."""
    held, controlled, quick, silent = (
        _largest(found)
        for found in (
            bounds(config, StopReaction.HOLD),
            bounds(config, StopReaction.CONTROLLED_STOP),
            bounds(config, StopReaction.QUICK_STOP),
            watchdog_bounds(config),
        )
    )
    tool = tool_bounds(config, config.cartesian.speed, config.cartesian.angular_speed)
    again = "remove the cause, `rtcp reset`, `rtcp enable`"
    rows = [
        [
            "hold", "-", "the last targets are sent again", f"{held[0]}, then the reaction of `lost_frames`", held[1],
            "unchanged", "by itself, with the next right working counter",
        ],
        [
            "controlled stop", "2", "setpoints decelerate under the limits; drives stay enabled",
            f"{controlled[0]}; {1000 * max(tool).time_s:.0f} ms where the limits of the tool lead",
            f"{controlled[1]}; the tool {tool[0].way_rad:.2f} m and {tool[1].way_rad:.2f} rad",
            "holding; fault for `clock_lost`", "a new command; after `clock_lost` as after a quick stop",
        ],
        [
            "quick stop", "2; 1 where the torque follows",
            "each drive decelerates by itself (0x6085) and holds with torque (0x605A = 6)", quick[0], quick[1],
            "fault; emergency stop for `emergency_stop` and `supervision`, where the torque goes at standstill", again,
        ],
        [
            "torque off", "0", "disable voltage: no ramp, the brakes close on what moves", "that of the brakes",
            "that of the brakes", "fault without torque, or emergency stop", again,
        ],
        [
            "(no frames arrive)", "-", "the watchdog of each drive stops it (0x605E = 2)", silent[0], silent[1],
            "fault; the torque is off", again,
        ],
    ]  # fmt: skip
    head = ["reaction", "stop category", "what happens", "stands within", "way of a joint", "state after", "way out"]
    return _table(head, rows)


def stop_events() -> str:
    """Return the table of the section `stops`: the event of each key, the reactions that it may have, the default."""
    rows = [
        [f"`stops.{key}`", _STOP_EVENTS[key], ", ".join(get_args(hint)), getattr(StopsConfig, key)]
        for key, hint in get_type_hints(StopsConfig).items()
    ]
    return _table(["key", "event", "reactions", "default"], rows)
