"""What a recording of the black box says, in numbers: the same for `--json`, the tables and the picture."""

from __future__ import annotations

from datetime import datetime
from typing import Any, NamedTuple

import numpy as np

from rtcp.gateway.blackbox_file import Listed, Recording
from rtcp.ipc.machine import TABLE
from rtcp.telemetry.steps import target_steps

_WORDS = {int(state): row.words for state, row in TABLE.items()}


class Mark(NamedTuple):
    """Something that happened: when, s from the fault on, and what."""

    at_s: float
    sentence: str


def as_row(one: Listed) -> dict[str, Any]:
    """Return a line of the list; of a file that cannot be read its number and why."""
    if one.about is None:
        return {"number": one.number, "file": str(one.path), "trouble": one.trouble}
    return {
        "number": one.number,
        "time": iso(one.about.when),
        "what": one.about.what,
        "before": one.about.before,
        "seconds": round(one.seconds, 4),
        "notes": list(one.about.notes),
        "file": str(one.path),
    }


def summary(recording: Recording) -> dict[str, Any]:
    """Return a recording in SI units, without its cycles."""
    about, records = recording.about, recording.records
    told = {
        "number": about.number,
        "time": iso(about.when),
        "what": about.what,
        "before": about.before,
        "arm": about.arm,
        "bus": about.bus,
        "cycle_ns": about.period_ns,
        "versions": about.versions,
        "notes": list(about.notes),
        "timeline": [{"t_s": round(mark.at_s, 4), "sentence": mark.sentence} for mark in marks(recording)],
        "joint_names": list(about.joints),
    }
    if about.at < 0:
        return told
    at, times = about.at, seconds(recording)
    wrong = records["wkc"] != records["wkc_expected"]
    return told | {
        "begins_s": round(float(times[0]), 4),
        "ends_s": round(float(times[-1]), 4),
        "cycles": len(times),
        "joints": {
            name: [round(float(value), 7) for value in records[name][at]]
            for name in ("position", "target", "velocity", "torque")
        },
        "largest_step": _largest_step(recording),
        "missed": int(records["missed"][-1]) - int(records["missed"][0]),
        "wkc": {
            "expected": int(records["wkc_expected"][at]),
            "actual": int(records["wkc"][at]),
            "wrong_cycles": int(np.count_nonzero(wrong)),
            "without_answer": int(np.count_nonzero(records["wkc"] < 0)),
        },
    }


def seconds(recording: Recording) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the instant of each cycle, s from the fault on."""
    instants = recording.records["time_ns"]
    found: np.ndarray[Any, np.dtype[np.float64]] = (instants - instants[recording.about.at]) * 1e-9
    return found


def marks(recording: Recording) -> list[Mark]:
    """Return what was said, and each change of the machine's state, in the order of time."""
    about = recording.about
    found = [Mark((moment.time_ns - about.time_ns) * 1e-9, moment.sentence) for moment in about.timeline]
    if about.at >= 0:
        states, times = recording.records["state"], seconds(recording)
        found += [
            Mark(float(times[i + 1]), f"state: {_words(states[i])} -> {_words(states[i + 1])}")
            for i in np.flatnonzero(np.diff(states.astype(np.int64)))
        ]
    return sorted(found, key=lambda mark: mark.at_s)


def iso(when: datetime) -> str:
    """Return an instant as JSON has it."""
    return when.isoformat(timespec="milliseconds")


def _words(state: Any) -> str:
    return _WORDS.get(int(state), f"state {int(state)}")


def _largest_step(recording: Recording) -> dict[str, Any] | None:
    """Return the largest step of a target from one enabled cycle to the next; None where there is none."""
    about = recording.about
    cycles, steps = target_steps(recording.records)
    if not steps.size:
        return None
    row, joint = np.unravel_index(int(np.argmax(steps)), steps.shape)
    step = float(steps[row, joint])
    return {
        "joint": about.joints[int(joint)],
        "rad": step,
        "rad_per_s": step / (about.period_ns * 1e-9),
        "t_s": round(float(seconds(recording)[cycles[row]]), 4),
    }
