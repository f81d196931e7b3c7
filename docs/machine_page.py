"""The state machine and the stop reactions for the documentation; `python docs/generate.py` writes them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

from rtcp.config.model import ArmConfig
from rtcp.control.machine import STATES
from rtcp.control.states import Signal
from rtcp.ipc.commands import ANYWHERE, COMMANDS, Shutdown
from rtcp.ipc.events import EVENTS, EmergencyStop, FaultEvent
from rtcp.ipc.message import Message
from rtcp.ipc.stop_reactions import Bound, StopReaction, bounds, tool_bounds, watchdog_bounds

M = TypeVar("M", bound=Message)
_EVERYWHERE = (FaultEvent, EmergencyStop, Shutdown)
"""Causes that lead out of nearly every state, each to one state: in the table, left out of the diagram."""
_SIGNALS = {
    Signal.JOYSTICK_DEFLECTED: "joystick deflected",
    Signal.JOYSTICK_AT_REST: "joystick at rest",
    Signal.STOP_FOR_CLOCK: "clock lost",
    Signal.CLOSED: "closed",
}


def _ours(kinds: Iterable[type[M]]) -> list[type[M]]:
    """Return the messages of this package, without those of installed plug-ins."""
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
    for state in STATES:
        lines.append(f"    {state.state.name} : {state.state.words}")
        shown = {
            cause: to for cause, to in state.leads_to.items() if cause not in _EVERYWHERE and to is not state.state
        }
        for target in dict.fromkeys(shown.values()):
            causes = ", ".join(_words(cause) for cause, to in shown.items() if to is target)
            lines.append(f"    {state.state.name} --> {target.name} : {causes}")
    return "\n".join(lines)


def states() -> str:
    """Return the table of states: what the drives are commanded, and the causes that the diagram leaves out."""
    rows = [
        [state.state.words, state.drives, ", ".join(_words(cause) for cause in _EVERYWHERE if cause in state.leads_to)]
        for state in STATES
    ]
    return _table(["state", "what the drives are commanded", "also left by"], rows)


def commands() -> str:
    """Return the table of commands: who may send each, and in which states it is accepted."""
    rows = []
    for command in _ours(COMMANDS):
        accepted = ", ".join(state.state.words for state in STATES if state.state in command.states)
        if command.states == ANYWHERE:
            accepted = "any"
        rows.append([f"`{command.name}`", "lease holder" if command.needs_lease else "anyone", accepted])
    return _table(["command", "who may send it", "in the states"], rows)


def faults() -> str:
    """Return the table of faults: number, kind, the key that sets the reaction."""
    rows = [
        [str(kind.number), f"`{kind.name}`", f"`stops.{kind.stop_key}`" if kind.stop_key else "quick stop"]
        for kind in sorted(_ours(EVENTS), key=lambda kind: kind.number)
        if kind.is_fault
    ]
    return _table(["error code", "event", "reaction"], rows)


def _largest(joints: tuple[Bound, ...]) -> tuple[str, str]:
    return f"{1000 * max(joint.time_s for joint in joints):.0f} ms", f"{max(joint.way_rad for joint in joints):.3f} rad"


def reactions(config: ArmConfig) -> str:
    """Return the table of stop reactions: what happens, how long and how far at most, and how to continue."""
    hold, controlled, quick, watchdog = (
        _largest(joints)
        for joints in (
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
            "hold", "-", "the last targets are sent again", f"{hold[0]}, then the reaction of `lost_frames`", hold[1],
            "unchanged", "by itself, with the next right working counter",
        ],
        [
            "controlled stop", "2", "setpoints decelerate under the limits; drives stay enabled",
            f"{controlled[0]}; {1000 * max(tool).time_s:.0f} ms where the limits of the tool are lower",
            f"{controlled[1]}; the tool {tool[0].way_rad:.2f} m and {tool[1].way_rad:.2f} rad",
            "holding; fault for `clock_lost`", "a new command; after `clock_lost` as after a quick stop",
        ],
        [
            "quick stop", "2; 1 where the torque follows",
            "each drive decelerates by itself (0x6085) and holds with torque (0x605A = 6)", quick[0], quick[1],
            "fault; emergency stop for `emergency_stop` and `supervision`, where the torque goes at standstill", again,
        ],
        [
            "torque off", "0", "disable voltage: no ramp, the brakes stop the joints", "that of the brakes",
            "that of the brakes", "fault without torque, or emergency stop", again,
        ],
        [
            "(no frames arrive)", "-", "the watchdog of each drive stops it (0x605E = 2)", watchdog[0], watchdog[1],
            "fault; the torque is off", again,
        ],
    ]  # fmt: skip
    head = [
        "reaction", "stop category", "what happens", "longest time", "longest distance of a joint", "state after",
        "how to continue",
    ]  # fmt: skip
    return _table(head, rows)
