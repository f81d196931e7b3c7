"""What clients ask that is no motion: states of the machine, modes, outputs, the gripper, objects."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import numpy as np

from rtcp.config.model import Joint
from rtcp.control.arm import WITH_TORQUE
from rtcp.control.closing import TOLD_CYCLES
from rtcp.devices.cia402 import DriveState, state_of
from rtcp.fieldbus.al_state import AlState
from rtcp.gateway.carrier import MOVING, POLL_S, Carrier, CommandFailed
from rtcp.ipc.codes import Code, MotionMode
from rtcp.ipc.machine import Command, State
from rtcp.ipc.states import DriveMode
from rtcp.ipc.stops import longest_s

DRIVE_MODES: dict[str, int] = {mode.name.lower(): mode for mode in (DriveMode.CSP, DriveMode.CSV, DriveMode.CST)}
MOTION_MODES: dict[str, int] = {mode.name.lower(): mode for mode in MotionMode}
_ENABLING = frozenset({State.ENABLING})
_DISABLING = frozenset(
    {State.HOLDING, State.MOVING, State.STOPPING, State.STOPPED_BY_LIMIT, State.HOMING, State.ENABLING, State.DISABLING}
)
_RESETTING = frozenset({State.RESETTING})
_HALTING = MOVING | {State.HOMING}
_RESETTABLE = (State.FAULT, State.EMERGENCY_STOP, State.RESETTING)
_PARKED = (AlState.INIT, AlState.PREOP)
"""AL states in which a drive takes no process data: nothing gives it torque."""
_CONFIRM_S = 2.0
"""So much longer than the longest stop of the ladder a drive may take to show that its torque is gone."""
_SERVICE_S = 5.0
_GRIPPER_S = 5.0
_THERE_RAD = 1e-3


class Commander:
    """Gives commands to the loop on behalf of the control socket's clients."""

    def __init__(self, carrier: Carrier) -> None:
        self._carrier = carrier
        self._picture = carrier.picture
        self._config = carrier.config
        self._service = asyncio.Lock()

    async def enable(self, client: str) -> dict[str, Any]:
        """Enable all drives; returns when the arm holds."""
        self._carrier.check_loop()
        if self._picture.state() is State.HOLDING:
            return {}
        async with self._carrier.lease(client) as lease:
            await self._carrier.give(lease, Command.ENABLE)
            await self._carrier.until(State.HOLDING, _ENABLING, self._config.enable_timeout_s + 3.0, "enabling")
        return {}

    async def disable(self, client: str) -> dict[str, Any]:
        """Stop in a controlled way and take the torque off, and see that it is; needs no lease.

        `unseen` names the gripper's drive in a fault or an emergency stop: told as the others, but no record shows it.

        Raises:
            CommandFailed: refused; a fault came first; the drives do not show that they are without torque.
        """
        broken = self._picture.state() in _RESETTABLE
        await self._carrier.give(0, Command.DISABLE)
        if not broken:
            await self._carrier.until(State.READY, _DISABLING, self._config.enable_timeout_s + 30.0, "disabling")
        await self._until_without_torque()
        unseen = self._config.axes[len(self._config.joints) :] if broken else ()
        return {"unseen": [_drive(joint) for joint in unseen]}

    async def _until_without_torque(self) -> None:
        """Wait until a record of a cycle in which all slaves answered shows every joint's drive without torque.

        In the emergency stop slaves are parked in PRE-OP and do not answer: what they showed last counts there.
        """
        observer = self._carrier.observer
        seen, shown, parked = observer.head + TOLD_CYCLES, None, False
        until = time.monotonic() + longest_s(self._config) + _CONFIRM_S
        while True:
            records, _ = observer.since(seen)
            if len(records):
                seen = int(records[-1]["number"])
                parked = self._parked()
                good = records if parked else records[records["wkc"] == records["wkc_expected"]]
                shown = good[-1] if len(good) else shown
                if shown is not None and not _with_torque(shown):
                    return
            if time.monotonic() > until:
                raise CommandFailed("fault", self._unconfirmed(shown, parked))
            self._carrier.check_loop()
            await asyncio.sleep(POLL_S)

    def _parked(self) -> bool:
        """Whether every joint's drive is in an AL state in which it takes no process data."""
        slaves = self._config.slaves
        states = zip(slaves, self._carrier.observer.slaves(len(slaves)), strict=True)
        found = {slave.name: al & 0x0F for slave, (al, _) in states}
        return all(found[joint.slave] in _PARKED for joint in self._config.joints)

    def _unconfirmed(self, shown: np.void | None, parked: bool) -> str:
        """Say of which joints it is not known that they are without torque, and why; `shown`: what they showed last."""
        latest, joints = self._carrier.observer.latest(), self._config.joints
        names = ", ".join(_drive(joint) for joint in joints)
        heard = parked or (latest is not None and latest[0]["lost"] < self._config.bus.lost_cycles)
        if shown is not None and heard:
            held = _with_torque(shown)
            why = ", ".join(f"{_drive(joints[axis])} shows 0x{word:04X}, {state}" for axis, word, state in held)
            why += "; the slaves are in PRE-OP since" if parked else ""
        elif latest is None or latest[0]["wkc"] < 0:
            why = f"no frame comes back, and nothing is known of {names}"
        else:
            found, expected = latest[0]["wkc"], latest[0]["wkc_expected"]
            why = f"slaves are missing (working counter {found} of {expected}), and nothing is known of {names}"
        return f"told to give up their torque, not confirmed: {why}"

    async def reset(self, client: str) -> dict[str, Any]:
        """Leave a fault or an emergency stop (the drives are then disabled), or a stop by a limit (the arm holds)."""
        self._carrier.check_loop()
        before = self._picture.state()
        if before in (State.READY, State.HOLDING):
            return {}
        async with self._carrier.lease(client) as lease:
            await self._carrier.give(lease, Command.RESET)
            if before is not State.STOPPED_BY_LIMIT:
                await self._carrier.until(State.READY, _RESETTING, 6.0, "reset")
        return {}

    async def mode(self, client: str, name: str) -> dict[str, Any]:
        """Change what the arm takes commands for, or the drives' cyclic synchronous mode, at standstill."""
        if name not in (MOTION_MODES | DRIVE_MODES):
            raise CommandFailed("invalid", f"mode {name!r} is unknown: one of {', '.join(MOTION_MODES | DRIVE_MODES)}")
        command = Command.MOTION if name in MOTION_MODES else Command.MODE
        async with self._carrier.lease(client) as lease:
            await self._carrier.give(lease, command, [(MOTION_MODES | DRIVE_MODES)[name]])
            if self._picture.state() is State.HOLDING:
                await self._carrier.until(State.HOLDING, frozenset(), 3.0, "the mode change")
        return {"mode": name}

    async def motion(self, client: str, name: str) -> dict[str, Any]:
        """Change what the arm takes commands for, at standstill."""
        if name not in MOTION_MODES:
            raise CommandFailed("invalid", f"motion {name!r} is unknown: one of {', '.join(MOTION_MODES)}")
        return await self.mode(client, name)

    async def halt(self, client: str) -> dict[str, Any]:
        """Stop a motion in a controlled way; needs no lease."""
        await self._carrier.give(0, Command.STOP)
        if self._picture.state() is not State.STOPPED_BY_LIMIT:
            await self._carrier.until(State.HOLDING, _HALTING, 30.0, "stopping")
        return {}

    async def output(self, client: str, number: int, value: bool) -> dict[str, Any]:
        """Set a digital output."""
        async with self._carrier.lease(client) as lease:
            await self._carrier.give(lease, Command.OUTPUT, [number, value])
        return {}

    async def gripper(self, client: str, opened: bool) -> dict[str, Any]:
        """Open or close the gripper.

        One on an output has then been told; one with a drive, which moves only under the lease, has come to rest: at
        `position`, rad, and `holds` says whether something keeps it from where it is open or closed.

        Raises:
            CommandFailed: refused; a fault came first; it was stopped on its way.
        """
        carrier, gripper = self._carrier, self._config.gripper
        async with carrier.lease(client) as lease:
            event = carrier.last_event()
            await carrier.give(lease, Command.GRIPPER, [opened])
            if gripper is None or gripper.joint is None:
                return {}
            # An earlier way may have come to its end before the command was taken.
            begun = await carrier.happened(Code.GRIPPER, event, _GRIPPER_S)
            rest = await carrier.happened(Code.GRIPPER_AT, begun.number, _longest_s(gripper.joint))
        holds = rest.limit == 1.0
        goal = gripper.open_position if opened else gripper.closed_position
        if goal is not None and not holds and abs(rest.value - goal) > _THERE_RAD:
            ended = carrier.ended_since(begun.number)
            raise CommandFailed(
                "refused",
                f"{gripper.joint.name} was stopped at {rest.value:.4f} rad, on its way to where it is "
                f"{'open' if opened else 'closed'}, {goal:g} rad" + (f": {carrier.sentence(ended)}" if ended else ""),
            )
        return {"position": rest.value, "holds": holds}

    async def shut_down(self) -> None:
        """Tell the loop to stop, disable and end; its process's end is the answer."""
        await self._carrier.tell_to_end()

    async def sdo_write(self, client: str, request: dict[str, Any]) -> dict[str, Any]:
        """Write an object, under the lease and only while no drive has torque.

        What a drive does in a fault or beyond a limit stands in its objects: they do not change under a moving arm.
        """
        state = self._picture.state()
        if state is not State.READY:
            name = "unknown" if state is None else state.name.lower()
            raise CommandFailed("refused", f"an object is written while ready only, not while {name}: `rtcp disable`")
        async with self._carrier.lease(client):
            return await self.service(request)

    async def service(self, request: dict[str, Any]) -> dict[str, Any]:
        """Let the loop's service thread carry out an SDO access or a scan."""
        # A client that goes away takes no request back: the next would be written over one that is being worked on.
        answer = await asyncio.shield(asyncio.ensure_future(self._serve(request)))
        if "error" in answer:
            raise CommandFailed(str(answer["kind"]), str(answer["error"]))
        return answer

    async def _serve(self, request: dict[str, Any]) -> dict[str, Any]:
        async with self._service:
            self._carrier.observer.ask_service(request)
            until = time.monotonic() + _SERVICE_S
            while (answer := self._carrier.observer.service_answer()) is None:
                self._carrier.check_loop()
                if time.monotonic() > until:
                    raise CommandFailed("timeout", "the loop's service thread did not answer within 5 s")
                await asyncio.sleep(POLL_S)
        return answer


def _with_torque(record: np.void) -> list[tuple[int, int, str]]:
    """Return the joints that a record does not show without torque: number, statusword, its state in words."""
    held = []
    for axis, word in enumerate(record["statusword"].tolist()):
        state = state_of(word)
        if state in WITH_TORQUE:
            held.append((axis, word, state.value))
        elif state is DriveState.UNKNOWN:
            held.append((axis, word, "a state that the standard does not know"))
    return held


def _drive(joint: Joint) -> str:
    return f"{joint.name} ({joint.slave})"


def _longest_s(joint: Joint) -> float:
    """Return how long a gripper may take, s: amply what its whole range takes under its limits."""
    way = joint.position.max - joint.position.min
    return _GRIPPER_S + 4 * (
        way / joint.velocity + joint.velocity / joint.acceleration + joint.acceleration / joint.jerk
    )
