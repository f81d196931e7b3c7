"""The picture of the running platform that `rtcp status` shows, made from the blackboard."""

from __future__ import annotations

import time
from collections import deque
from datetime import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.gateway.robot_status import robot_status
from rtcp.ipc.layout import FLAG_ARM_HAS_STICK, FLAG_DC_LOCKED, FLAG_SWITCHING
from rtcp.ipc.machine import TABLE, Code, State
from rtcp.ipc.messages import EMERGENCIES, Sentences
from rtcp.ipc.motion_messages import STICK_MODES, motion_name
from rtcp.ipc.observer import Observer
from rtcp.ipc.session import Processes, Session, is_running
from rtcp.realtime.statistics import SlidingPercentiles

MODE_NAMES = {8: "csp", 9: "csv", 10: "cst"}
AL_NAMES = {1: "INIT", 2: "PRE-OP", 3: "BOOT", 4: "SAFE-OP", 8: "OP"}
_MESSAGES = 50
_TOLD = 10
"""The last so many of them are told."""
_STALE_S = 1.0
_NO_ERROR = "sent emergency 0x0000:"
"""An emergency that takes an earlier one back (CiA 301, error code 0)."""
_UNDER_WAY = (int(State.MOVING), int(State.STOPPING))


def al_name(status: int) -> str:
    """Return the AL state in words (ETG.1000.6, table 9); `no answer` for 0."""
    if status == 0:
        return "no answer"
    return AL_NAMES.get(status & 0x0F, f"0x{status:02X}") + (" + ERROR" if status & 0x10 else "")


def _iso(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns * 1e-9).astimezone().isoformat(timespec="milliseconds")


class Picture:
    """Follows the blackboard: statistics of the cycle, the last sentences, the state.

    Args:
        observer: the blackboard.
        session: what was started.
        started: facts of the start that the loop reported (realtime, start to OP).
    """

    def __init__(self, observer: Observer, session: Session, started: dict[str, Any]) -> None:
        self._observer = observer
        self._session = session
        self._started = started
        self._sentences = Sentences(session.config)
        self._at = max(observer.head - 1, 0)
        self._event = 0
        self._text = 0
        self._wakeup = SlidingPercentiles()
        self._exchange = SlidingPercentiles()
        self._compute = SlidingPercentiles()
        self._offset = SlidingPercentiles()
        self._filtered = SlidingPercentiles()
        self._enables = 0
        self._unread = 0
        self.fault = ""
        """The first sentence of the present fault: why the machine is in it."""
        self.last_fault = ""
        self.faults = 0
        """How many sentences of faults have been read: tells a new one from the last."""
        self.message = ""
        """The last sentence that says what has become of the arm."""
        self._message_ns = 0
        """When it was said, CLOCK_REALTIME."""
        self._moves = 0
        self._moving = False
        self._began_ns = 0
        """When the last motion began, CLOCK_MONOTONIC."""
        self.messages: deque[tuple[int, str]] = deque(maxlen=_MESSAGES)
        self.loop_lives = True

    def follow(self) -> list[str]:
        """Read what is new; return the sentences that have come since the last call."""
        records, lost = self._observer.since(self._at)
        self._unread += lost
        if len(records):
            self._at = int(records[-1]["number"])
            self._count(records)
            self._see_motion(records)
        return self._listen()

    def note(self, sentence: str) -> None:
        """Add a sentence of the gateway's own to the messages."""
        self.messages.append((time.time_ns(), sentence))

    def _count(self, records: npt.NDArray[np.void]) -> None:
        now = time.monotonic()
        if int(records[-1]["enables"]) != self._enables:
            self._enables = int(records[-1]["enables"])
            for figure in (self._wakeup, self._exchange, self._compute, self._offset, self._filtered):
                figure.reset()
            records = records[records["enables"] == self._enables]
        self._wakeup.add(now, records["wakeup_ns"] / 1e3)
        self._exchange.add(now, records["exchange_ns"] / 1e3)
        self._compute.add(now, records["compute_ns"] / 1e3)
        self._offset.add(now, np.abs(records["dc_offset_ns"]) / 1e3)
        self._filtered.add(now, np.abs(records["dc_filtered_ns"]) / 1e3)

    def _see_motion(self, records: npt.NDArray[np.void]) -> None:
        """Look for the last cycle in which a motion began: from rest, or one that took another's place."""
        moving, moves = np.isin(records["state"], _UNDER_WAY), records["moves"].astype(np.int64)
        rested = ~np.concatenate([[self._moving], moving[:-1]])
        other = moves != np.concatenate([[self._moves], moves[:-1]])
        begun = np.flatnonzero(moving & (rested | other))
        if len(begun):
            self._began_ns = int(records["time_ns"][begun[-1]])
        self._moving, self._moves = bool(moving[-1]), int(moves[-1])

    def _headline(self, state: State) -> str:
        """Return why the machine is in fault, else what was said last; of an earlier motion nothing while one lasts."""
        if self.fault or int(state) not in _UNDER_WAY:
            return self.fault or self.message
        began_ns = self._began_ns + time.time_ns() - time.monotonic_ns()
        return self.message if self._message_ns > began_ns else TABLE[state].words

    def _listen(self) -> list[str]:
        said: list[tuple[int, str]] = []
        for event in self._observer.events_since(self._event):
            self._event = event.number
            sentence = self._sentences.event(event.code, event.axis, event.value, event.limit)
            said.append((event.time_ns, sentence))
            if event.code in self._sentences.faults:
                # An emergency stop out of a fault is what has to be ended first.
                self.fault = sentence if event.code in EMERGENCIES else self.fault or sentence
                self.last_fault = sentence
                self.faults += 1
            elif event.code == Code.RESET:
                self.fault = ""
        for text in self._observer.texts_since(self._text):
            self._text = text.number
            said.append((text.time_ns, text.sentence))
        said.sort()
        self.messages.extend(said)
        for at_ns, sentence in said:
            if _NO_ERROR not in sentence:
                self.message, self._message_ns = sentence, at_ns
        return [sentence for _, sentence in said]

    def refusal(self, code: int, axis: int, value: float, limit: float) -> str:
        """Return the sentence for the loop's refusal."""
        return self._sentences.refusal(code, axis, value, limit)

    def state(self) -> State | None:
        """Return the machine's state, or None before the first cycle."""
        latest = self._observer.latest()
        return None if latest is None else State(int(latest[0]["state"]))

    def switching(self) -> bool:
        """Whether the drives are changing their mode."""
        latest = self._observer.latest()
        return latest is not None and bool(int(latest[0]["flags"]) & FLAG_SWITCHING)

    def _robot(self, record: np.void, speaks: bool) -> dict[str, Any]:
        if not speaks:
            # Nobody leads the drives any more: their watchdog has stopped them.
            return robot_status(State.FAULT, int(record["motion"]), 0, int(Code.BUS_LOST), 0)
        numbers = (int(record[name]) for name in ("motion", "flags", "fault", "limit"))
        return robot_status(State(int(record["state"])), *numbers)

    def status(self, processes: Processes) -> dict[str, Any]:
        """Return the whole picture as `rtcp status --json` prints it."""
        latest = self._observer.latest()
        config = self._session.config
        if latest is None:
            raise RuntimeError("the loop has published no cycle yet")
        record = latest[0]
        state = State(int(record["state"])).name.lower()
        message = self._headline(State(int(record["state"])))
        silent_s = (time.monotonic_ns() - int(record["time_ns"])) * 1e-9
        speaks = self.loop_lives and silent_s <= _STALE_S
        if not self.loop_lives:
            state = "fault"
            message = (
                f"the loop (process {self._observer.loop_pid}) ended unexpectedly; the drives' watchdog stops them: "
                "`rtcp stop`, then `rtcp start`"
            )
        elif silent_s > _STALE_S:
            state = "fault"
            message = (
                f"the loop (process {self._observer.loop_pid}) has published nothing for {silent_s:.1f} s; the drives' "
                "watchdog stops them: `rtcp stop`, then `rtcp start`, if it stays so"
            )
        slaves = [
            {
                "position": i + 1,
                "name": slave.name,
                "state": al_name(al) if self.loop_lives else "unknown",
                "al_status_code": code,
                "lost": health.lost,
                "recovered": health.recovered,
                "errors": {"rx": health.rx, "forwarded": health.forwarded, "links": health.links},
            }
            for i, (slave, (al, code), health) in enumerate(
                zip(
                    config.slaves,
                    self._observer.slaves(len(config.slaves)),
                    self._observer.health(len(config.slaves)),
                    strict=True,
                )
            )
        ]
        return {
            "state": state,
            "message": message,
            "mode": MODE_NAMES.get(int(record["mode"]), str(int(record["mode"]))),
            "motion": motion_name(int(record["motion"])),
            "stick": {
                "mode": STICK_MODES[int(record["stick_mode"]) % len(STICK_MODES)],
                "arm_has_it": bool(int(record["flags"]) & FLAG_ARM_HAS_STICK),
            },
            "robot": self._robot(record, speaks),
            "bus": self._session.bus,
            "cycle_ns": self._observer.period_ns,
            "cycles": int(record["cycle"]),
            "time_ns": int(record["time_ns"]),
            "missed": int(record["missed"]),
            "unheard_s": round(int(record["lost"]) * self._observer.period_ns * 1e-9, 3),
            "wkc": {"expected": int(record["wkc_expected"]), "actual": int(record["wkc"]) if speaks else -1},
            "slaves": slaves,
            "joint_names": [joint.name for joint in config.joints],
            "joints": {
                name: [round(float(value), 7) for value in record[name]]
                for name in ("position", "velocity", "torque", "target")
            },
            "statuswords": [int(word) for word in record["statusword"]],
            "inputs": int(record["inputs"]),
            "outputs": int(record["outputs"]),
            "counter": int(record["counter"]),
            "wakeup_us": self._wakeup.read().as_json(),
            "exchange_us": self._exchange.read().as_json(),
            "compute_us": self._compute.read().as_json(),
            "dc": {
                "locked": speaks and bool(int(record["flags"]) & FLAG_DC_LOCKED),
                "offset_ns": int(record["dc_offset_ns"]),
                "filtered_ns": int(record["dc_filtered_ns"]),
                "offset_us": self._offset.read().as_json(),
                "filtered_us": self._filtered.read().as_json(),
            },
            "realtime": self._started.get("realtime", {}),
            "start_to_op_s": self._started.get("start_to_op_s"),
            "lease": {"holder": self._observer.holder()},
            "pids": {
                "loop": processes.loop if self.loop_lives else 0,
                "gateway": processes.gateway,
                "segment": processes.segment if is_running(processes.segment) else 0,
            },
            "messages": [sentence for _, sentence in list(self.messages)[-_TOLD:]],
            "events": [{"time": _iso(at), "sentence": sentence} for at, sentence in list(self.messages)[-_TOLD:]],
        }
