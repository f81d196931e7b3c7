"""Requests to the machine beside motion: torque, reset, modes, gripper, zero, homing, objects."""

from __future__ import annotations

import asyncio
import contextlib
from math import nan
from typing import Annotated

import numpy as np
from annotated_types import Ge

from rtcp.config.drive_limits import joint_limits
from rtcp.config.model import ConfigError, Joint
from rtcp.config.scaling import OBJECTS_PER_AXIS
from rtcp.config.zero import read_zeros, store_zero
from rtcp.fieldbus.al_state import AlState
from rtcp.fieldbus.mailbox import ABSENT
from rtcp.gateway.command_channel import IN_MOTION, Caller, CommandChannel, Json
from rtcp.gateway.method import Numbers, check_count, index_of, method
from rtcp.ipc import commands
from rtcp.ipc.errors import RtcpError
from rtcp.ipc.events import (
    Disabled,
    GripperAtRest,
    GripperCloses,
    GripperOpens,
    Homed,
    HomedElsewhere,
    HomingFailed,
    ZeroSet,
)
from rtcp.ipc.homing_methods import HOME_OFFSET, HOMING_METHOD, PRESENT_POSITION, homing_text
from rtcp.ipc.states import WITH_TORQUE, ControlMode, DriveMode, DriveState, State
from rtcp.ipc.stop_reactions import longest_s

_ENABLING = frozenset({State.ENABLING})
_DISABLING = frozenset(
    {State.HOLDING, State.MOVING, State.STOPPING, State.STOPPED_BY_LIMIT, State.HOMING, State.ENABLING, State.DISABLING}
)
_RESETTING = frozenset({State.RESETTING})
_HALTED = frozenset({State.HOLDING, State.READY})
_HALTING = IN_MOTION | {State.ENABLING, State.HOMING, State.DISABLING}
_HOMING = frozenset({State.HOMING})
_RESETTABLE = frozenset({State.FAULT, State.EMERGENCY_STOP, State.RESETTING})
_PARKED = (AlState.INIT, AlState.PREOP)
"""AL states in which a drive has no process data, and thus no torque."""
_CONFIRM_S = 2.0
"""Time beyond the longest stop until a drive must show that its torque is off, s."""
_STOP_S = 30.0
_BEYOND_S = 3.0
"""Time beyond the loop's own timeout, s, so that the loop's reason is the answer."""
_SERVICE_S = 5.0
_GRIPPER_S = 5.0
_HOMING_S = 120.0
"""Time beyond the search of a drive for its home, s."""
_SAME_RAD = 1e-3


class MachineActions:
    """Carries out requests to the machine; every method raises RtcpError.

    Args:
        channel: to the loop.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._config = channel.config
        self._service = asyncio.Lock()

    # -- torque -------------------------------------------------------------------------------------------------------

    @method()
    async def enable(self, caller: Caller) -> Json:
        """Enable all drives; returns when the arm holds."""
        channel, timeout_s = self._channel, self._config.enable_timeout_s + _BEYOND_S
        channel.check_loop()
        if channel.state is not State.HOLDING:
            async with channel.lease(caller) as lease:
                enabled = channel.reaching(State.HOLDING, _ENABLING, "enabling", channel.observer.last_event)
                await channel.run(lease, commands.Enable(), enabled, timeout_s, "enabling")
        return {}

    @method(at_once=True, stops=commands.Disable)
    async def disable(self, caller: Caller, requested_ns: Annotated[int, Ge(0)] = 0) -> Json:
        """Stop and remove the torque; returns when the drives show that it is gone. Needs no lease.

        Returns `unconfirmed`: drives that no cycle record shows, a gripper's in a fault. `requested_ns` as of `halt`.
        """
        channel, config = self._channel, self._config
        broken = channel.state in _RESETTABLE
        if broken:
            await channel.send(caller.without_lease, commands.Disable())
        else:
            disabled = channel.reaching(State.READY, _DISABLING, "disabling", channel.observer.last_event)
            lease = caller.without_lease
            await channel.run(lease, commands.Disable(), disabled, config.enable_timeout_s + _STOP_S, "disabling")
        confirmation = _Confirmation(channel)
        await channel.wait(
            confirmation.poll, longest_s(config) + _CONFIRM_S, lambda: RtcpError("fault", confirmation.missing())
        )
        unconfirmed = config.axes[len(config.joints) :] if broken else ()
        return {"unconfirmed": [_drive(joint) for joint in unconfirmed]}

    @method()
    async def reset(self, caller: Caller) -> Json:
        """Leave a fault, an emergency stop or a stop by a limit. Returns `from`: the state that was left."""
        channel = self._channel
        channel.check_loop()
        before = channel.state
        if before in (State.READY, State.HOLDING):
            return {"from": before.name.lower()}
        async with channel.lease(caller) as lease:
            if before is State.STOPPED_BY_LIMIT:
                await channel.send(lease, commands.Reset())
            else:
                reset_s = self._config.drive_waits.reset_ms * 1e-3 + _BEYOND_S
                is_reset = channel.reaching(State.READY, _RESETTING, "reset", channel.observer.last_event)
                await channel.run(lease, commands.Reset(), is_reset, reset_s, "reset")
        return {"from": before.name.lower()}

    @method(at_once=True, stops=commands.Halt)
    async def halt(self, caller: Caller, requested_ns: Annotated[int, Ge(0)] = 0) -> Json:
        """Stop every motion; returns when the arm holds, or has no torque if it was being enabled. Needs no lease.

        `requested_ns`: instant, CLOCK_MONOTONIC, of the request that this client has already written to the blackboard.
        """
        channel, lease = self._channel, caller.without_lease
        if channel.state in (State.STOPPED_BY_LIMIT, State.READY):
            # Nothing moves, but in state ready a process may be active: it ends at once.
            await channel.send(lease, commands.Halt())
        else:
            halted = channel.reaching(_HALTED, _HALTING, "stopping", channel.observer.last_event)
            await channel.run(lease, commands.Halt(), halted, _STOP_S, "stopping")
        return {}

    @method()
    async def mode(self, caller: Caller, name: str) -> Json:
        """Change the control mode (joint, cartesian, joystick, velocity, torque) or the drive mode (csp, csv, cst)."""
        controls = {mode.name.lower(): mode for mode in ControlMode}
        drives = {mode.name.lower(): mode for mode in DriveMode}
        index_of("name", name, (*controls, *drives))
        command = commands.SetControlMode(controls[name]) if name in controls else commands.SetDriveMode(drives[name])
        channel = self._channel
        async with channel.lease(caller) as lease:
            since = channel.observer.last_event
            wanted = State.HOLDING if channel.state is State.HOLDING else State.READY
            changed = channel.reaching(wanted, frozenset(), "the mode change", since)
            mode_s = self._config.drive_waits.mode_ms * 1e-3 + _BEYOND_S
            await channel.run(lease, command, changed, mode_s, "the mode change")
        return {"mode": name}

    @method()
    async def set_tool(self, caller: Caller, name: str) -> Json:
        """Use another tool of the arm's file, which holds nothing yet; at rest, in state ready or holding.

        Refused where its bodies would be in a box or too near to the arm itself (reason `tool_in_box`).
        """
        number = index_of("name", name, self._config.tool_names)
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, commands.SetTool(number))
        return {}

    @method()
    async def set_payload(
        self, caller: Caller, mass: Annotated[float, Ge(0)], centre: Numbers = (0.0, 0.0, 0.0)
    ) -> Json:
        """Set the payload, whose weight the arm carries: `mass`, kg, `centre` in the frame of the tool, m; at rest.

        At most `payload.max_mass` of the arm's file; until another tool is chosen.
        """
        check_count("centre", centre, 3)
        async with self._channel.lease(caller) as lease:
            await self._channel.send(lease, commands.SetPayload(mass, *centre))
        return {}

    # -- gripper, zero, homing ----------------------------------------------------------------------------------------

    @method()
    async def move_gripper(self, caller: Caller, open: bool) -> Json:
        """Open or close the gripper. One with a drive has come to rest: returns its `position`, rad, and `holds`."""
        channel, gripper = self._channel, self._config.gripper
        async with channel.lease(caller) as lease:
            if gripper is None or gripper.joint is None:
                await channel.send(lease, commands.MoveGripper(open))
                return {}
            since = channel.observer.last_event

            def rested() -> GripperAtRest | None:
                channel.check_loop()
                begun = False
                for record in channel.events(since):
                    event = record.event
                    begun = begun or isinstance(event, GripperOpens | GripperCloses)
                    # An earlier motion may have ended before the loop read the command.
                    if begun and isinstance(event, GripperAtRest):
                        return event
                    if type(event) in channel.names.faults:
                        raise channel.error("fault", event)
                    if isinstance(event, Disabled):
                        raise RtcpError("refused", "the gripper was stopped by another command: drives are disabled")
                return None

            rest = await channel.run(
                lease, commands.MoveGripper(open), rested, _longest_s(gripper.joint), "the gripper"
            )
            goal = gripper.open_position if open else gripper.closed_position
            if goal is not None and not rest.holds and abs(rest.position - goal) > _SAME_RAD:
                ended = channel.early_end(since)
                message = (
                    f"{gripper.joint.name} was stopped at {rest.position:.4f} rad, before it was "
                    f"{'open' if open else 'closed'} at {goal:g} rad"
                )
                raise channel.error("refused", ended, f"{message}: ") if ended else RtcpError("refused", message)
        return {"position": rest.position, "holds": rest.holds}

    @method()
    async def zero(self, caller: Caller, joint: str, at: float = 0.0) -> Json:
        """Define the present position of an axis as `at`, rad. Returns `joint`, `offset`, `before`, `file`, `unit`."""
        axis, channel, config = self._axis(joint), self._channel, self._config
        async with channel.lease(caller) as lease:
            try:
                offsets = read_zeros(config) or (0.0,) * len(config.axes)
                before = offsets[axis]
                # Unchanged at first: the event has the drive's position. A record has the joints of the arm alone.
                since = channel.observer.last_event
                await channel.send(lease, commands.SetZero(axis, before))
                offset = before + self._stood(axis, since) - at
                try:
                    await channel.send(lease, commands.SetZero(axis, offset))
                    await self._move_drive_limits(axis, offset)
                    path = store_zero(config, axis, offset)
                except BaseException:
                    # Loop and file must agree, or positions differ after the next start: also if the client left or the
                    # answer was late while the loop set it.
                    with contextlib.suppress(RtcpError):
                        await channel.send(lease, commands.SetZero(axis, before))
                        await self._move_drive_limits(axis, before)
                    raise
            except ConfigError as error:
                raise RtcpError("refused", str(error)) from None
        unit = config.unit_of(axis)
        return {"joint": config.axes[axis].name, "offset": offset, "before": before, "file": str(path), "unit": unit}

    async def _move_drive_limits(self, axis: int, zero: float) -> None:
        """Write the limits of an axis to its drive anew: its position limits count from the drive's own zero.

        A drive whose limits belonged to the former zero would lead its joint back from positions that it may have.
        """
        joint = self._config.axes[axis]
        for position, slave in enumerate(self._config.slaves, 1):
            for sdo in joint_limits(self._config, slave, joint, zero) if slave.name == joint.slave else ():
                if not sdo.name.startswith("position"):
                    continue
                request = {"slave": position, "index": sdo.index, "subindex": sdo.sub_index}
                try:
                    await self.service({"do": "sdo_write", **request, "hex": sdo.integer_data.hex()})
                except RtcpError as error:
                    if error.fields.get("code") not in ABSENT:
                        raise

    def _stood(self, axis: int, since: int) -> float:
        """Return the position of an axis when its zero was last set, rad, by the events after the number `since`."""
        events = (record.event for record in reversed(self._channel.events(since)))
        zero = next((event for event in events if isinstance(event, ZeroSet) and event.axis == axis), None)
        if zero is None:
            raise RtcpError("fault", "the event that says where the joint stands was overwritten; nothing is changed")
        return zero.position

    @method()
    async def home(self, caller: Caller, joint: str) -> Json:
        """Run the homing of a joint's drive: what it does says `homing_method`. Returns its `position`, rad."""
        axis, channel = self._axis(joint), self._channel
        since = channel.observer.last_event
        async with channel.lease(caller) as lease:
            offset = await self.home_offset(axis)
            homed = channel.reaching(State.HOLDING, _HOMING, "homing", since)
            longest_s = self._config.homing.search_s + _HOMING_S
            await channel.run(lease, commands.Home(axis, offset), homed, longest_s, "homing")
        for event in (record.event for record in channel.events(since)):
            if isinstance(event, Homed) and event.axis == axis:
                return {"joint": self._config.axes[axis].name, "position": channel.joints("actual_position")[axis]}
            if isinstance(event, HomingFailed | HomedElsewhere):
                raise channel.error("fault", event)
        raise RtcpError("fault", f"{joint}: homing was interrupted; the arm holds")

    @method(streams=True)
    async def homing_method(self, caller: Caller, joint: str) -> Json:
        """Read what `home`, or of an external axis `home_axis`, would do, from its drive; nothing moves.

        Returns `method` (0x6098; null: the drive has no such object), `text`: what the drive then does,
        `declares_present`: whether it declares the present position to be its home, and `home_offset` (0x607C), in
        `unit`.
        """
        axis = self._axis(joint)
        if why := self._channel.config.bus.LACKS.get("homing"):
            raise RtcpError("refused", f"{joint} has no homing here: {why}", "homing_unsupported")
        data = await self._read_of(axis, HOMING_METHOD)
        number = None if data is None else int.from_bytes(data[:1], "little", signed=True)
        return {
            "joint": self._config.axes[axis].name,
            "method": number,
            "text": homing_text(number),
            "declares_present": number is None or number in PRESENT_POSITION,
            "home_offset": await self.home_offset(axis),
            "unit": self._config.unit_of(axis),
        }

    async def home_offset(self, axis: int) -> float:
        """Return the home offset of an axis' drive, rad or m; 0 where it has none (CiA 402-2, object 0x607C), NaN where
        the bus has no SDOs."""
        if self._config.bus.LACKS.get("sdo"):
            return nan
        data = await self._read_of(axis, HOME_OFFSET)
        counts = 0 if data is None else int.from_bytes(data, "little", signed=True)
        joint = self._config.axes[axis]
        device = next(slave.device for slave in self._config.slaves if slave.name == joint.slave).of_axis(joint.axis)
        factor = next((entry.factor for entry in device.inputs if entry.name == "position"), None)
        if factor is None:
            raise RtcpError("refused", f"{_drive(joint)} sends no position: it has no homing here")
        return counts * factor

    async def _read_of(self, axis: int, index: int) -> bytes | None:
        """Return an object of a joint's drive by the index of the first axis; None: the drive lacks it."""
        joint = self._config.axes[axis]
        position = next(place for place, slave in enumerate(self._config.slaves, 1) if slave.name == joint.slave)
        index += (joint.axis - 1) * OBJECTS_PER_AXIS
        try:
            answer = await self.service({"do": "sdo_read", "slave": position, "index": index, "subindex": 0})
        except RtcpError as error:
            if error.fields.get("code") in ABSENT:
                return None
            raise
        return bytes.fromhex(answer["hex"])

    def _axis(self, joint: str) -> int:
        names = [axis.name for axis in self._config.axes]
        if joint.isdecimal() and len(joint) < 6 and 1 <= int(joint) <= len(names):
            return int(joint) - 1
        return index_of("joint", joint, names)

    # -- objects, and the end -----------------------------------------------------------------------------------------

    @method(streams=True)
    async def sdo_read(self, caller: Caller, slave: int, index: int, subindex: int) -> Json:
        """Read an object of the slave at a position from 1. Returns its bytes as `hex`."""
        return await self.service({"do": "sdo_read", "slave": slave, "index": index, "subindex": subindex})

    @method()
    async def sdo_write(self, caller: Caller, slave: int, index: int, subindex: int, hex: str) -> Json:
        """Write an object of a slave, in state ready only."""
        # Objects set a drive's reaction to faults and limits: they must not change while the arm moves.
        state = self._channel.state
        if state is not State.READY:
            message = f"objects are written in state ready only, not in {state.words}: `rtcp disable` first"
            raise RtcpError("refused", message)
        async with self._channel.lease(caller):
            request = {"slave": slave, "index": index, "subindex": subindex, "hex": hex}
            return await self.service({"do": "sdo_write", **request})

    async def service(self, request: Json) -> Json:
        """Let the loop's service thread carry out an SDO access."""
        bus = self._channel.config.bus
        if why := bus.LACKS.get("sdo"):
            raise RtcpError("refused", f"no SDO on a bus of kind {bus.kind}: {why}")
        # Shielded from a client that leaves: the next request would overwrite one that is being carried out.
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

    def end_loop(self) -> None:
        """Let the loop stop, disable and end; the end of its process is the answer."""
        self._channel.observer.stop(commands.Shutdown)


class _Confirmation:
    """Waits for a record in which all slaves answered and every joint's drive shows no torque.

    In the emergency stop slaves are parked in PRE-OP and do not answer: their last status counts.
    """

    def __init__(self, channel: CommandChannel) -> None:
        self._channel = channel
        self._config = channel.config
        config = channel.config
        # Earlier statuses are older than the command.
        self._seen = channel.observer.head + config.drive_waits.answer_cycles(config.cycle.period_us * 1e-6)
        self._shown: np.void | None = None
        self._parked = False

    def poll(self) -> bool | None:
        """Return True once it is confirmed, else None."""
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
        statuses = zip(slaves, self._channel.observer.slaves(len(slaves)), strict=True)
        states = {slave.name: al & 0x0F for slave, (al, _) in statuses}
        return all(states[joint.slave] in _PARKED for joint in self._config.joints)

    def missing(self) -> str:
        """Return the message on the drives that may have torque, and why."""
        record, joints = self._channel.record(), self._config.joints
        names = ", ".join(_drive(joint) for joint in joints)
        frames_return = self._parked or record["lost"] < self._config.bus.lost_cycles
        if self._shown is not None and frames_return:
            drives = _with_torque(self._shown)
            why = ", ".join(f"{_drive(joints[axis])} shows {text}" for axis, text in drives)
            why += "; the slaves are in PRE-OP since" if self._parked else ""
        elif record["wkc"] < 0:
            why = f"no frame returns, and nothing is known of {names}"
        else:
            actual, expected = record["wkc"], record["wkc_expected"]
            why = f"slaves are missing (working counter {actual} of {expected}), and nothing is known of {names}"
        return f"drives were commanded to remove their torque, not confirmed: {why}"


def _with_torque(record: np.void) -> list[tuple[int, str]]:
    """Return the joints that may have torque by a record: number, and state of the drive in words."""
    drives = []
    words = record["statusword"].tolist()
    for axis, state in enumerate(map(DriveState, record["drive_state"].tolist())):
        if state in WITH_TORQUE or state is DriveState.UNKNOWN:
            known = "a state that the standard does not know" if state is DriveState.UNKNOWN else state.words
            drives.append((axis, f"0x{words[axis]:04X}, {known}" if words[axis] else known))
    return drives


def _drive(joint: Joint) -> str:
    return f"{joint.name} ({joint.place})"


def _longest_s(joint: Joint) -> float:
    """Return the longest time of a gripper's motion, s: several times that of its range under its limits."""
    range_rad = joint.position.max - joint.position.min
    return 2 * _GRIPPER_S + 4 * (
        range_rad / joint.velocity + joint.velocity / joint.acceleration + joint.acceleration / joint.jerk
    )
