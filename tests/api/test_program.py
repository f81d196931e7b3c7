"""Programs: their steps in order, joined where they are blended, on a fake robot that records its calls."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rtcp.api import Preview, RtcpError
from rtcp.api.program import Begun, Program
from rtcp.api.results import Levels, Terminals
from rtcp.config.model import ConfigError
from tests.findings import findings_of, summary

TEXT = """
speed: 0.1
poses:
  - {name: home, q: [0, 0, 0, 0, 0, 0]}
  - {name: right, pose: [0.1, 0, 0, 0, 0, 0]}
  - {name: below, pose: [0.2, 0, 0, 0, 0, 0]}
program:
  - {move: home, speed: 0.4}
  - {run: round, times: 3}
  - {gripper: open}
  - {output: lamp, value: false}
  - {wait_for: start, timeout_s: 2}
  - {wait_s: 0.001}
parts:
  - name: round
    steps:
      - {line: right, blend: 0.02}
      - {arc: below, via: home, angle: pi, blend: 0.01}
      - {run: twice}
  - name: twice
    steps:
      - {line: home}
"""


BACK = """
speed: 0.1
poses:
  - {name: home, q: [0, 0, 0, 0, 0, 0]}
  - {name: right, pose: [0.1, 0, 0, 0, 0, 0]}
  - {name: below, pose: [0.2, 0, 0, 0, 0, 0]}
program:
  - {tool: short}
  - {move: home}
  - {run: there}
  - {line: below, speed: 0.2, blend: 0.01}
  - {arc: right, via: below}
  - {gripper: open}
  - {move: below, speed: 0.4}
  - {arc: right, via: below, angle: pi}
  - {line: home}
  - {tool: long}
  - {line: right}
parts:
  - {name: there, steps: [{line: right}]}
"""


class NotingRobot:
    """A fake `Robot` that records its calls and refuses the motion with the number `refused`."""

    def __init__(self, refused: int = -1, reason: str | None = None) -> None:
        self.done: list[Any] = []
        self.planned: list[Any] = []
        self._refused, self._reason = refused, reason
        self.io = self
        self.tool = "short"
        self.positions = (0.5,) * 6
        self.happened: list[Any] = []
        levels = [
            {"name": name, "box": "box", "number": number, "value": False, "has_function": name == "state_lamp"}
            for number, name in enumerate(("lamp", "state_lamp"), 1)
        ]
        self.axes = {"rail": None, "belt": None}
        self.terminals = Terminals(Levels([{**levels[0], "name": "start"}]), Levels(levels))

    def happens(self, number: int, name: str, severity: str = "note") -> None:
        self.happened.append(SimpleNamespace(number=number, name=name, severity=severity, message="it happened"))

    def read_io(self) -> Terminals:
        return self.terminals

    def events(self, since: int = 0) -> list[Any]:
        return [event for event in self.happened if event.number > since]

    def status(self) -> Any:
        return SimpleNamespace(commanded_positions=self.positions, tool=self.tool, axes=self.axes)

    def fk(self, q: Sequence[float]) -> list[float]:
        return [9.0, 8.0, 7.0, *q[:3]]

    def preview(self, stops: Sequence[dict[str, Any]], start: Sequence[float], speed: float) -> Preview:
        if len(self.planned) == self._refused:
            raise RtcpError("refused", "the line cannot be", self._reason)
        self.planned.append((list(stops), list(start), speed))
        return Preview((tuple(start), (float(len(self.planned)),) * 6), 1.0)

    def run_path(self, stops: Sequence[dict[str, Any]], speed: float) -> None:
        self.done.append([stop.get("pose", stop.get("q"))[0] for stop in stops])

    def gripper(self, opened: bool) -> None:
        self.done.append(f"gripper {opened}")

    def move_axis(self, axis: str, position: float, speed: float | None) -> None:
        self.done.append(f"{axis} to {position:g} at {speed}")

    def run_axis(self, axis: str, velocity: float, hold_s: float) -> None:
        self.done.append(f"{axis} runs {velocity:g} for {hold_s:g}")

    def home_axis(self, axis: str) -> None:
        self.done.append(f"{axis} home")

    def stop_axis(self, axis: str) -> None:
        self.done.append(f"{axis} stops")

    def __setitem__(self, name: str, value: bool) -> None:
        self.done.append(f"{name} {value}")

    def wait(self, name: str, value: bool, timeout_s: float) -> None:
        self.done.append(f"wait {name} {value} {timeout_s:g}")


@pytest.fixture
def program(tmp_path: Path) -> Callable[..., Program]:
    def load(text: str = TEXT) -> Program:
        file = tmp_path / "program.yaml"
        file.write_text(text)
        return Program(file)

    return load


def test_steps_are_carried_out_in_order_and_blended_ones_are_one_motion(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    begun_steps: list[tuple[int, str]] = []
    program().run(robot, lambda begun: begun_steps.append((begun.line, begun.text)))
    rounds = [[0.1, 0.2, 0]] * 3
    assert robot.done == [[0], *rounds, "gripper True", "lamp False", "wait start True 2"]
    assert [line for line, _ in begun_steps] == [8, 17, 17, 17, 10, 11, 12, 13]


AXES = """
program:
  - {axis: rail, home: true}
  - {axis: belt, velocity: 0.1, time_s: 20}
  - {axis: rail, position: 0.3, speed: 0.1}
  - {wait_s: 0.001}
"""


def test_steps_of_axes_are_carried_out_and_one_that_runs_stops_where_the_program_ends(
    program: Callable[..., Program],
) -> None:
    robot: Any = NotingRobot()
    begun: list[str] = []
    program(AXES).run(robot, lambda step: begun.append(step.text))
    assert robot.done == ["rail home", "belt runs 0.1 for 20", "rail to 0.3 at 0.1", "belt stops"]
    assert begun[:3] == ["axis rail: home", "axis belt: velocity 0.1 for 20 s", "axis rail: to 0.3"]


def test_a_program_that_fails_stops_the_axes_that_it_runs(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()

    def fail(*arguments: object) -> None:
        raise RtcpError("refused", "rail is not homed")

    robot.move_axis = fail
    with pytest.raises(RtcpError, match="not homed"):
        program(AXES).run(robot)
    assert robot.done[-1] == "belt stops"


def test_a_step_of_an_axis_that_does_not_exist_keeps_all_from_beginning(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    del robot.axes["belt"]
    with pytest.raises(
        RtcpError, match=r'program\.yaml:4: axis: found the text "belt", allowed is one of rail'
    ) as error:
        program(AXES).run(robot)
    assert error.value.reason == "unknown_axis"
    assert not robot.done


def test_all_is_planned_from_where_the_motion_before_ends_and_loops_twice(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    planned = program().check(robot)
    assert [motion.line for motion in planned] == [8, 17, 17]
    assert [start for _, start, _ in robot.planned] == [[0.5] * 6, [1.0] * 6, [2.0] * 6]
    stops = robot.planned[1][0]
    assert stops[0] == {"pose": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], "blend": 0.02, "by_joints": False}
    assert stops[1]["via"] == [9.0, 8.0, 7.0]
    assert stops[1]["angle"] == pytest.approx(3.14159, abs=1e-4)
    assert robot.planned[0][0] == [{"q": [0.0] * 6, "blend": 0.0, "by_joints": True, "speed": 0.4}]
    assert not robot.done


def test_a_motion_that_is_refused_keeps_all_from_beginning_and_names_its_line(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot(refused=1)
    with pytest.raises(RtcpError, match=r"program\.yaml:17: the line cannot be"):
        program().run(robot)
    assert not robot.done


def test_a_motion_to_where_the_arm_is_is_passed_over(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot(refused=0, reason="AlreadyThere")
    plan = robot.preview

    def preview(**options: Any) -> Preview:
        try:
            preview_made: Preview = plan(**options)
        finally:
            robot._refused = -1
        return preview_made

    robot.preview = preview
    assert [motion.line for motion in program().check(robot)] == [17, 17]


def test_a_program_for_ever_is_planned_and_goes_on(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    endless = program(TEXT.replace("times: 3", "times: 0"))
    assert len(endless.check(robot)) == 3

    def stop(begun: Begun) -> None:
        if len(robot.done) == 50:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        endless.run(robot, stop)
    assert robot.done[1:] == [[0.1, 0.2, 0]] * 49


# -- a part of a program ----------------------------------------------------------------------------------------------


def test_it_runs_from_a_step_to_another_and_plans_only_these(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    numbers: list[int] = []
    program().run(robot, lambda begun: numbers.append(begun.number), start=1, end=3)
    assert robot.done == [[0.1, 0.2, 0]] * 3 + ["gripper True"]
    assert numbers == [1, 1, 1, 2]
    assert len(robot.planned) == 2


def test_it_waits_before_each_step_and_ends_in_a_wait_by_what_is_raised(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    requests: list[int] = []

    def between() -> None:
        requests.append(len(robot.done))
        if len(requests) == 8:
            raise TimeoutError

    waiting = program(TEXT.replace("wait_s: 0.001", "wait_s: 60"))
    with pytest.raises(TimeoutError):
        waiting.run(robot, between=between)
    assert requests == [0, 1, 2, 3, 4, 5, 6, 7]


@pytest.mark.parametrize(
    ("number", "stop"),
    [
        (2, {"q": [0.0] * 6, "blend": 0.0, "by_joints": True}),
        (3, {"pose": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], "blend": 0.0, "by_joints": False, "speed": 0.2}),
        (4, {"pose": [0.2, *[0.0] * 5], "blend": 0.0, "by_joints": False, "via": [0.2, 0.0, 0.0], "angle": None}),
        (6, {"pose": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0], "blend": 0.0, "by_joints": True, "speed": 0.4}),
    ],
)  # fmt: skip
def test_a_step_back_takes_the_way_of_the_step_to_where_it_began(
    program: Callable[..., Program], number: int, stop: dict[str, Any]
) -> None:
    robot: Any = NotingRobot()
    robot.run_path = lambda stops, speed: robot.done.append((list(stops), speed))
    program(BACK).step_back(robot, number)
    assert robot.done == [([stop], 0.1)]


@pytest.mark.parametrize(("number", "moves"), [(1, False), (5, None), (7, False), (8, False), (10, False)])
def test_there_is_no_way_back_before_the_first_motion_and_over_arcs_with_an_angle(
    program: Callable[..., Program], number: int, moves: bool | None
) -> None:
    robot: Any = NotingRobot()
    loaded = program(BACK)
    if moves is None:
        loaded.step_back(robot, number)  # no motion: nothing is undone
    else:
        with pytest.raises(RtcpError, match="no way back over this step") as refused:
            loaded.step_back(robot, number)
        assert refused.value.reason == "no_way_back"
    assert not robot.done


def test_a_program_that_begins_behind_the_choice_of_a_tool_needs_that_tool(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    text = TEXT.replace("{gripper: open}", "{tool: long}").replace("via: home", "via: right")
    loaded = program(text.replace("program:\n", "program:\n  - {tool: short}\n"))
    for run in (loaded.run, loaded.check):
        with pytest.raises(RtcpError, match=r"program\.yaml:12: the program uses the tool long there") as refused:
            run(robot, start=4)
        assert refused.value.reason == "another_tool"
    assert not robot.done
    robot.tool = "long"
    loaded.run(robot, start=4)
    assert robot.done[0] == "lamp False"


def test_a_tool_that_somebody_else_chooses_ends_the_program(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()

    def disturb(begun: Begun) -> None:
        if "lamp" in begun.text:
            robot.tool = "long"

    with pytest.raises(RtcpError, match="chosen the tool long meanwhile") as ended:
        program().run(robot, disturb)
    assert ended.value.reason == "another_tool"


def test_a_halt_ends_a_program_that_waits_for_a_time_at_once(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()

    def halt() -> None:
        if "wait start True 2" in robot.done:
            robot.happens(1, "halted_at_rest")

    with pytest.raises(RtcpError, match="it happened; the program ends"):
        program(TEXT.replace("wait_s: 0.001", "wait_s: 60")).run(robot, between=halt)


def test_a_motion_of_others_ends_it_before_the_next_step(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()

    def disturb(begun: Begun) -> None:
        if "lamp" in begun.text:
            robot.positions = (0.6,) * 6

    with pytest.raises(RtcpError, match=r"program\.yaml:12: the arm was") as ended:
        program().run(robot, disturb)
    assert ended.value.reason == "moved_meanwhile"
    assert robot.done[-1] == "lamp False"


@pytest.mark.parametrize(
    ("number", "name", "severity", "reason"),
    [
        (4, "halted_at_rest", "note", "halted"),
        (4, "disabled", "note", "interrupted"),
        (4, "control_mode_changed", "note", "interrupted"),
        (4, "drive_fault", "fault", "interrupted"),
        (4, "emergency_stop_activated", "emergency_stop", "interrupted"),
        (300, "speed_override_changed", "note", "interrupted"),
    ],
)
def test_what_stops_the_arm_ends_it_before_the_next_step_although_it_is_enabled_again(
    program: Callable[..., Program], number: int, name: str, severity: str, reason: str
) -> None:
    robot: Any = NotingRobot()
    robot.happens(3, "halted_at_rest")

    def disturb(begun: Begun) -> None:
        if "lamp" in begun.text:
            robot.happens(number, name, severity)
            robot.happens(number + 1, "enabled")

    with pytest.raises(RtcpError, match=r"program\.yaml:12: .*meanwhile") as ended:
        program().run(robot, disturb)
    assert ended.value.reason == reason
    assert robot.done[-1] == "lamp False"


def test_events_that_stop_nothing_let_it_go_on_however_many_they_are(program: Callable[..., Program]) -> None:
    robot: Any = NotingRobot()
    program().run(robot, lambda begun: robot.happens(len(robot.happened) + 1, "speed_override_changed"))
    assert robot.done[-1] == "wait start True 2"


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("output: lamp", "output: lamb", '11: output: found the text "lamb", allowed is one of lamp, box.1'),
        ("output: lamp", "output: box.2", '11: output: found the text "box.2", allowed is one of lamp, box.1'),
        ("wait_for: start", "wait_for: box.7", '12: wait_for: found the text "box.7", allowed is one of start, lamp'),
    ],
)
def test_a_terminal_that_does_not_exist_or_has_a_function_is_refused_before_the_first_motion(
    program: Callable[..., Program], old: str, new: str, sentence: str
) -> None:
    robot: Any = NotingRobot()
    with pytest.raises(RtcpError, match=re.escape(sentence)):
        program(TEXT.replace(old, new)).run(robot, check=False)
    assert not robot.done


def test_a_part_that_runs_again_is_a_motion_of_its_own_also_where_its_last_step_is_blended(
    program: Callable[..., Program],
) -> None:
    robot: Any = NotingRobot()
    loaded = program(TEXT.replace("- {line: home}", "- {line: home, blend: 0.01}").replace("times: 3", "times: 500"))
    assert len(loaded.check(robot)) == 3
    loaded.run(robot)
    assert robot.done[1:501] == [[0.1, 0.2, 0]] * 500


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("line: home", "line: hoem", "22 parts[1].steps[0].line: no_name found=hoem"),
        ("run: twice", "run: round", "parts[0].steps: circle found=round"),
        ("line: home", "run: round", "parts[0].steps: circle found=round"),
        ("{wait_s: 0.001}", "{tool: probe}", "18 parts[0].steps[1].via: via_has_q found=home"),
        ("via: home, ", "", "18 parts[0].steps[1].arc: needs_beside need=via"),
        ("{gripper: open}", "{gripper: open, speed: 1}", "10 program[2].speed: beside found=gripper"),
        ("{gripper: open}", "{gripper: open, wait_s: 1}", "10 program[2]: one_of_keys found=gripper and wait_s"),
        (
            "{gripper: open}",
            "{axis: rail, position: 1, home: true}",
            "10 program[2]: one_of_keys found=position and home",
        ),
        ("{gripper: open}", "{axis: rail, velocity: 0.1}", "10 program[2].velocity: needs_beside need=time_s"),
        ("{gripper: open}", "{axis: rail, home: true, speed: 1}", "10 program[2].speed: beside found=home"),
        ("{gripper: open}", "{gripper: open, home: true}", "10 program[2].home: beside found=gripper"),
        ("{gripper: open}", "{}", "10 program[2]: one_of_keys found=none of them"),
        ("name: below", "name: right", "6 poses[2].name: name_twice found=right"),
        ("times: 3", "times: -1", "9 program[1].times: range"),
        ("q: [0, 0, 0, 0, 0, 0]", "q: [0, 0]", "4 poses[0].q: size"),
        ("program:", "path: [{q: [0, 0, 0, 0, 0, 0]}]\nprogram:", "program: several_motions"),
    ],
)
def test_a_mistake_is_named_with_its_line(program: Callable[..., Program], old: str, new: str, expected: str) -> None:
    assert old in TEXT
    findings = findings_of(lambda: program(TEXT.replace(old, new, 1)))
    assert expected in [summary(finding, expected) for finding in findings]


@pytest.mark.parametrize(("calls", "depth"), [(2, 20), (1, 1500)])
def test_a_program_of_parts_in_parts_that_is_too_long_or_too_deep_is_refused_at_once(
    program: Callable[..., Program], calls: int, depth: int
) -> None:
    runs = "".join(
        f"  - {{name: p{at}, steps: [{', '.join([f'{{run: p{at - 1}}}'] * calls)}]}}\n" for at in range(1, depth)
    )
    parts = f"parts:\n  - {{name: p0, steps: [{{move: home}}, {{gripper: open}}]}}\n{runs}"
    with pytest.raises(ConfigError, match=r"found (endless|1048576|1.04858e\+06) steps .* allowed are 10000"):
        program(f"poses: [{{name: home, q: [0, 0, 0, 0, 0, 0]}}]\nprogram: [{{run: p{depth - 1}}}]\n{parts}")


def test_a_file_without_a_program_says_what_runs_it(program: Callable[..., Program]) -> None:
    with pytest.raises(ConfigError, match="it holds no program"):
        program("path:\n  - {q: [0, 0, 0, 0, 0, 0]}\n")
