"""`rtcp live` on a whole platform, watched by a client of its protocol, of our own (tests/viewer.py)."""

from __future__ import annotations

import signal
import socket
import subprocess
import time
from typing import Any

import pytest

from rtcp.ipc.session import read_processes
from tests.viewer import Viewer

from .conftest import Platform, kill

pytestmark = pytest.mark.platform


def begun(platform: Platform, *arguments: str) -> tuple[subprocess.Popen[str], str]:
    """Start a live view on a free port; return it and its address."""
    view = platform.background("live", "--port", "0", *arguments)
    assert view.stdout is not None
    return view, view.stdout.readline().partition(": ")[0]


def test_two_views_show_a_move_as_the_platform_reports_it(enabled: Platform) -> None:
    goal = [0.1, -0.1, 0.1, 0.0, 0.0, 0.1]
    views = [begun(enabled, "--every", every) for every in ("1", "5")]
    for (view, url), every in zip(views, (1, 5), strict=True):
        with Viewer(url) as viewer:
            assert "assistive-arm" in viewer.info["name"]
            last: dict[str, Any] = {}
            numbers, states = [], [viewer.first("/machine")["state"]]
            enabled.call("move_joints", q=goal if every == 1 else [0.0] * 6)
            arrived, arrived_ns = enabled.status(), time.monotonic_ns()
            while {"/cycle", "/joint_targets", "/tf"} - last.keys() or last["/cycle"].time_ns < arrived_ns:
                topic, message = viewer.read()
                last[topic] = message
                if topic == "/cycle":
                    numbers.append(message.number)
                elif topic == "/machine" and message["state"] != states[-1]:
                    states.append(message["state"])
        assert numbers == list(range(numbers[0], numbers[-1] + 1, every))
        assert states == ["holding", "moving", "holding"]
        assert last["/joint_states"].position == pytest.approx(arrived["joints"]["actual_position"], abs=1e-4)
        assert last["/joint_targets"].name == last["/joint_states"].name
        # Also for one who comes when all has been said.
        with Viewer(url, ["/robot_description", "/machine"]) as late:
            assert "<robot" in late.first("/robot_description").data
            assert late.first("/machine")["state"] == "holding"
        assert [frame.child_frame_id for frame in last["/tf"].transforms][-1] == "tool0"
        view.send_signal(signal.SIGINT)
        assert view.wait() == 0


def test_the_view_ends_with_the_loop(running: Platform) -> None:
    view, url = begun(running)
    with Viewer(url) as viewer:
        viewer.first("/cycle")
        kill(read_processes(running.directory).loop)
        _, said = view.communicate()
    assert (view.returncode, said) == (4, "rtcp: the platform has ended\n")


def test_what_cannot_be_served_ends_in_one_message(running: Platform) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = str(server.getsockname()[1])
        said = running.rtcp("live", "--port", port, check=3).stderr
    assert said.startswith(f"rtcp: 127.0.0.1 port {port} cannot be listened at: Address already in use")
    assert "nowhere.invalid port 8765 cannot be" in running.rtcp("live", "--host", "nowhere.invalid", check=3).stderr
    assert "--port" in running.rtcp("live", "--port", "70000", check=2).stderr


def test_without_a_platform_there_is_nothing_to_show(platform: Platform) -> None:
    assert "start one with `rtcp start`" in platform.rtcp("live", check=4).stderr


def test_a_view_for_others_says_that_it_is_one(running: Platform) -> None:
    view, _ = begun(running, "--host", "0.0.0.0")
    assert view.stdout is not None
    assert view.stdout.readline() == "whoever reaches 0.0.0.0 can watch: nobody is asked for a name\n"
