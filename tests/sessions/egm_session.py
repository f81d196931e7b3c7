"""A random session on the virtual IRC5: commands, the operator's switches and faults; checked by the datagrams."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from rtcp.api import RtcpError
from rtcp.ipc.runtime_directory import control_socket
from rtcp.virtual.request_socket import RequestRefused
from tests.faults import egm_wire
from tests.faults.egm import CONFIG, LIMITS, START, Trials
from tests.sessions.wire_client import DEFECTS, Connection

_MOTIONS = 6
"""Most motions at a time that are not waited for."""
_MODES = {
    "jog": ("cartesian",),
    "move_at_velocity": ("velocity",),
    "stream": ("joint",),
    "motion": ("joint", "cartesian"),
}
"""Control modes in which commands are accepted; most commands are sent in one of them."""
_REQUESTS: tuple[dict[str, Any], ...] = (
    *({"do": do} for do in ("motors_on", "motors_off", "start_rapid", "stop_rapid")),
    *({"do": "mode", "mode": mode} for mode in ("hand", "auto")),
    *({"do": "enabling", "position": position} for position in ("released", "middle", "through")),
    *({"do": "stop", "circuit": circuit} for circuit in ("emergency", "automatic", "general", "superior")),
    *({"do": "fault", "fault": kind} for kind in ("seqno_restart", "convergence", "mci_error", "collision")),
    *({"do": "fault", "fault": "silent", "direction": side} for side in ("to_pc", "from_pc")),
    *(
        {"do": "fault", "fault": kind, "value": value, "direction": side}
        for kind, value in (("lost", 0.2), ("lost", 0.8), ("doubled", 0.5), ("old", 0.2), ("late", 8))
        for side in ("to_pc", "from_pc")
    ),
)


@dataclass
class EgmOutcome:
    """Results of a session."""

    taken: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    requests: Counter[str] = field(default_factory=Counter)
    states: Counter[str] = field(default_factory=Counter)
    replies: int = 0
    largest_speed: float = 0.0
    """Largest speed reference, as a fraction of its limit."""
    failures: list[str] = field(default_factory=list)


class EgmSession:
    """Commands and faults at random on a running platform.

    Args:
        trials: the platform and its operator.
        random: of this session.
    """

    def __init__(self, trials: Trials, random: Random) -> None:
        self.trials, self.random = trials, random
        self.outcome = EgmOutcome()
        self._motions: list[tuple[str, Connection]] = []

    def run(self, seconds: float) -> EgmOutcome:
        """Run random actions for `seconds`; then recover, enable and move."""
        trials, outcome = self.trials, self.outcome
        tap = trials.platform.directory / "session.tap"
        with trials.capture(tap):
            end = time.monotonic() + seconds
            while time.monotonic() < end and not outcome.failures:
                self._step()
                self._check_joints()
                outcome.states[trials.harness.state().name] += 1
            for _, connection in self._motions:
                connection.close()
            trials.put_in_order()
            _, refusal = trials.harness.enable()
            if refusal := refusal or trials.harness.move(START):
                outcome.failures.append(f"at the end the arm did not move: {refusal}")
        wire = egm_wire.check(tap, LIMITS, CONFIG.cycle.period_us * 1e-6)
        outcome.replies, outcome.largest_speed = wire.replies, wire.largest_speed
        outcome.failures += wire.violations[:10]
        if trials.harness.largest_step > 1.0 + 1e-6:
            outcome.failures.append(f"a target stepped {trials.harness.largest_step:.3f} of what its limit allows")
        return outcome

    def _step(self) -> None:
        pick = self.random.random()
        if pick < 0.15:
            self._ask(self.random.choice(_REQUESTS))
        elif pick < 0.3:
            self.trials.put_in_order()
            self.trials.harness.enable()
        else:
            self._command()
        self.trials.harness.wait(self.random.uniform(0.0, 0.3))

    def _ask(self, request: dict[str, Any]) -> None:
        name = str(request.get("fault", request["do"]))
        with contextlib.suppress(RequestRefused):
            self.trials.ask(**request)
            self.outcome.requests[name] += 1

    def _command(self) -> None:
        random, robot = self.random, self.trials.harness.robot
        size = random.choice((0.01, 0.3, 2.0, 100.0))
        values = [random.uniform(-size, size) for _ in range(6)]
        name = random.choice(
            ("enable", "disable", "reset", "halt", "mode", "jog", "move_at_velocity", "stream", "motion", "motion")
        )
        try:
            if name in _MODES and random.random() < 0.8:
                robot.mode(random.choice(_MODES[name]))
            if name in ("enable", "disable", "reset", "halt"):
                getattr(robot, name)()
            elif name == "mode":
                robot.mode(random.choice(("joint", "cartesian", "velocity", "joystick", "torque", "csp", "csv", "cst")))
            elif name == "jog":
                robot.jog(values, random.choice(("base", "tool", "joints")), random.uniform(0.05, 0.5))
            elif name == "move_at_velocity":
                robot.move_at_velocity(values, random.uniform(0.05, 0.5))
            elif name == "stream":
                self._stream()
            else:
                name = self._motion(values)
        except RtcpError as error:
            self._refused(name, error.kind, error.message)
        else:
            self.outcome.taken[name] += 1

    def _stream(self) -> None:
        """Send positions that wander from where the arm is, with gaps."""
        robot, random = self.trials.harness.robot, self.random
        q = self.trials.joints()
        speeds = [random.uniform(-1.5, 1.5) for _ in q]
        for i in range(random.randint(1, 40)):
            robot.stream([at + 0.01 * i * speed for at, speed in zip(q, speeds, strict=True)], 0.01 * i)
            self.trials.harness.wait(random.choice((0.0, 0.01, 0.01, 0.1)))

    def _motion(self, values: list[float]) -> str:
        """Begin a motion and do not wait for it."""
        random = self.random
        while len(self._motions) >= _MOTIONS:
            name, oldest = self._motions.pop(0)
            reply = oldest.answer(0.0)
            if reply is not None and "error" in reply:
                error = reply["error"]
                self._refused(name, error["data"]["kind"], error["message"])
            oldest.close()
        speed = random.choice((None, 0.2, 1.5))
        near = [q + value for q, value in zip(START, values, strict=True)]
        name, arguments = random.choice(
            (
                (
                    "move_joints",
                    {"q": near, "speed": speed, "replace": random.random() < 0.5},
                ),
                ("run_trajectory", {"points": [{"t": 1.0 + i, "q": near} for i in range(3)], "approach": True}),
                ("move_line", {"poses": [[0.35, 0.01 * values[0], 0.5, 0.0, 3.14, 0.0]], "speed": 0.1}),
            )
        )
        connection = Connection(control_socket(self.trials.platform.directory))
        connection.begin(name, arguments)
        self._motions.append((name, connection))
        return name

    def _refused(self, name: str, kind: str, message: str) -> None:
        self.outcome.refused[name] += 1
        # A host may delay a jog by more than its duration: a refusal as too late is right.
        if kind in DEFECTS and not (name == "jog" and kind == "timeout"):
            self.outcome.failures.append(f"{name} failed by {kind}: {message}")

    def _check_joints(self) -> None:
        for joint, q in zip(CONFIG.joints, self.trials.joints(), strict=True):
            if not joint.position.min <= q <= joint.position.max:
                self.outcome.failures.append(f"{joint.name} stands at {q:.4f} rad, outside its limits")


def run_on_egm(seed: int, seconds: float, keep: Path | None = None) -> EgmOutcome:
    """Run a session on a platform of its own; `keep`: where its datagrams are written too."""
    trials = Trials()
    try:
        outcome = EgmSession(trials, Random(seed)).run(seconds)
        if keep is not None:
            keep.write_bytes((trials.platform.directory / "session.tap").read_bytes())
        return outcome
    finally:
        trials.close()
