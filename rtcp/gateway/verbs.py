"""The verbs of the control socket that reach the arm: their arguments taken apart, their work handed on."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from rtcp.config.model import ArmConfig, Point, Stop
from rtcp.gateway.arguments import Arguments
from rtcp.gateway.carrier import Carrier, CommandFailed, Progress
from rtcp.gateway.commander import Commander
from rtcp.gateway.held import Caller, Held
from rtcp.gateway.limit_keeper import LimitKeeper
from rtcp.gateway.picture import Picture
from rtcp.gateway.planner import Planner
from rtcp.gateway.stick_forcer import StickForcer
from rtcp.gateway.travel import Travel
from rtcp.gateway.zeroing import Zeroing
from rtcp.ipc.observer import Observer
from rtcp.motion.limits import Limits

Verb = Callable[[Caller, Arguments, Progress], Awaitable[dict[str, Any]]]
HOLD_S = 0.25
"""A command that has to be renewed counts for so long where its sender does not say."""
RENEWED = frozenset({"jog", "velocity", "torque", "stream", "stick", "halt", "disable", "sdo_read"})
"""Verbs that go on with what their connection leads, or need no lease."""
STICK_HOLD_S = 1.0
"""The same of the stick."""


class Verbs:
    """What may be asked of one running arm; `table` has a function for each verb.

    Args:
        observer: the blackboard.
        picture: the machine's state.
        config: the arm.
        bus: its name.
        directory: the runtime directory.
    """

    def __init__(self, observer: Observer, picture: Picture, config: ArmConfig, bus: str, directory: Path) -> None:
        carrier, limits = Carrier(observer, picture, config), Limits(config)
        self.commander = commander = Commander(carrier)
        self.stick = StickForcer(commander, config, bus)
        self.held = held = Held(carrier)
        self._keeper = LimitKeeper(carrier, limits, directory)
        self._travel = Travel(carrier, Planner(config, limits))
        zeroing = Zeroing(carrier)
        table: dict[str, Verb] = {
            "enable": lambda client, args, tell: commander.enable(client),
            "disable": lambda client, args, tell: commander.disable(client),
            "reset": lambda client, args, tell: commander.reset(client),
            "mode": lambda client, args, tell: commander.mode(client, args.text("name")),
            "motion": lambda client, args, tell: commander.motion(client, args.text("name")),
            "move": self._move,
            "move_pose": self._move_pose,
            "line": self._line,
            "run": self._run,
            "trajectory": self._trajectory,
            "path": self._path,
            "jog": lambda client, args, tell: held.jog(client, args.numbers("v"), args.text("frame"), _hold_s(args)),
            "velocity": lambda client, args, tell: held.velocity(client, args.numbers("numbers"), _hold_s(args)),
            "torque": self._torque,
            "stream": lambda client, args, tell: held.stream(client, args.numbers("q"), args.number("t")),
            "halt": lambda client, args, tell: commander.halt(client),
            "output": lambda client, args, tell: commander.output(client, args.integer("number"), args.truth("value")),
            "gripper": lambda client, args, tell: commander.gripper(client, args.truth("open")),
            "limits": self._limits,
            "stick": self._stick,
            "zero": lambda client, args, tell: zeroing.zero(
                client, args.text("joint"), _or(args.number_or_none("at"), 0.0)
            ),
            "home": lambda client, args, tell: zeroing.home(client, args.text("joint")),
            "sdo_read": self._sdo_read,
            "sdo_write": self._sdo_write,
        }
        self.table = {name: verb if name in RENEWED else self._after_rest(verb) for name, verb in table.items()}

    def _after_rest(self, verb: Verb) -> Verb:
        """Return a verb that waits until what its connection leads has come to rest: else its lease is in the way."""

        async def do(client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
            await self.held.rest(client)
            return await verb(client, args, tell)

        return do

    async def gone(self, connection: int) -> None:
        """End what a connection that has closed was holding."""
        self.held.gone(connection)
        await self.stick.gone(connection)

    async def _move(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        speed, each = args.number_or_none("speed"), args.truth_or_false("each")
        return await self._travel.move(client, args.numbers("q"), speed, each, tell)

    async def _move_pose(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        speed, line = args.number_or_none("speed"), args.truth_or_false("line")
        return await self._travel.move_pose(client, args.numbers("pose"), speed, line, tell)

    async def _line(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        poses = [args.numbers("pose")] if args.has("pose") else args.rows("poses")
        stops = [Stop(tuple(pose)) for pose in poses]
        return await self._travel.lines(client, stops, args.number_or_none("speed"), tell)

    async def _run(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        return await self._travel.run(client, args.text("file"), args.truth_or_false("approach"), tell)

    async def _trajectory(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        points = [
            Point(point.number("t"), tuple(point.numbers("q")), _tuple(point, "v"), _tuple(point, "a"))
            for point in args.objects("points")
        ]
        return await self._travel.follow(client, points, None, None, args.truth_or_false("approach"), tell)

    async def _path(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        stops = [
            Stop(_tuple(stop, "pose"), _tuple(stop, "q"), stop.number_or_none("speed")) for stop in args.objects("path")
        ]
        speed, approach = args.number_or_none("speed"), args.truth_or_false("approach")
        return await self._travel.follow(client, (), stops, speed, approach, tell)

    async def _torque(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        stiffness, damping = (_or(args.number_or_none(key), 0.0) for key in ("stiffness", "damping"))
        return await self.held.torque(client, args.numbers("numbers"), stiffness, damping, _hold_s(args))

    async def _limits(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        if args.has("set"):
            return await self._keeper.change(client, args.named_numbers("set"))
        return self._keeper.show()

    async def _stick(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        if not (args.has("byte") or args.has("pressed")):
            return await self.stick.release(client)
        pressed = args.texts("pressed") if args.has("pressed") else []
        hold_s = _in_time(args, _or(args.number_or_none("hold_s"), STICK_HOLD_S))
        return await self.stick.force(client, pressed, args.integer_or_none("byte"), hold_s)

    async def _sdo_read(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        return await self.commander.service({"do": "sdo_read", **_object(args)})

    async def _sdo_write(self, client: Caller, args: Arguments, tell: Progress) -> dict[str, Any]:
        request = {"do": "sdo_write", **_object(args), "hex": args.text("hex")}
        return await self.commander.sdo_write(client, request)


def _or(value: float | None, default: float) -> float:
    return default if value is None else value


def _hold_s(args: Arguments) -> float:
    return _in_time(args, _or(args.number_or_none("hold_s"), HOLD_S))


def _in_time(args: Arguments, hold_s: float) -> float:
    """Return `hold_s` unless it has passed since `t`, the instant, s of CLOCK_MONOTONIC, at which this was wanted."""
    sent_s = args.number_or_none("t")
    if sent_s is not None and not (late_s := time.monotonic() - sent_s) <= hold_s:
        raise CommandFailed("timeout", f"it came {late_s:.1f} s after it was said, and counts for {hold_s:g} s only")
    return hold_s


def _tuple(args: Arguments, key: str) -> tuple[float, ...] | None:
    return tuple(args.numbers(key)) if args.has(key) else None


def _object(args: Arguments) -> dict[str, int]:
    return {key: args.integer(key) for key in ("slave", "index", "subindex")}
