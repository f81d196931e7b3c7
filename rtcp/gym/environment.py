"""The environment: observations by the names of the cycle record's fields, and episodes that the guards end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import numpy.typing as npt

from rtcp.api import Faulted, Robot, RtcpError, State, TimedOut
from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig
from rtcp.control.joint_group import RANGE_MARGIN_RAD
from rtcp.gym.actions import ACTION_TIMEOUT_S, ACTIONS, ActionKind
from rtcp.gym.arms import Arm, ConnectedArm, SimulatedArm
from rtcp.ipc.events import Event, FaultEvent, LeaseExpired, MotionEnded, PermissionWithdrawn, Stopped, StoppedByLimit
from rtcp.ipc.names import Names
from rtcp.ipc.schema import Field
from rtcp.ipc.tool_motion import ToolMotion

Observation: TypeAlias = dict[str, npt.NDArray[Any]]
Reward: TypeAlias = Callable[[Observation, npt.NDArray[Any], dict[str, Any]], float]
SLOWEST_HZ = 2.0 / ACTION_TIMEOUT_S
"""Least rate, Hz: at it a step may be late by its own length, and the action has not ended."""
_ENDS = (MotionEnded, FaultEvent, LeaseExpired, PermissionWithdrawn, Stopped, StoppedByLimit)
_GOES_ON = frozenset({State.HOLDING, State.MOVING})


class ArmEnv(gymnasium.Env):
    """An arm whose policy acts at a fixed rate: in simulated time, or on a robot.

    An episode has ended (`terminated`) when a guard, a fault or a person ended the motion, or no action was accepted
    for `ACTION_TIMEOUT_S`. `info` has `events`, those since the step before, of `rtcp.ipc.events`; `state`, of the
    machine; and, where an action was not accepted, `refusal`, the error as a robot raises it: the one before it lasts.

    Override `begin_episode`, `observation` and `reward` for a task.

    Args:
        action: a name of `rtcp.gym.ACTIONS`, or a kind of one's own.
        config: the arm, or its file; None: the packaged one. A robot brings its own, with the same limits of actions.
        observe: names of fields of the cycle record (`docs/channels.md`), or one of them.
        rate_hz: actions a second, `SLOWEST_HZ` at least.
        reward: of an observation, the action before it, and its info; None: 0.
        robot: moves this robot in place of a simulated arm.

    Attributes:
        config: of the arm.
        arm: what moves.
        names: `names.message(event)` is the text of an event.

    Raises:
        Invalid: an argument, with what is allowed.
        ConfigError: the configuration.
        NotRunning: the robot's platform has ended.
    """

    metadata: Mapping[str, Any] = {"render_modes": []}

    def __init__(
        self,
        action: str | ActionKind = "joint_positions",
        *,
        config: ArmConfig | Path | str | None = None,
        observe: Sequence[str] | str = ("actual_position", "actual_velocity"),
        rate_hz: float = 50.0,
        reward: Reward | None = None,
        robot: Robot | None = None,
    ) -> None:
        kind = action if isinstance(action, ActionKind) else ACTIONS.get(action)
        if kind is None:
            raise RtcpError("invalid", f"action: found {action!r}, allowed are {', '.join(ACTIONS)}")
        if not rate_hz >= SLOWEST_HZ:
            raise RtcpError("invalid", f"rate_hz: found {rate_hz:g}, allowed are {SLOWEST_HZ:g} Hz and more")
        if isinstance(config, Path | str):
            config = load(Path(config))
        if robot is None:
            self.arm: Arm = SimulatedArm(load(default_config()) if config is None else config, kind, rate_hz)
        else:
            self.arm = ConnectedArm(robot, kind, rate_hz)
            self._check_same_actions(kind, config)
        self.config = self.arm.config
        self.names = Names(self.config)
        self.rate_hz = rate_hz
        self._kind = kind
        self._reward = reward
        self._tool = ToolMotion(self.config.models, self.arm.schema)
        fields = {field.name: field for field in self._tool.schema.fields}
        observe = (observe,) if isinstance(observe, str) else tuple(observe)
        for name in observe:
            if name not in fields:
                raise RtcpError("invalid", f"observe: no field {name!r}, allowed are {', '.join(fields)}")
        self._observed = observe
        self._event = 0
        self._accepted_s: float | None = None
        """When the last action was accepted, or the first one made, by the arm's clock; None: none in this episode."""
        self._begun = False
        self.observation_space = gymnasium.spaces.Dict({name: _space_of(fields[name]) for name in observe})
        self.action_space = _action_space(*kind.bounds(self.config))

    # -- for a task ---------------------------------------------------------------------------------------------------

    def begin_episode(self, options: Mapping[str, Any]) -> None:
        """Draw what an episode needs, by `self.np_random`; `options` are those of `reset`. Does nothing here."""

    def observation(self) -> Observation:
        """Return the observation: the observed fields of the newest cycle record, numbers as float64."""
        record = self._tool.add(self._latest())
        return {name: np.array(record[name][0], np.float64, ndmin=1) for name in self._observed}

    def reward(self, observation: Observation, action: npt.NDArray[Any], info: dict[str, Any]) -> float:
        """Return the reward of an observation after an action: that of the argument `reward`, or 0."""
        return 0.0 if self._reward is None else float(self._reward(observation, action, info))

    # -- gymnasium.Env ------------------------------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; the arm holds.

        Args:
            seed: of all that is random from now on: the same one gives the same run, to the bit.
            options: `positions`: of the joints, rad. A robot moves there.

        Raises:
            Invalid: `positions` are not finite numbers in the joints' ranges, one a joint; or a robot's environment is
                closed.
            Faulted: a simulated arm does not come to holding.
            Refused: a robot does not hold, or refuses to move there.
        """
        super().reset(seed=seed)
        self._begun = False
        options = {} if options is None else options
        positions = options.get("positions")
        if positions is not None:
            positions = self._checked(positions)
        self.arm.begin(positions, int(self.np_random.integers(1 << 32)))
        self._event, self._accepted_s = self.arm.observer.last_event, None
        self._begun = True
        self.begin_episode(options)
        return self.observation(), self._info()

    def step(self, action: npt.ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Act for the time of a step.

        Raises:
            Invalid: `action` is not one number for each of the action space, or no episode has begun.
        """
        if not self._begun:
            raise RtcpError("invalid", "no episode has begun: call reset() before step()")
        try:
            values = np.asarray(action, np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise RtcpError("invalid", f"action: found {action!r:.60}, allowed are numbers ({error})") from error
        if values.shape != self.action_space.shape:
            raise RtcpError("invalid", f"action: found shape {values.shape}, allowed is {self.action_space.shape}")
        refusal = self._apply(values.tolist())
        self.arm.advance()
        observation, info = self.observation(), self._info()
        if refusal is not None:
            info["refusal"] = refusal
        events = info["events"]
        terminated = (
            isinstance(refusal, Faulted | TimedOut)
            or info["state"] not in _GOES_ON
            or any(isinstance(event, _ENDS) for event in events)
        )
        return observation, self.reward(observation, values, info), terminated, False, info

    def close(self) -> None:
        """Leave the arm: a robot at rest, in the control mode of before."""
        self._begun = False
        self.arm.close()

    def _apply(self, values: Sequence[float]) -> RtcpError | None:
        now_s = self.arm.now_s
        if self._accepted_s is None:
            self._accepted_s = now_s
        silent_s = now_s - self._accepted_s
        if silent_s > ACTION_TIMEOUT_S:
            # Not sent: the arm has come to rest, and would move again.
            return RtcpError(
                "timeout", f"no action was accepted for {silent_s:.3g} s, each lasts {ACTION_TIMEOUT_S:g} s"
            )
        wrong = next((at for at, value in enumerate(values) if not isfinite(value)), None)
        # A command of a robot passes JSON, which has finite numbers only; a setpoint meets the guard of its stream.
        if wrong is None or self._kind.command is None:
            refusal = self.arm.apply(values)
            self._accepted_s = now_s if refusal is None else self._accepted_s
            return refusal
        return RtcpError("invalid", f"action: number {wrong + 1} is {values[wrong]}: it was not sent")

    def _check_same_actions(self, kind: ActionKind, trained: ArmConfig | None) -> None:
        """Compare the robot's actions with those of the arm that was trained: scaled actions would be others."""
        if trained is not None and (found := kind.bounds(self.arm.config)) != (wanted := kind.bounds(trained)):
            self.arm.close()
            message = f"config: its actions are {wanted[0]} to {wanted[1]}, those of the robot {found[0]} to {found[1]}"
            raise RtcpError("invalid", message)

    def _info(self) -> dict[str, Any]:
        observer = self.arm.observer
        records = observer.events_since(self._event)
        if records:
            self._event = records[-1].number
        events: tuple[Event, ...] = tuple(record.event for record in records)
        return {"events": events, "state": State(int(self._latest()["state"][0]))}

    def _latest(self) -> npt.NDArray[np.void]:
        """Return the newest cycle record, which there is from `begin` on."""
        record = self.arm.observer.latest()
        assert record is not None
        return record

    def _checked(self, positions: Sequence[float]) -> tuple[float, ...]:
        joints = self.config.joints
        try:
            numbers = tuple(float(position) for position in positions)
        except (TypeError, ValueError, OverflowError):
            numbers = ()
        if len(numbers) != len(joints):
            message = f"positions: found {positions!r:.60}, allowed are {len(joints)} numbers, rad: one a joint"
            raise RtcpError("invalid", message)
        for joint, number in zip(joints, numbers, strict=True):
            low, high = joint.position.min, joint.position.max
            if not low - RANGE_MARGIN_RAD <= number <= high + RANGE_MARGIN_RAD:
                message = f"positions: {joint.name} at {number:g} rad, its range is {low:g} to {high:g} rad"
                raise RtcpError("invalid", message)
        return numbers


def _space_of(field: Field) -> gymnasium.spaces.Box:
    """Return the space of a field, as float64: its integers, or what float32 can have, to which libraries convert."""
    kind = np.dtype(field.type)
    limits = np.finfo(np.float32) if kind.kind == "f" else np.iinfo(kind)
    return gymnasium.spaces.Box(float(limits.min), float(limits.max), field.shape or (1,), np.float64)


def _action_space(low: Sequence[float], high: Sequence[float]) -> gymnasium.spaces.Box:
    """Return the space in float32, as libraries expect it; no bound is rounded to beyond the limit."""
    lows, highs = np.asarray(low, np.float32), np.asarray(high, np.float32)
    up, down = np.float32(np.inf), np.float32(-np.inf)
    lows = np.where(lows < np.asarray(low), np.nextafter(lows, up), lows)
    highs = np.where(highs > np.asarray(high), np.nextafter(highs, down), highs)
    return gymnasium.spaces.Box(lows, highs, dtype=np.float32)
