"""Operators, faults and references at random: limits hold, and nothing moves for long without motors."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("google.protobuf", reason="protobuf is not installed: pip install 'rtcp[abb]'")

from rtcp.virtual.irc5.panel import STOPPING_TIME_S, Motors
from rtcp.virtual.request_socket import RequestRefused
from tests.virtual.irc5.wire import PERIOD, pc

CIRCUITS = ("emergency", "automatic", "general", "superior")
REQUESTS: list[dict[str, Any]] = [
    *({"do": do} for do in ("motors_on", "motors_off", "start_rapid", "stop_rapid", "clear", "status")),
    *({"do": "mode", "mode": mode} for mode in ("hand", "auto")),
    *({"do": "enabling", "position": position} for position in ("released", "middle", "through")),
    *({"do": do, "circuit": circuit} for do in ("stop", "release") for circuit in CIRCUITS),
    *({"do": "fault", "fault": kind} for kind in ("seqno_restart", "convergence", "mci_error", "collision")),
    *({"do": "fault", "fault": "silent", "direction": side} for side in ("to_pc", "from_pc")),
    *({"do": "fault", "fault": kind, "value": 0.3, "direction": "from_pc"} for kind in ("lost", "doubled", "old")),
]
REFERENCE = st.lists(st.floats(-200.0, 200.0), min_size=6, max_size=6)
STEP = st.tuples(st.sampled_from(REQUESTS), st.none() | REFERENCE, st.none() | REFERENCE, st.integers(1, 60))


@given(st.lists(STEP, max_size=15), st.sampled_from(["auto", "hand"]))
def test_limits_hold_and_an_arm_without_motors_stands(steps: list[Any], mode: str) -> None:
    robot = pc(controller={"mode": mode}, egm={"cond_time_s": 0.1, "max_speed_deviation": 100.0})
    unit, without_motors = robot.unit, 0.0
    for request, position, speed, cycles in steps:
        with suppress(RequestRefused):
            robot.controller.request(request)
        for _ in range(cycles):
            before = unit.planned
            robot.cycle(position, speed)
            without_motors = without_motors + PERIOD if robot.controller.panel.motors is Motors.OFF else 0.0
            for then, now, (low, high) in zip(before, unit.planned, unit.ranges, strict=True):
                assert low <= now <= high
                assert abs(now - then) <= 100.0 * PERIOD * (1 + 1e-9)
            if without_motors > STOPPING_TIME_S[0] + 2 * PERIOD:
                assert unit.planned == before
                assert not unit.rapid_running
