"""A robot, commanded by blocking calls."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, ParamSpec, TypeVar

from rtcp.api import methods
from rtcp.api.methods import Call
from rtcp.api.results import Progress
from rtcp.ipc.client import ControlClient
from rtcp.ipc.states import State

P = ParamSpec("P")
T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


def documented(method: Callable[..., Call[Any]]) -> Callable[[F], F]:
    """Give a method the name, signature and docstring of its description in `methods`, whose `Call` users never see."""

    def document(call: F) -> F:
        functools.update_wrapper(call, method)
        found = inspect.signature(method)
        call.__signature__ = found.replace(  # type: ignore[attr-defined]
            return_annotation=str(found.return_annotation).removeprefix("Call[").removesuffix("]")
        )
        return call

    return document


def _blocking(method: Callable[Concatenate[Any, P], Call[T]]) -> Callable[Concatenate[Robot, P], T]:
    @documented(method)
    def call(self: Robot, /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._carry_out(method(self, *args, **kwargs))

    return call


class Robot:
    """A connection to the running platform; one call at a time, from one thread.

    Closing it stops what it moves: its lease ends, and the arm comes to a controlled stop.

    Args:
        name: who commands, as others are told when they are refused; empty: this process.
        path: the control socket; None: that of the runtime directory.

    Raises:
        NotRunning: nobody listens.
        Refused: the socket is another user's.
    """

    def __init__(self, name: str = "", path: Path | None = None) -> None:
        self._client = ControlClient(name, path)

    def __enter__(self) -> Robot:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection; a second time is harmless."""
        self._client.close()

    @property
    def state(self) -> State:
        """State of the machine now."""
        return self.status().state

    def _carry_out(self, call: Call[T]) -> T:
        return call.result(self._client.call(call.method, call.params, _reader(call)))

    status = _blocking(methods.status)
    events = _blocking(methods.events)
    scan = _blocking(methods.scan)
    enable = _blocking(methods.enable)
    disable = _blocking(methods.disable)
    reset = _blocking(methods.reset)
    halt = _blocking(methods.halt)
    mode = _blocking(methods.mode)
    stop = _blocking(methods.stop)
    move_joints = _blocking(methods.move_joints)
    move_pose = _blocking(methods.move_pose)
    move_line = _blocking(methods.move_line)
    run = _blocking(methods.run)
    run_trajectory = _blocking(methods.run_trajectory)
    run_path = _blocking(methods.run_path)
    jog = _blocking(methods.jog)
    move_at_velocity = _blocking(methods.move_at_velocity)
    apply_torque = _blocking(methods.apply_torque)
    stream = _blocking(methods.stream)
    set_output = _blocking(methods.set_output)
    gripper = _blocking(methods.gripper)
    limits = _blocking(methods.limits)
    set_limits = _blocking(methods.set_limits)
    zero = _blocking(methods.zero)
    home = _blocking(methods.home)
    sdo_read = _blocking(methods.sdo_read)
    sdo_write = _blocking(methods.sdo_write)
    joystick = _blocking(methods.joystick)
    command = _blocking(methods.command)


def _reader(call: Call[Any]) -> Callable[[Mapping[str, Any]], None] | None:
    report = call.progress
    return None if report is None else lambda found: report(Progress.from_json(found))


def connect(name: str = "", path: Path | None = None) -> Robot:
    """Connect to the running platform; arguments and errors as of `Robot`."""
    return Robot(name, path)
