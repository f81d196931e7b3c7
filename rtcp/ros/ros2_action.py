"""An action server without ROS: three services and two topics, by the design of actions in ROS 2.

Every goal is accepted, and a refused one is aborted at once: in ROS 2 a rejection has no reason, but a result has one.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from rtcp.ros.commands import CANCELLED, FollowCode
from rtcp.ros.ros2_node import ACTION, Commands, Make, time_of
from rtcp.ros.ros2_types import CANCEL, FOLLOW

_KEPT = 16
"""Most ended goals whose results are kept for requests."""
_UNKNOWN_GOAL, _TERMINATED = 2, 3
"""Return codes of CancelGoal."""


class GoalState(IntEnum):
    """action_msgs/GoalStatus."""

    UNKNOWN = 0
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


_ACTIVE = (GoalState.EXECUTING, GoalState.CANCELING)


@dataclass
class _Goal:
    stamp_ns: int
    """Instant of its acceptance, CLOCK_REALTIME, ns."""
    task: asyncio.Task[tuple[FollowCode, str]]
    ended: asyncio.Future[Any]
    """Its result message."""
    state: GoalState = GoalState.EXECUTING


class ActionServer:
    """FollowJointTrajectory; used from the loop of `Commands`, except `publish_feedback`.

    Args:
        commands: executes the goals.
        make: makes messages.
        publish: publishes on a topic of `ACTION_TOPICS`.
    """

    def __init__(self, commands: Commands, make: Make, publish: Callable[[str, Any], None]) -> None:
        self._commands, self._make, self._publish = commands, make, publish
        self._goals: dict[bytes, _Goal] = {}
        """Id -> goal, oldest first."""

    async def respond(self, service: str, request: Any) -> Any:
        """Execute a service of `ACTION_SERVICES` and return its response."""
        kind = service.rpartition("/")[2]
        if kind == "send_goal":
            return self._begin(request)
        return self._cancel(request) if kind == "cancel_goal" else await self._result(request)

    def publish_feedback(self, feedback: Any) -> None:
        """Publish the feedback of each active goal; from any thread."""
        for key, goal in list(self._goals.items()):
            if goal.state in _ACTIVE:
                message = self._make(f"{FOLLOW}_FeedbackMessage", goal_id=self._uuid(key), feedback=feedback)
                self._publish(f"{ACTION}/_action/feedback", message)

    def _begin(self, request: Any) -> Any:
        key, now_ns = _key(request.goal_id), time.time_ns()
        is_new = key not in self._goals
        if is_new:
            while len(ended := [key for key, goal in self._goals.items() if goal.state not in _ACTIVE]) >= _KEPT:
                del self._goals[ended[0]]
            task = self._commands.loop.create_task(self._commands.follow(request.goal))
            goal = self._goals[key] = _Goal(now_ns, task, self._commands.loop.create_future())
            task.add_done_callback(lambda task: self._end(goal, task))
            self._publish_status()
        return self._make(f"{FOLLOW}_SendGoal_Response", accepted=is_new, stamp=time_of(self._make, now_ns))

    def _end(self, goal: _Goal, task: asyncio.Task[tuple[FollowCode, str]]) -> None:
        if task.cancelled():
            goal.state, (code, text) = GoalState.CANCELED, CANCELLED
        else:
            code, text = task.result()
            goal.state = GoalState.SUCCEEDED if code is FollowCode.SUCCESSFUL else GoalState.ABORTED
        goal.ended.set_result(self._make(f"{FOLLOW}_Result", error_code=int(code), error_string=text))
        self._publish_status()

    def _cancel(self, request: Any) -> Any:
        """Cancel the goal with the id, all up to the stamp, or both; without id and stamp all."""
        key, stamp = _key(request.goal_info.goal_id), request.goal_info.stamp
        until_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        has_key = any(key)
        matching = {
            goal_key: goal
            for goal_key, goal in self._goals.items()
            if goal_key == key or (goal.stamp_ns <= until_ns if until_ns else not has_key)
        }
        canceling = {number: goal for number, goal in matching.items() if goal.state in _ACTIVE}
        for goal in canceling.values():
            goal.state = GoalState.CANCELING
            goal.task.cancel()
        if canceling:
            self._publish_status()
        code = 0
        if has_key and key not in canceling:
            code = _TERMINATED if key in self._goals else _UNKNOWN_GOAL
        infos = [self._info(goal_key, goal) for goal_key, goal in canceling.items()]
        return self._make(f"{CANCEL}_Response", return_code=code, goals_canceling=infos)

    async def _result(self, request: Any) -> Any:
        goal = self._goals.get(_key(request.goal_id))
        if goal is None:
            return self._make(f"{FOLLOW}_GetResult_Response", status=int(GoalState.UNKNOWN))
        result = await asyncio.shield(goal.ended)
        return self._make(f"{FOLLOW}_GetResult_Response", status=int(goal.state), result=result)

    def _publish_status(self) -> None:
        statuses = [
            self._make("action_msgs/msg/GoalStatus", goal_info=self._info(key, goal), status=int(goal.state))
            for key, goal in self._goals.items()
        ]
        message = self._make("action_msgs/msg/GoalStatusArray", status_list=statuses)
        self._publish(f"{ACTION}/_action/status", message)

    def _info(self, key: bytes, goal: _Goal) -> Any:
        stamp = time_of(self._make, goal.stamp_ns)
        return self._make("action_msgs/msg/GoalInfo", goal_id=self._uuid(key), stamp=stamp)

    def _uuid(self, key: bytes) -> Any:
        return self._make("unique_identifier_msgs/msg/UUID", uuid=list(key))


def _key(uuid: Any) -> bytes:
    return bytes(uuid.uuid)
