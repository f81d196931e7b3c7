"""`rtcp live` on a whole platform, watched by a client of its protocol, of our own (tests/viewer.py)."""

from __future__ import annotations

import signal
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


def test_a_view_shows_a_move_as_the_platform_reports_it_and_says_that_others_can_watch(enabled: Platform) -> None:
    view, url = begun(enabled, "--every", "2", "--host", "0.0.0.0")
    assert view.stdout is not None
    assert view.stdout.readline() == "whoever reaches 0.0.0.0 can watch: nobody is asked for a name\n"
    with Viewer(url) as viewer:
        assert "assistive-arm" in viewer.info["name"]
        last: dict[str, Any] = {}
        numbers, states = [], [viewer.first("/machine")["state"]]
        enabled.call("move_joints", q=[0.1, -0.1, 0.1, 0.0, 0.0, 0.1])
        arrived, arrived_ns = enabled.status(), time.monotonic_ns()
        while {"/cycle", "/joint_targets", "/tf"} - last.keys() or last["/cycle"].time_ns < arrived_ns:
            topic, message = viewer.read()
            last[topic] = message
            if topic == "/cycle":
                numbers.append(message.number)
            elif topic == "/machine" and message["state"] != states[-1]:
                states.append(message["state"])
    assert numbers == list(range(numbers[0], numbers[-1] + 1, 2))
    assert states == ["holding", "moving", "holding"]
    assert last["/joint_states"].position == pytest.approx(arrived["joints"]["actual_position"], abs=1e-3)
    assert last["/joint_targets"].name == last["/joint_states"].name
    assert [frame.child_frame_id for frame in last["/tf"].transforms][-1] == "tool0"
    # Also for one who comes when all has been said.
    with Viewer(url, ["/robot_description", "/machine"]) as late:
        assert "<robot" in late.first("/robot_description").data
        assert late.first("/machine")["state"] == "holding"
    view.send_signal(signal.SIGINT)
    assert view.wait() == 0


def test_the_view_ends_with_the_loop(running: Platform) -> None:
    view, url = begun(running)
    with Viewer(url) as viewer:
        viewer.first("/cycle")
        kill(read_processes(running.directory).loop)
        _, said = view.communicate()
    running.restore()  # the other tests of this worker need a loop
    assert (view.returncode, said) == (4, "rtcp: the platform has ended\n")
