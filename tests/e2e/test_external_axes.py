"""The linear axis and the conveyor of `config/linear_axis.yaml`, by command line, program and API."""

from __future__ import annotations

from pathlib import Path

import pytest

import rtcp
from rtcp.ipc.runtime_directory import control_socket
from tests.e2e.conftest import CUBEMARS, Platform
from tests.waiting import until

pytestmark = [pytest.mark.platform, CUBEMARS]

PROGRAM = """
program:
  - {axis: belt, velocity: 0.1, time_s: 60}
  - {axis: rail, position: 0.2, speed: 0.2}
  - {axis: rail, position: 0.1}
"""


@pytest.mark.long("test_a_conveyor_runs_for_its_hold_time_and_each_command_holds_anew")
def test_an_axis_homes_and_moves_while_a_conveyor_runs_and_a_client_that_leaves_stops_it(
    platform: Platform, tmp_path: Path
) -> None:
    platform.be_patient(2000)
    config = platform.directory / "config" / "linear_axis.yaml"
    config.write_text(config.read_text().replace("period_us: 1000", "period_us: 4000"))
    platform.rtcp("start", "--config", str(config), "--detach")
    platform.rtcp("enable")
    assert "not homed" in platform.rtcp("axis", "move", "rail", "0.1", check=3).stderr
    assert "rail is homed" in platform.rtcp("axis", "home", "rail").stdout
    assert platform.rtcp("axis", "move", "rail", "-0.05", "--speed", "0.2").stdout == "rail is at -0.05 m\n"
    program = tmp_path / "both.yaml"
    program.write_text(PROGRAM)
    with rtcp.connect("a test", control_socket(platform.directory)) as robot:
        before = robot.status().axes["belt"].position
        rtcp.Program(program).run(robot)
        axes = robot.status().axes
        assert axes["rail"].position == pytest.approx(0.1, abs=2e-3)
        # It ran while the rail moved, and the end of the program has stopped it.
        assert axes["belt"].position > before + 0.1
        assert not axes["belt"].moving
        robot.run_axis("belt", 0.1, 60.0)
        until(lambda: robot.status().axes["belt"].velocity > 0.09, "the speed of the belt")
    with rtcp.connect("another", control_socket(platform.directory)) as robot:
        until(lambda: not robot.status().axes["belt"].moving, "rest of the belt")
        robot.disable()
