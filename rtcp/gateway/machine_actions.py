"""What clients ask of the machine that is no motion: torque, reset, modes, gripper, zero, homing, objects."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Sequence

import numpy as np

from rtcp.config.model import ConfigError, Joint
from rtcp.config.zero import read_zeros, store_zero
from rtcp.fieldbus.al_state import AlState
from rtcp.gateway.command_channel import IN_MOTION, Caller, CommandChannel, Json
from rtcp.ipc.commands import (
    Disable,
    Enable,
    Halt,
    Home,
    MoveGripper,
    Reset,
    SetControlMode,
    SetDriveMode,
    SetPayload,
    SetSpeedOverride,
    SetTool,
    SetZero,
    Shutdown,
)
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import Disabled, GripperAtRest, GripperCloses, GripperOpens, Homed, HomingFailed, ZeroSet
from rtcp.ipc.refusals import NoLease
from rtcp.ipc.states import WITH_TORQUE, ControlMode, DriveMode, DriveState, State
from rtcp.ipc.stop_reactions import longest_s

_ENABLING = frozenset({State.ENABLING})
_DISABLING = frozenset(
    {State.HOLDING, State.MOVING, State.STOPPING, State.STOPPED_BY_LIMIT, State.HOMING, State.ENABLING, State.DISABLING}
)
_RESETTING = frozenset({State.RESETTING})
_HALTING = IN_MOTION | {State.HOMING}
_HOMING = frozenset({State.HOMING})
_RESETTABLE = frozenset({State.FAULT, State.EMERGENCY_STOP, State.RESETTING})
_PARKED = (AlState.INIT, AlState.PREOP)
"""AL states in which a drive takes no process data: nothing gives it torque."""
_SETTLE_CYCLES = 5
"""What a drive shows is older than what it was told: so many cycles pass before it counts as without torque."""
_CONFIRM_S = 2.0
"""How much longer than the longest stop a drive may take to show that its torque is gone."""
_STOP_S = 30.0
_MODE_S = 3.0
_RESET_S = 6.0
_SERVICE_S = 5.0
_GRIPPER_S = 5.0
_HOMING_S = 180.0
_SAME_RAD = 1e-3


class MachineActions:
    """Carries out what is asked of the machine; every method raises RtcpError.

    Args:
        channel: the way to the loop.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._config = channel.config
        self._service = asyncio.Lock()

    # -- torque -------------------------------------------------------------------------------------------------------

    async def enable(self, caller: Caller) -> Json:
        """Enable all drives; return when the arm holds."""
        channel, timeout_s = self._channel, self._config.enable_timeout_s + 3.0
        channel.check_loop()
        if channel.state is not State.HOLDING:
            async with channel.lease(caller) as lease:
                enabled = channel.reaching(State.HOLDING, _ENABLING, "enabling", channel.observer.last_event)
                await channel.run(lease, Enable(), enabled, timeout_s, "enabling")
        return {}

    async def disable(self) -> Json:
        """Stop, remove the torque, and see that it is gone; needs no lease.

        `unconfirmed` names the drive of the gripper in a fault or an emergency stop: it was told too, but no cycle
        record shows it.
        """
        channel, config = self._channel, self._config
        broken = channel.state in _RESETTABLE
        if broken:
            await channel.send(0, Disable())
        else:
            disabled = channel.reaching(State.READY, _DISABLING, "disabling", channel.observer.last_event)
            await channel.run(0, Disable(), disabled, config.enable_timeout_s + _STOP_S, "disabling")
        confirmation = _Confirmation(channel)
        await channel.wait(
            confirmation.look, longest_s(config) + _CONFIRM_S, lambda: RtcpError("fault", confirmation.missing())
        )
        unconfirmed = config.axes[len(config.joints) :] if broken else ()
        return {"unconfirmed": [_drive(joint) for joint in unconfirmed]}

    async def reset(self, caller: Caller) -> Json:
        """Leave a fault or an emergency stop (drives are disabled then), or a stop by a limit (the arm holds)."""
        channel = self._channel
        channel.check_loop()
        before = channel.state
        if before in (State.READY, State.HOLDING):
            return {"from": before.name.lower()}
        async with channel.lease(caller) as lease:
            if before is State.STOPPED_BY_LIMIT:
                await channel.send(lease, Reset())
            else:
                is_reset = channel.reaching(State.READY, _RESETTING, "reset", channel.observer.last_event)
                await channel.run(lease, Reset(), is_reset, _RESET_S, "reset")
        return {"from": before.name.lower()}

    async def halt(self) -> Json:
        """Stop a motion; return when the arm holds. Needs no lease."""
        channel = self._channel
        if channel.state in (State.STOPPED_BY_LIMIT, State.READY):
            # Nothing moves; in state ready a process may work, which ends at once.
            await channel.send(0, Halt())
        else:
            halted = channel.reaching(State.HOLDING, _HALTING, "stopping", channel.observer.last_event)
            await channel.run(0, Halt(), halted, _STOP_S, "stopping")
        return {}

    async def mode(self, caller: Caller, name: str) -> Json:
        """Change the control mode, or the drive mode, at standstill; return when the drives show it."""
        controls, drives = ({one.name.lower(): one for one in kind} for kind in (ControlMode, DriveMode))
        if name not in controls and name not in drives:
            allowed = ", ".join((*controls, *drives))
            raise RtcpError("invalid", f'name: found the text "{name}", allowed is one of {allowed}')
        command = SetControlMode(controls[name]) if name in controls else SetDriveMode(drives[name])  # type: ignore[arg-type]
        channel = self._channel
        async with channel.lease(caller) as lease:
            since = channel.observer.last_event
            wanted = State.HOLDING if channel.state is State.HOLDING else State.READY
            changed = channel.reaching(wanted, frozenset(), "the mode change", since)
            await channel.run(lease, command, changed, _MODE_S, "the mode change")
        return {"mode": name}

    async def set_speed_override(self, caller: Caller, fraction: float, lease: int) -> Json:
        """Change the speed override; `lease`: one that the caller holds already, 0: none."""
        channel = self._channel
        channel.check_loop()
        try:
            await channel.send(lease, SetSpeedOverride(fraction))
        except RtcpError as error:
            # It is raised: while a motion is paused the record does not say from what.
            if lease or error.reason != NoLease.name:
                raise
            async with channel.lease(caller) as acquired:
                await channel.send(acquired, SetSpeedOverride(fraction))
        return {}

    async def set_tool(self, caller: Caller, name: str) -> Json:
        """Use another tool; the next record says so when this returns."""
        number = self.tool_number(name, "name")
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, SetTool(number))
        return {}

    def tool_number(self, name: str, key: str) -> int:
        """Return the number of a tool by its name."""
        names = self._config.tool_names
        if name not in names:
            raise RtcpError("invalid", f'{key}: found the text "{name}", allowed is one of {", ".join(names)}')
        return names.index(name)

    async def set_payload(self, caller: Caller, mass: float, centre: Sequence[float]) -> Json:
        """Carry the weight of what the tool holds."""
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, SetPayload(mass, *centre))
        return {}

    # -- gripper, zero, homing ----------------------------------------------------------------------------------------

    async def gripper(self, caller: Caller, open: bool) -> Json:
        """Open or close the gripper.

        One on an output has been switched when this returns; one with a drive has come to rest at `position`, rad, and
        `holds` says whether something keeps it from its end position.
        """
        channel, gripper = self._channel, self._config.gripper
        async with channel.lease(caller) as lease:
            if gripper is None or gripper.joint is None:
                await channel.send(lease, MoveGripper(open))
                return {}
            since = channel.observer.last_event

            def rested() -> GripperAtRest | None:
                channel.check_loop()
                begun = False
                for record in channel.events(since):
                    event = record.event
                    begun = begun or isinstance(event, GripperOpens | GripperCloses)
                    # An earlier motion may have ended before the command was taken.
                    if begun and isinstance(event, GripperAtRest):
                        return event
                    if type(event) in channel.names.faults:
                        raise channel.error("fault", event)
                    if isinstance(event, Disabled):
                        raise RtcpError("refused", "the gripper was stopped by another command: drives are disabled")
                return None

            rest = await channel.run(lease, MoveGripper(open), rested, _longest_s(gripper.joint), "the gripper")
            goal = gripper.open_position if open else gripper.closed_position
            if goal is not None and not rest.holds and abs(rest.position - goal) > _SAME_RAD:
                ended = channel.early_end(since)
                message = (
                    f"{gripper.joint.name} was stopped at {rest.position:.4f} rad, before it was "
                    f"{'open' if open else 'closed'} at {goal:g} rad"
                )
                raise channel.error("refused", ended, f"{message}: ") if ended else RtcpError("refused", message)
        return {"position": rest.position, "holds": rest.holds}

    async def zero(self, caller: Caller, joint: str, at: float) -> Json:
        """Define the present position of a joint as `at`, rad, in the loop and in the file of offsets."""
        axis, channel, config = self._axis(joint), self._channel, self._config
        async with channel.lease(caller) as lease:
            try:
                offsets = read_zeros(config) or (0.0,) * len(config.axes)
                before = offsets[axis]
                # Unchanged at first: the event says where the drive stands. A record has the joints of the arm alone.
                since = channel.observer.last_event
                await channel.send(lease, SetZero(axis, before))
                offset = before + self._stood(axis, since) - at
                try:
                    await channel.send(lease, SetZero(axis, offset))
                    path = store_zero(config, axis, offset)
                except BaseException:
                    # Loop and file have to agree, or the next start would stand elsewhere: also where the client went
                    # away, or the answer came too late, while the loop set it.
                    with contextlib.suppress(RtcpError):
                        await channel.send(lease, SetZero(axis, before))
                    raise
            except ConfigError as error:
                raise RtcpError("refused", str(error)) from None
        return {"joint": config.axes[axis].name, "offset": offset, "before": before, "file": str(path)}

    def _stood(self, axis: int, since: int) -> float:
        """Return where an axis stood when its zero was last set, rad, by the events after the number `since`."""
        events = (record.event for record in reversed(self._channel.events(since)))
        found = next((event for event in events if isinstance(event, ZeroSet) and event.axis == axis), None)
        if found is None:
            raise RtcpError("fault", "the event that says where the joint stands was overwritten; nothing is changed")
        return found.position

    async def home(self, caller: Caller, joint: str) -> Json:
        """Run the homing of a joint's drive (mode 6); return when the arm holds again."""
        axis, channel = self._axis(joint), self._channel
        since = channel.observer.last_event
        async with channel.lease(caller) as lease:
            homed = channel.reaching(State.HOLDING, _HOMING, "homing", since)
            await channel.run(lease, Home(axis), homed, _HOMING_S, "homing")
        for event in (record.event for record in channel.events(since)):
            if isinstance(event, Homed) and event.axis == axis:
                return {"joint": self._config.axes[axis].name, "position": channel.joints("actual_position")[axis]}
            if isinstance(event, HomingFailed):
                raise channel.error("fault", event)
        raise RtcpError("fault", f"{joint}: homing was interrupted; the arm holds")

    def _axis(self, joint: str) -> int:
        names = [axis.name for axis in self._config.axes]
        if joint.isdecimal() and len(joint) < 6 and 1 <= int(joint) <= len(names):
            return int(joint) - 1
        if joint not in names:
            raise RtcpError("invalid", f'joint: found the text "{joint}", allowed is one of {", ".join(names)}')
        return names.index(joint)

    # -- objects, and the end -----------------------------------------------------------------------------------------

    async def sdo_write(self, caller: Caller, request: Json) -> Json:
        """Write an object, under the lease and only while no drive has torque.

        What a drive does in a fault or beyond a limit stands in its objects: they do not change under a moving arm.
        """
        state = self._channel.state
        if state is not State.READY:
            message = f"objects are written in state ready only, not in {state.words}: `rtcp disable` first"
            raise RtcpError("refused", message)
        async with self._channel.lease(caller):
            return await self.service({"do": "sdo_write", **request})

    async def service(self, request: Json) -> Json:
        """Let the loop's service thread carry out an SDO access."""
        bus = self._channel.config.bus
        if why := bus.LACKS.get("sdo"):
            raise RtcpError("refused", f"no SDO on a bus of kind {bus.kind}: {why}")
        # A client that goes away takes no request back: the next would be written over one that is being worked on.
        answer = await asyncio.shield(asyncio.ensure_future(self._serve(request)))
        if "error" in answer:
            raise RtcpError(answer["kind"], str(answer["error"]), answer.get("reason", ""), answer.get("fields"))
        return answer

    async def _serve(self, request: Json) -> Json:
        channel = self._channel

        def answered() -> Json | None:
            channel.check_loop()
            return channel.observer.service_answer()

        async with self._service:
            channel.observer.ask_service(request)
            late = RtcpError("timeout", f"the loop's service thread did not answer within {_SERVICE_S:g} s")
            return await channel.wait(answered, _SERVICE_S, lambda: late)

    async def end_loop(self) -> None:
        """Let the loop stop, disable and end; the end of its process is the answer."""
        await self._channel.end_loop(Shutdown())


class _Confirmation:
    """Looks for a record of a cycle in which all slaves answered, and every drive of a joint shows no torque.

    In the emergency stop slaves are parked in PRE-OP and do not answer: what they showed last counts there.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._config = channel.config
        self._seen = channel.observer.head + _SETTLE_CYCLES
        self._shown: np.void | None = None
        self._parked = False

    def look(self) -> bool | None:
        """Return True once it is confirmed."""
        self._channel.check_loop()
        records, _ = self._channel.observer.since(self._seen)
        if not len(records):
            return None
        self._seen = int(records[-1]["number"])
        self._parked = self._are_parked()
        good = records if self._parked else records[records["wkc"] == records["wkc_expected"]]
        self._shown = good[-1] if len(good) else self._shown
        return (self._shown is not None and not _with_torque(self._shown)) or None

    def _are_parked(self) -> bool:
        slaves = self._config.slaves
        states = zip(slaves, self._channel.observer.slaves(len(slaves)), strict=True)
        found = {slave.name: al & 0x0F for slave, (al, _) in states}
        return all(found[joint.slave] in _PARKED for joint in self._config.joints)

    def missing(self) -> str:
        """Return of which drives it is not known that they are without torque, and why."""
        record, joints = self._channel.record(), self._config.joints
        names = ", ".join(_drive(joint) for joint in joints)
        frames_return = self._parked or record["lost"] < self._config.bus.lost_cycles
        if self._shown is not None and frames_return:
            held = _with_torque(self._shown)
            why = ", ".join(f"{_drive(joints[axis])} shows {shown}" for axis, shown in held)
            why += "; the slaves are in PRE-OP since" if self._parked else ""
        elif record["wkc"] < 0:
            why = f"no frame returns, and nothing is known of {names}"
        else:
            found, expected = record["wkc"], record["wkc_expected"]
            why = f"slaves are missing (working counter {found} of {expected}), and nothing is known of {names}"
        return f"drives were commanded to remove their torque, not confirmed: {why}"


def _with_torque(record: np.void) -> list[tuple[int, str]]:
    """Return the joints that a record does not show without torque: number, and what the drive shows."""
    held = []
    words = record["statusword"].tolist()
    for axis, state in enumerate(map(DriveState, record["drive_state"].tolist())):
        if state in WITH_TORQUE or state is DriveState.UNKNOWN:
            known = "a state that the standard does not know" if state is DriveState.UNKNOWN else state.words
            held.append((axis, f"0x{words[axis]:04X}, {known}" if words[axis] else known))
    return held


def _drive(joint: Joint) -> str:
    return f"{joint.name} ({joint.place})"


def _longest_s(joint: Joint) -> float:
    """Return how long a gripper may take, s: several times what its whole range takes under its limits."""
    way = joint.position.max - joint.position.min
    return 2 * _GRIPPER_S + 4 * (
        way / joint.velocity + joint.velocity / joint.acceleration + joint.acceleration / joint.jerk
    )
