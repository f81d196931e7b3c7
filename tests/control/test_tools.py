"""Two tools on the in-process bus: guards, plans and gravity are those of the tool in use."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from math import dist, inf, nan
from pathlib import Path

import pytest

from kinematics.forward import forward, frames
from kinematics.gravity import gravity_torques
from kinematics.model import LinkMass
from rtcp.config import load
from rtcp.config.cell import Base, Member
from rtcp.config.model import Point, Stop
from rtcp.ipc.commands import (
    ApplyTorque,
    Command,
    Jog,
    RunLines,
    RunTrajectory,
    SetControlMode,
    SetPayload,
    SetTool,
)
from rtcp.ipc.events import BoxReached, PayloadChanged, ToolChanged
from rtcp.ipc.names import Names
from rtcp.ipc.states import ControlMode, JogFrame, State
from rtcp.motion.controllers.jog_bounds import STANDOFF_M
from rtcp.motion.guards.neighbours import body_of
from rtcp.motion.guards.zones import Zones
from rtcp.motion.planning.lines import plan_lines
from rtcp.motion.planning.trajectories import plan_trajectory
from rtcp.testing.simulation import Simulation
from tests.two_tools import two_tools

FLANGE, PROBE = 0, 1
BENT = (0.0, -0.2, 2.0, 0.0, 1.0, 0.0)
BESIDE_USER = (0.5, -0.6, -1.5, 0.0, 1.0, 0.0)
"""The flange is free there, and the probe would be in the user's box."""


class Tooled(Simulation):
    """The arm, holding."""

    def __init__(self, file: Path, positions: tuple[float, ...]) -> None:
        config = load(file)
        config = replace(config, cycle=replace(config.cycle, period_us=2000.0))
        super().__init__(config, positions=positions, follow_clock=False)
        self.hold()

    def refusal(self, command: Command) -> str:
        refusal = self.send(command).refusal
        return "" if refusal is None else Names(self.config).message(refusal)

    def run_to(self, q: tuple[float, ...], tool: int) -> None:
        """Run a trajectory that is not checked against the boxes."""
        points = [Point(0.0, tuple(self.q)), Point(14.0, q)]
        plan = plan_trajectory(points, self.loop.arm.limits, self.q)
        self.do(RunTrajectory(self.observer.write_plan(plan.rows), len(plan.rows), tool=tool))
        assert self.until(lambda: self.state in (State.HOLDING, State.STOPPED_BY_LIMIT), 20.0)

    @property
    def q(self) -> list[float]:
        return list(self.loop.arm.state.commanded)

    def clearance(self, number: int) -> float:
        """Distance of the arm with a tool from boxes and itself, less the configured clearance, m."""
        model = self.config.models[number]
        zones = Zones(model, self.loop.arm.limits, self.config.cartesian.clearance)
        return zones.distance(frames(model, self.q))[0]


@pytest.fixture
def arm(tmp_path: Path) -> Iterator[Callable[[tuple[float, ...]], Tooled]]:
    made: list[Tooled] = []

    def begin(positions: tuple[float, ...]) -> Tooled:
        made.append(Tooled(two_tools(tmp_path), positions))
        return made[-1]

    yield begin
    for simulation in made:
        simulation.close()


def test_with_a_long_tool_the_arm_stops_before_a_box_that_the_short_one_passes(
    arm: Callable[[tuple[float, ...]], Tooled],
) -> None:
    bent = arm(BENT)
    bent.run_to(BESIDE_USER, FLANGE)
    assert bent.state is State.HOLDING
    assert bent.q == pytest.approx(BESIDE_USER)
    refused = bent.refusal(SetTool(PROBE))
    assert "with the tool probe the arm would be beyond the bounds of the keep-out box user" in refused
    assert bent.observer.latest()[0]["tool"] == FLANGE
    bent.run_to(BENT, FLANGE)
    bent.do(SetTool(PROBE))
    bent.run_to(BESIDE_USER, PROBE)
    assert bent.state is State.STOPPED_BY_LIMIT
    assert [type(record.event) for record in bent.events if isinstance(record.event, (BoxReached, ToolChanged))] == [
        ToolChanged, BoxReached,
    ]  # fmt: skip
    assert 0.0 <= bent.clearance(PROBE) < 0.05
    assert bent.observer.latest()[0]["tool"] == PROBE


@pytest.mark.parametrize("kind", [RunLines, RunTrajectory])
def test_a_plan_for_another_tool_is_refused_and_one_for_this_tool_runs(
    arm: Callable[[tuple[float, ...]], Tooled], kind: type[RunLines | RunTrajectory]
) -> None:
    bent = arm(BENT)
    model = bent.config.models[PROBE]
    x, y, z = forward(model, BENT).position
    goal = (x + 0.1, y + 0.1, z, *forward(model, BENT).rpy)
    plan = plan_lines(
        model, bent.loop.arm.limits, bent.config.cartesian, bent.q, [Stop(goal)], speed=0.1, zone_at=lambda q: None
    )
    slot = bent.observer.write_plan(plan.rows)
    text = "the motion was planned for the tool probe, and flange is in use: plan it again"
    assert bent.refusal(kind(slot, 1, tool=PROBE)) == text
    assert bent.q == pytest.approx(BENT)
    bent.do(SetTool(PROBE))
    text = "the motion was planned for the tool flange, and probe is in use: plan it again"
    assert bent.refusal(kind(slot, 1, tool=FLANGE)) == text
    bent.do(RunLines(slot, 1, PROBE))
    assert "not accepted in state moving" in bent.refusal(SetTool(FLANGE))
    bent.bring_to(State.HOLDING, 20.0)
    assert forward(model, bent.q).position == pytest.approx(goal[:3], abs=1e-6)


def test_a_jog_turns_about_the_point_of_the_tool_in_use(arm: Callable[[tuple[float, ...]], Tooled]) -> None:
    bent = arm(BENT)
    bent.do(SetTool(PROBE))
    flange, probe = ([forward(model, bent.q).position] for model in bent.config.models)
    for _ in range(10):
        bent.do(Jog((0.0, 0.0, 0.0, 0.0, 0.3, 0.0), JogFrame.TOOL, 0.2))
        bent.run(0.1)
        for places, model in zip((flange, probe), bent.config.models, strict=True):
            places.append(forward(model, bent.q).position)
    assert max(dist(place, probe[0]) for place in probe) < 1e-4
    assert dist(flange[-1], flange[0]) > 0.05


def test_a_jog_slides_along_the_boxes_of_the_tool_in_use(arm: Callable[[tuple[float, ...]], Tooled]) -> None:
    near_user = arm((1.4, -0.4, -1.2, 0.0, 1.2, 0.0))
    near_user.do(SetTool(PROBE))
    assert near_user.clearance(PROBE) > 0.016
    for _ in range(40):
        near_user.do(Jog((0.1, 0.0, 0.0, 0.0, 0.0, 0.0), JogFrame.BASE, 0.2))
        near_user.run(0.1)
    assert near_user.state is State.MOVING  # no guard has stopped it
    assert near_user.clearance(PROBE) == pytest.approx(STANDOFF_M, abs=1e-4)


def test_partners_in_a_cell_keep_away_from_the_bodies_of_all_tools(tmp_path: Path) -> None:
    config = load(two_tools(tmp_path))
    body, bare = (body_of(Member("left", platform, Base())) for platform in (config, replace(config, other_tools=())))
    assert body is not None
    assert bare is not None
    assert body.placed.bodies == (*bare.placed.bodies, *(config.models[PROBE].tool_bodies or ()))


def test_the_weight_of_the_tool_and_of_the_payload_is_carried(arm: Callable[[tuple[float, ...]], Tooled]) -> None:
    bent = arm(BENT)
    gravity, models = bent.loop.arm.gravity, bent.config.models
    assert gravity.torques(BENT) == gravity_torques(models[FLANGE], BENT)
    bent.do(SetTool(PROBE))
    assert gravity.torques(BENT) == gravity_torques(models[PROBE], BENT)
    bent.do(SetPayload(0.5, 0.0, 0.1, 0.2))
    expected = gravity_torques(models[PROBE], BENT, payload=LinkMass(0.5, (0.0, 0.1, 0.2)))
    assert gravity.torques(BENT) == expected
    assert abs(expected[2] - gravity_torques(models[PROBE], BENT)[2]) > 3.0
    record = bent.observer.latest()[0]
    shown = [record[name] for name in ("tool", "payload_mass", "payload_x", "payload_y", "payload_z")]
    assert shown == [PROBE, 0.5, 0.0, 0.1, 0.2]
    assert [record.event for record in bent.events][-2:] == [ToolChanged(PROBE), PayloadChanged(0.5)]
    # The tool in use keeps its payload when it is chosen again; another tool has none.
    bent.do(SetTool(PROBE))
    assert gravity.torques(BENT) == expected
    bent.do(SetTool(FLANGE))
    assert gravity.torques(BENT) == gravity_torques(models[FLANGE], BENT)
    assert bent.observer.latest()[0]["payload_mass"] == 0.0


def test_in_control_mode_torque_the_payload_changes_the_torques_that_are_sent(
    arm: Callable[[tuple[float, ...]], Tooled],
) -> None:
    begun, sent = [], []
    for mass in (0.0, 1.0):
        bent = arm(BENT)
        bent.do(SetPayload(mass))
        bent.do(SetControlMode(ControlMode.TORQUE))
        bent.run(0.5)
        # At first the torques hold the arm as it was; the payload changes them once the arm has moved.
        for _ in range(10):
            bent.do(ApplyTorque((0.0, 15.0, 0.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.5))
            bent.run(0.1)
        record, model = bent.observer.latest()[0], bent.config.models[FLANGE]
        payload = LinkMass(mass, (0.0, 0.0, 0.0))
        now, before = (gravity_torques(model, q, payload=payload) for q in (record["actual_position"].tolist(), BENT))
        begun.append(record["sent_torque"][2] - now[2] + before[2])
        sent.append(record["sent_torque"][2])
    assert begun[0] == pytest.approx(begun[1], abs=0.02)
    assert abs(sent[0] - sent[1]) > 0.3


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (SetTool(2), "tool 2 does not exist: 0 to 1, in the order of kinematics.tools in assistive_arm.yaml"),
        (SetTool(-1), "tool -1 does not exist"),
        (SetPayload(1.6), "a payload of 1.6 kg is not allowed: 0 to 1.5 kg (payload.max_mass in assistive_arm.yaml)"),
        (SetPayload(-0.1), "a payload of -0.1 kg is not allowed"),
        (SetPayload(nan), "a payload of nan kg is not allowed"),
        (SetPayload(0.5, 0.0, 1.5), "the payload's centre is 1.5 m from the tool point: at most 1 m is allowed"),
        (SetPayload(0.5, nan), "the payload's centre is nan m from the tool point"),
        (SetPayload(0.5, 0.0, inf), "the payload's centre is inf m from the tool point"),
        (SetTool(PROBE), "the arm would be beyond the bounds of the box that the tool stays in (cartesian.box in"),
    ],
)
def test_a_tool_or_payload_that_cannot_be_is_refused(
    arm: Callable[[tuple[float, ...]], Tooled], command: Command, text: str
) -> None:
    upright = arm((0.0,) * 6)
    assert text in upright.refusal(command)
    assert (upright.loop.arm.tool.number, upright.loop.arm.tool.payload) == (FLANGE, None)
