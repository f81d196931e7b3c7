"""Two arms in step on in-process buses; `benchmarks/cell.py` runs thousands of the same."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from kinematics.capsules import distance
from rtcp.config.model import MOST_AXES
from rtcp.control.operator import UNREAD_S
from rtcp.ipc.commands import Disable, Enable, MoveGripper, MoveJoints, OpenStream, Reset, RunInStep, SetLimits
from rtcp.ipc.events import PushedNearPartner
from rtcp.ipc.schema import RecordSchema
from rtcp.ipc.states import State
from rtcp.motion.guards.compliance import PUSHED_CLEARANCE
from rtcp.motion.guards.neighbours import certain
from rtcp.motion.limits import rows
from rtcp.testing.simulation import Simulation
from tests.cell.random_steps import Pair, cell_of, run_mishaps, run_motions, run_near

SLOWEST_NS = 2_000_000


def test_random_motions_begin_and_end_together() -> None:
    outcome = run_motions(seed=1, count=2)
    assert outcome.problems == []
    assert outcome.motions == 2
    assert outcome.off_goal < 1e-9
    # Each begins in its own first cycle after the instant, and ends in its own.
    assert outcome.begin_apart_ns <= SLOWEST_NS
    assert outcome.end_apart_ns <= 2 * SLOWEST_NS
    assert outcome.apart_s <= SLOWEST_NS * 1e-9


@pytest.mark.parametrize("kind", ["halt", "halt at both", "disable", "lease ends"])
def test_both_brake_on_one_time_scale(kind: str) -> None:
    outcome = run_mishaps(2, 1, [kind])
    assert outcome.problems == []
    assert outcome.off_path < 1e-7
    assert outcome.rest_apart_s < 1e-5


@pytest.mark.parametrize("kind", ["drive fault", "emergency stop", "frames lost", "loop hangs"])
def test_the_other_brakes_along_its_path(kind: str) -> None:
    outcome = run_mishaps(3, 1, [kind])
    assert outcome.problems == []
    assert outcome.off_path < 1e-7
    # The other arm reacts within two cycles of the slower arm; to silence after its time limit,
    # to an emergency stop after the debounce time.
    most = {"drive fault": 2, "emergency stop": 6, "frames lost": 6, "loop hangs": 4}[kind]
    assert outcome.reaction_ns[kind] <= most * SLOWEST_NS


@pytest.mark.parametrize("seed", [1, 3])
def test_arms_that_know_nothing_of_each_others_targets_keep_apart(seed: int) -> None:
    nearness = run_near(seed, count=6)
    assert nearness.problems == []
    assert nearness.stops > 0
    assert nearness.arrivals > 0


def test_no_arm_begins_alone() -> None:
    pair = Pair(4)
    motion = pair.begin(only=("left",))
    pair.follow(motion, lambda: pair.arm("left").state is State.HOLDING, 1.0)
    assert pair.last_end("left") == "PartnerNotReady"
    assert motion.begun_ns == {}
    pair.close()


def test_an_arm_that_is_halted_before_the_instant_keeps_the_other_back() -> None:
    pair = Pair(5)
    motion = pair.begin()
    pair.mishaps["halt"]("right")
    pair.follow(motion, lambda: pair.simulation.now_ns > motion.start_ns + 10 * SLOWEST_NS, 1.0)
    assert motion.begun_ns == {}
    assert pair.last_end("left") == "PartnerNotReady"
    pair.close()


def test_a_partner_that_does_not_run_is_a_refusal() -> None:
    pair = Pair(6)
    pair.simulation.silent.add("right")
    pair.simulation.run(0.02)
    command = RunInStep(0, 1, 1, 1, pair.simulation.now_ns + 50_000_000, 1, 0.1)
    refusal = pair.simulation.send("left", command).refusal
    assert refusal is not None
    assert refusal.name == "partner_missing"
    assert pair.simulation.all_in(State.HOLDING)
    pair.close()


def test_a_partner_of_another_cell_is_a_refusal() -> None:
    pair = Pair(6)
    pair.simulation.partners["right"].group.cell += 1
    pair.simulation.run(0.02)
    refusal = pair.simulation.send("left", RunInStep(0, 1, 1, 1, pair.simulation.now_ns + 50_000_000, 1, 0.1)).refusal
    assert refusal is not None
    assert refusal.name == "partner_of_another_cell"
    assert pair.simulation.all_in(State.HOLDING)
    pair.close()


def test_the_guard_knows_the_acceleration_limits_in_force_at_a_partner() -> None:
    pair = Pair(6)
    limits = pair.arm("right").loop.arm.limits
    limits.acceleration[2] *= 0.5
    pair.simulation.run(0.02)
    assert pair.simulation.partners["left"].group.members[0].acceleration == limits.acceleration
    pair.close()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"start_ns": 0}, "start_out_of_reach"),
        ({"start_ns": 1 << 62}, "start_out_of_reach"),
        ({"partners": 2}, "unknown_partner"),
        ({"partners": -1}, "unknown_partner"),
        ({"motion": 0}, "unknown_partner"),
        ({"motion": (1 << 63) - 1}, "motion_number_ahead"),
        ({"brakes": 0}, "wrong_row_count"),
        ({"brakes": 1 << 60}, "wrong_row_count"),
        ({"rows": 0}, "wrong_row_count"),
        ({"rows": 1 << 60}, "wrong_row_count"),
        ({"slot": 9}, "wrong_row_count"),
        ({"brake_step_s": float("nan")}, "brake_step_out_of_range"),
        ({"brake_step_s": -1.0}, "brake_step_out_of_range"),
        ({"brake_step_s": 5e-324}, "brake_step_out_of_range"),
        ({"brake_step_s": 1e308}, "brake_step_out_of_range"),
    ],
)
def test_a_command_that_cannot_be_is_refused(change: dict[str, float], reason: str) -> None:
    pair = Pair(7)
    at = pair.simulation.now_ns + 50_000_000
    given = {"slot": 0, "rows": 2, "motion": 1, "partners": 1, "start_ns": at, "brakes": 1, "brake_step_s": 0.1}
    refusal = pair.simulation.send("left", RunInStep(**{**given, **change})).refusal  # type: ignore[arg-type]
    assert refusal is not None
    assert refusal.name == reason
    assert pair.simulation.all_in(State.HOLDING)
    pair.close()


def test_with_both_buttons_pressed_each_arm_can_be_reset() -> None:
    pair = Pair(10)
    for name in ("left", "right"):
        pair.mishaps["emergency stop"](name)
    assert pair.simulation.until(lambda: pair.simulation.all_in(State.EMERGENCY_STOP), 1.0)
    pair.simulation.run(1.0)
    assert pair.recover()
    pair.close()


def test_no_arm_is_enabled_while_its_partner_is_in_the_emergency_stop() -> None:
    pair = Pair(11)
    pair.mishaps["emergency stop"]("left")
    assert pair.simulation.until(lambda: pair.simulation.all_in(State.EMERGENCY_STOP), 1.0)
    pair.simulation.run(1.5)
    assert pair.simulation.send("right", Reset()).refusal is None
    assert pair.simulation.until(lambda: pair.arm("right").state is State.READY, 5.0)
    for command in (Enable(), MoveGripper(open=True)):
        refusal = pair.simulation.send("right", command).refusal
        assert refusal is not None
        assert refusal.name == "partner_stop_pressed"
    pair.close()


def test_a_partner_that_does_not_begin_in_time_stops_this_arm() -> None:
    pair = Pair(12)
    motion = pair.begin()
    pair.follow(motion, lambda: pair.simulation.now_ns > motion.start_ns - 3_000_000)
    pair.arm("right").data.lose(15)
    assert pair.follow(motion, lambda: pair.arm("left").state is State.HOLDING, 5.0)
    assert pair.path_s("left") < 0.1
    assert pair.last_end("left") == "PartnerLeft"
    pair.close()


def test_no_other_motion_takes_the_place_of_one_in_step() -> None:
    pair = Pair(13)
    motion = pair.begin()
    pair.follow(motion, lambda: pair.speed("left") > 0.01)
    refusal = pair.simulation.send("left", MoveJoints(tuple(motion.goal["left"]), 0.5, True)).refusal
    assert refusal is not None
    assert refusal.name == "wrong_state"
    assert pair.follow(motion, lambda: pair.rests_after(motion))
    assert pair.last_end("left") == ""
    pair.close()


def test_the_emergency_stop_is_shared() -> None:
    pair = Pair(8)
    pair.mishaps["emergency stop"]("left")
    assert pair.simulation.until(lambda: pair.simulation.all_in(State.EMERGENCY_STOP), 1.0)
    assert pair.events("right")[-1] in ("PartnerEmergencyStop", "SlavesParked")
    assert pair.recover()
    pair.close()


def test_with_a_partner_of_another_cell_no_arm_is_enabled_or_moved_and_one_that_moves_stops() -> None:
    pair = Pair(6)
    goal = [q + 0.3 for q in pair.commanded("left")]
    assert pair.simulation.send("left", MoveJoints(tuple(goal), 0.3, True)).refusal is None
    assert pair.simulation.until(lambda: pair.speed("left") > 0.1, 1.0)
    pair.simulation.partners["right"].group.cell += 1
    assert pair.simulation.until(lambda: pair.arm("left").state is State.HOLDING, 2.0)
    assert pair.last_end("left") == "PartnerForeign"
    refusal = pair.simulation.send("left", MoveJoints(tuple(goal), 0.3, True)).refusal
    assert refusal is not None
    assert refusal.name == "partner_of_another_cell"
    assert pair.simulation.send("left", Disable()).refusal is None
    assert pair.simulation.until(lambda: pair.arm("left").state is State.READY, 2.0)
    refusal = pair.simulation.send("left", Enable()).refusal
    assert refusal is not None
    assert refusal.name == "partner_of_another_cell"
    pair.close()


def test_a_partner_that_runs_in_no_cell_is_seen() -> None:
    pair = Pair(6)
    with Simulation(pair.cell.arms[1].config) as alone:
        left = pair.simulation.partners["left"]
        alone.now_ns = pair.simulation.now_ns
        left.files[0] = alone.path
        left.open()
        left.read(alone.now_ns)
        assert left.group.foreign == -1  # it has published nothing yet
        alone.cycle()
        left.read(alone.now_ns)
        assert left.group.foreign == 0
    pair.close()


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("state", 200), ("step_phase", 99), ("commanded_velocity", math.nan), ("commanded_position", math.inf),
        ("step_path_s", math.nan), ("acceleration_limit", 0.0), ("time_ns", 1 << 62),
    ],
)  # fmt: skip
def test_a_record_that_no_loop_writes_makes_its_sender_silent_and_ends_no_other_loop(field: str, value: float) -> None:
    pair = Pair(6)
    board = pair.arm("right").board
    publish = board.publish
    at = _index_of(board.schema, field)

    def spoiled(values: Sequence[float]) -> None:
        publish([value if index == at else other for index, other in enumerate(values)])

    board.publish = spoiled  # type: ignore[method-assign]
    pair.simulation.run(0.02)
    partner = pair.simulation.partners["left"].group.members[0]
    assert pair.simulation.now_ns - partner.time_ns > 10_000_000
    goal = [q + 0.05 for q in pair.commanded("left")]
    assert pair.simulation.send("left", MoveJoints(tuple(goal), 0.3, True)).refusal is None
    assert pair.simulation.until(lambda: pair.arm("left").state is State.HOLDING, 5.0)
    pair.close()


def _index_of(schema: RecordSchema, name: str) -> int:
    """Return the index of a field's first number among the published values, without the record's number."""
    at = -1
    for field in schema.fields:
        if field.name == name:
            return at
        at += field.count
    raise KeyError(name)


def test_in_a_stream_no_arm_moves_before_each_has_its_first_setpoint() -> None:
    pair = Pair(14)
    motion = 7
    for name, number in (("left", 1), ("right", 2)):
        assert pair.simulation.send(name, OpenStream(number, motion, 1)).refusal is None
    begin = {name: pair.commanded(name) for name in ("left", "right")}

    def send(name: str, number: int) -> None:
        q = [angle + 0.01 for angle in begin[name]]
        numbers = (*q, *[0.0] * (3 * MOST_AXES - len(q)))
        pair.arm(name).observer.setpoint(number, 0, pair.simulation.now_ns * 1e-9, numbers)

    for _ in range(30):
        send("left", 1)
        pair.simulation.run(0.01)
    assert pair.commanded("left") == begin["left"]
    for _ in range(30):
        send("left", 1)
        send("right", 2)
        pair.simulation.run(0.01)
    assert pair.commanded("left")[0] == pytest.approx(begin["left"][0] + 0.01, abs=1e-3)
    assert pair.commanded("right")[0] == pytest.approx(begin["right"][0] + 0.01, abs=1e-3)
    pair.close()


def test_a_stream_whose_partner_gets_no_setpoint_ends_where_it_began() -> None:
    pair = Pair(15)
    for name, number in (("left", 1), ("right", 2)):
        pair.simulation.send(name, OpenStream(number, 7, 1))
    begin = pair.commanded("left")
    for _ in range(150):
        numbers = (*[angle + 0.01 for angle in begin], *[0.0] * (3 * MOST_AXES - len(begin)))
        pair.arm("left").observer.setpoint(1, 0, pair.simulation.now_ns * 1e-9, numbers)
        pair.simulation.run(0.01)
    assert pair.last_end("left") == "PartnerNotReady"
    assert pair.commanded("left") == begin
    assert pair.simulation.until(lambda: pair.simulation.all_in(State.HOLDING), 1.0)
    pair.close()


@pytest.mark.parametrize(
    ("mishap", "event"), [("loop hangs", "PartnerStopUnread"), ("frames lost", "PartnerEmergencyStop")]
)
def test_a_shared_emergency_stop_that_nobody_reads_counts_as_pressed(mishap: str, event: str) -> None:
    pair = Pair(16)
    right = pair.arm("right")
    goal = [q + 0.3 for q in pair.commanded("right")]
    assert pair.simulation.send("right", MoveJoints(tuple(goal), 0.1, True)).refusal is None
    pair.mishaps[mishap]("left")
    if mishap == "frames lost":
        pair.arm("left").data.lose(3000)
    assert pair.simulation.until(lambda: right.state is State.EMERGENCY_STOP, UNREAD_S + 0.02)
    assert event in pair.events("right")
    pair.simulation.run(1.0)
    assert pair.simulation.send("right", Reset()).refusal is None
    assert pair.simulation.until(lambda: right.state is State.READY, 5.0)
    for command in (Enable(), MoveGripper(open=True)):
        refusal = pair.simulation.send("right", command).refusal
        assert refusal is not None
        assert refusal.name == ("partner_stop_unread" if mishap == "loop hangs" else "partner_stop_pressed")
    pair.close()


def slower_limits(arm: Simulation, share: float) -> SetLimits:
    """Write the limits in force with a share of the accelerations to the plan area; return the command for them."""
    widest = arm.loop.arm.limits.widest
    plan = rows(replace(widest, acceleration=tuple(share * rate for rate in widest.acceleration)))
    return SetLimits(arm.observer.write_plan(plan), len(plan))


def test_limits_under_which_the_stop_would_end_too_near_the_partner_are_refused_under_way() -> None:
    pair = Pair(17)
    left, guard = pair.arm("left"), pair.arm("left").loop.arm.trajectory_guard
    goal = [q + 0.3 for q in pair.commanded("left")]
    assert pair.simulation.send("left", MoveJoints(tuple(goal), 0.4, True)).refusal is None
    assert pair.simulation.until(lambda: pair.speed("left") > 0.2, 2.0)
    own, (other,) = guard.neighbours._own, guard.neighbours._partners
    assert other is not None
    state, partner = left.loop.arm.state, pair.simulation.partners["left"].group.members[0]
    args = state.commanded, state.commanded_velocity, other, partner.position, partner.velocity
    # With this clearance the arm can stop in time under the limits in force, and not much later.
    guard.neighbours._clearance = certain(own, *args, (0.005, 0.1))[0]
    before = list(left.loop.arm.limits.acceleration)
    refusal = pair.simulation.send("left", slower_limits(left, 0.2)).refusal
    assert refusal is not None
    assert refusal.name == "limits_too_near_partner"
    assert left.loop.arm.limits.acceleration == before
    assert pair.simulation.until(lambda: left.state in (State.HOLDING, State.STOPPED_BY_LIMIT), 5.0)
    assert pair.simulation.send("left", slower_limits(left, 0.2)).refusal is None
    pair.close()


def test_an_arm_in_cst_that_is_pushed_towards_its_partner_is_stopped_by_its_drives() -> None:
    cell = cell_of(apart_m=0.55)
    pair = Pair(
        17, replace(cell, arms=tuple(replace(m, config=replace(m.config, drive_mode="cst")) for m in cell.arms))
    )
    pair.simulation.run(0.5)
    left, guard = pair.arm("left"), pair.arm("left").loop.arm.trajectory_guard
    own, (other,) = guard.neighbours._own, guard.neighbours._partners
    assert other is not None

    def apart(turn: float) -> float:
        own.place([turn + left.loop.arm.state.actual[0], *left.loop.arm.state.actual[1:]])
        other.place(pair.commanded("right"))
        return distance(own.placed, other.placed)[0]

    far, towards = apart(0.0), 1.0 if apart(0.1) < apart(-0.1) else -1.0
    least = guard.neighbours._clearance = far - 0.02
    guard.neighbours._clearance /= PUSHED_CLEARANCE
    left.models[0].mechanics.external_torque = 60.0 * towards
    assert pair.simulation.until(lambda: left.state is State.FAULT, 1.0)
    (pushed,) = [record.event for record in left.events if isinstance(record.event, PushedNearPartner)]
    left.models[0].mechanics.external_torque = 0.0
    pair.simulation.run(0.5)
    assert pushed.partner == 0
    assert least < apart(0.0) < far
    pair.close()


def test_limits_do_not_change_in_a_motion_in_step() -> None:
    pair = Pair(18)
    motion = pair.begin()
    pair.follow(motion, lambda: pair.speed("left") > 0.01)
    refusal = pair.simulation.send("left", slower_limits(pair.arm("left"), 0.9)).refusal
    assert refusal is not None
    assert refusal.name == "limits_in_step"
    pair.close()
