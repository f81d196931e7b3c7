"""A client with rmw_zenoh's conventions in literals of its own, and a router."""

from __future__ import annotations

import itertools
import struct
import time
from typing import Any

import zenoh

from rtcp.ros.ros2_types import FOLLOW, decode, encode, make, type_hash
from rtcp.ros.ros2_zenoh import open_session
from tests.ros.test_commands import NAMES
from tests.waiting import until

from .node import free_port, trajectory

JOINT_STATES = (
    "0/joint_states/sensor_msgs::msg::dds_::JointState_/"
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
)
GID = bytes(range(16))


class Router:
    """A router on loopback, as ROS starts one."""

    def __init__(self) -> None:
        self.address = f"tcp/127.0.0.1:{free_port()}"
        self.open()

    def open(self) -> None:
        self.session = open_session(self.address, is_router=True)

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]


def tokens(session: Any) -> set[str]:
    return {str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**") if reply.ok}


def call(session: Any, service: str, kind: str, **fields: Any) -> Any:
    """Call a service as rmw_zenoh does; return the response."""
    package, folder, name = kind.split("/")
    key = f"0/{service}/{package}::{folder}::dds_::{name}_/{type_hash(kind)}"
    until(lambda: any(f"/SS/%/%/arm/%{service.replace('/', '%')}/" in token for token in tokens(session)), service)
    replies = session.get(
        key,
        payload=encode(f"{kind}_Request", make(f"{kind}_Request", **fields)),
        attachment=struct.pack("<qqB16s", 7, time.time_ns(), 16, GID),
        target=zenoh.QueryTarget.ALL_COMPLETE,
        timeout=100.0,
    )
    (reply,) = list(replies)
    number, _, length, gid = struct.unpack("<qqB16s", reply.ok.attachment.to_bytes())
    assert (number, length, gid) == (7, 16, GID)
    return decode(f"{kind}_Response", reply.ok.payload.to_bytes())


class Goal:
    """A goal of the action, as a client of ROS 2 sends it."""

    ids = itertools.count(1)

    def __init__(self, session: Any, names: Any = NAMES) -> None:
        self._session = session
        self.uuid = make("unique_identifier_msgs/msg/UUID", uuid=next(self.ids).to_bytes(16, "little"))
        goal = make(f"{FOLLOW}_Goal", trajectory=trajectory(names))
        self.accepted = self._call("send_goal", f"{FOLLOW}_SendGoal", goal_id=self.uuid, goal=goal).accepted

    def _call(self, service: str, kind: str, **fields: Any) -> Any:
        return call(self._session, f"joint_trajectory_action/_action/{service}", kind, **fields)

    def result(self) -> Any:
        return self._call("get_result", f"{FOLLOW}_GetResult", goal_id=self.uuid)

    def cancel(self) -> Any:
        info = make("action_msgs/msg/GoalInfo", goal_id=self.uuid)
        return self._call("cancel_goal", "action_msgs/srv/CancelGoal", goal_info=info)
