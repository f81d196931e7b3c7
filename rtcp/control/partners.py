"""The partners of an arm in a cell: their newest records, read once a cycle, and this arm's fields for them.

The loops of a cell exchange data through shared memory only. The thread beside the cycle opens the files.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from rtcp.config.cell import CellConfig, Member
from rtcp.control.operator import UNREAD_S
from rtcp.control.part import Part
from rtcp.ipc.record_view import RecordView, RecordViewError, replace_view
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.schema import FLAG_EMERGENCY_STOP, FLAG_MOTION_ALLOWED, Field
from rtcp.ipc.states import State
from rtcp.motion.guards.neighbours import Neighbours, body_of
from rtcp.motion.limits import Limits
from rtcp.motion.state import ArmState
from rtcp.motion.step_group import Partner, StepGroup, StepPhase

_NOTICE_CYCLES: Final = 1.5
"""Lead time with which an arm announces its brake, cycles of the slowest arm."""
_AHEAD_NS: Final = 1_000_000_000
"""Greatest time of a record in the future, ns; later ones are ignored."""
_FORGOTTEN_NS: Final = 1_000_000_000
"""Age of a partner's newest record from which its cell and the state of its emergency stop are no longer used, ns."""
_SILENT_NS: Final = round(UNREAD_S * 1e9)
"""Age of a partner's newest record from which its emergency stop counts as pressed and its enabling switch as released,
ns."""
_SCALARS = ("time_ns", "state", "flags", "step_motion", "step_phase", "step_brake_ns", "step_path_s", "step_cell")
_VECTORS = ("commanded_position", "commanded_velocity", "acceleration_limit")
_STATES = tuple(State)
_STOPPED = (State.EMERGENCY_STOP, State.RESETTING)
_PHASES = tuple(StepPhase)


def step_fields(joints: int) -> tuple[Field, ...]:
    """Return the fields of the record for the partners of an arm with this number of joints."""
    return (
        Field("step_motion", "uint64", "", "Number of the motion in step; 0: none yet.", part="cell"),
        Field("step_phase", "uint8", "", "Where the arm is in it (rtcp.motion.step_group.StepPhase).", part="cell"),
        Field("step_brake_ns", "int64", "ns", "When the group begins to brake; 0: it does not.", part="cell"),
        Field("step_path_s", "float64", "s", "Progress of the arm, nominal time of the path.", part="cell"),
        Field("step_cell", "uint64", "", "Digest of the cell's files at the start of this arm.", part="cell"),
        Field("commanded_velocity", "float64", "rad/s", "Speed of the setpoint.", (joints,), part="cell"),
        Field("acceleration_limit", "float64", "rad/s^2", "Acceleration limit in force.", (joints,), part="cell"),
    )


class Partners(Part):
    """Reads the partners' records, and publishes this arm's fields for them.

    Args:
        cell: the cell.
        name: name of this arm in the cell.
    """

    def __init__(self, cell: CellConfig, name: str) -> None:
        super().__init__("cell", step_fields(len(cell.member(name).config.joints)))
        self._own = cell.member(name)
        self._clearance, self._delay_s = cell.clearance, cell.longest_silence_s + cell.slowest_s
        self.members: list[Member] = [member for member in cell.members if member.name != name]
        self.group = StepGroup(cell.longest_silence_s, _NOTICE_CYCLES * cell.slowest_s, cell.digest)
        self.group.members = [Partner(len(member.config.joints)) for member in self.members]
        for partner, member in zip(self.group.members, self.members, strict=True):
            partner.acceleration[:] = (joint.acceleration for joint in member.config.joints)
        self._shares_stop = cell.share.emergency_stop
        self.pressed = self.stopped = -1
        """First partner whose shared emergency stop is pressed, and first one not reset since; index or -1."""
        self.unread = -1
        """First partner whose shared emergency stop no loop reads, so that it counts as pressed; index or -1."""
        self._has_button = [member.config.inputs.emergency_stop is not None for member in self.members]
        self.files = [blackboard_file(member.directory) for member in self.members]
        """Blackboard files of the partners."""
        self._inodes = [0] * len(self.members)
        self._views: list[RecordView | None] = [None] * len(self.members)
        self._values: list[list[Any]] = [
            [0] * (len(_SCALARS) + len(_VECTORS) * len(member.config.joints)) for member in self.members
        ]  # fmt: skip
        self._arm: ArmState | None = None
        self._acceleration: Sequence[float] = ()

    def watch(self, arm: ArmState, limits: Limits, period_s: float) -> Neighbours | None:
        """Publish the setpoints of this arm from now on; return the guard data of its partners, None: no geometry."""
        self._arm, self._acceleration = arm, limits.acceleration
        own = body_of(self._own, limits.acceleration)
        if own is None:
            return None
        partners = zip(self.members, self.group.members, strict=True)
        bodies = [body_of(member, partner.acceleration) for member, partner in partners]
        return Neighbours(own, bodies, self.group, self._clearance, period_s, self._delay_s)

    def open(self) -> None:
        """Open the blackboards of partners that have started since the last call; too slow for the cycle."""
        for index, path in enumerate(self.files):
            with contextlib.suppress(OSError):
                inode = path.stat().st_ino
                if inode != self._inodes[index]:
                    replace_view(self._views, index, _view(path, len(self.group.members[index].position)))
                    self._inodes[index] = inode

    def close(self) -> None:
        """Close the blackboards."""
        self._views = [None] * len(self._views)

    def read(self, now_ns: int) -> None:
        """Read the newest complete record of each partner."""
        self.pressed = self.stopped = self.unread = self.group.foreign = -1
        for index, partner in enumerate(self.group.members):
            view, values = self._views[index], self._values[index]
            if view is not None and view.read(values):
                _take(partner, values, now_ns)
            age_ns = now_ns - partner.time_ns
            known, silent = age_ns < _FORGOTTEN_NS, age_ns > _SILENT_NS
            if known and partner.cell != self.group.cell and self.group.foreign < 0:
                self.group.foreign = index
            if silent or partner.cell != self.group.cell:
                partner.motion_allowed = False
            if not self._shares_stop:
                continue
            if silent and self._has_button[index] and self.unread < 0:
                self.unread = index
            if not known:
                continue
            if partner.emergency_stop and self.pressed < 0:
                self.pressed = index
            # A partner does not read its button during its reset: its state still shows the stop.
            if (partner.emergency_stop or partner.state in _STOPPED) and self.stopped < 0:
                self.stopped = index

    def publish(self, values: list[Any]) -> None:
        """Write the progress of this arm in the motion in step."""
        group, arm, at = self.group, self._arm, self.at
        values[at : at + 5] = group.motion, group.phase, group.brake_ns, group.path_s, group.cell
        if arm is not None:
            n = len(arm.commanded_velocity)
            values[at + 5 : at + 5 + n] = arm.commanded_velocity
            values[at + 5 + n : at + 5 + 2 * n] = self._acceleration


def _view(path: Path, joints: int) -> RecordView | None:
    """Return a view of a partner's records: all fields, or only the instants of a platform outside any cell."""
    for names in ((*_SCALARS, *_VECTORS), ("time_ns",)):
        with contextlib.suppress(RecordViewError):
            view = RecordView(path, names)
            if view.count in (len(_SCALARS) + len(_VECTORS) * joints, 1):
                return view
    return None


def _take(partner: Partner, values: Sequence[Any], now_ns: int) -> None:
    """Copy a record to `partner`. An invalid record is ignored: after some, the partner counts as silent."""
    time_ns = values[0]
    if time_ns > now_ns + _AHEAD_NS:
        return
    if len(values) == 1:
        # It runs, but outside a cell.
        partner.time_ns, partner.cell = time_ns, 0
        partner.state, partner.motion_allowed = State.OFF, False
        return
    _, state, flags, motion, phase, brake_ns, path_s, cell = values[: len(_SCALARS)]
    n, at = len(partner.position), len(_SCALARS)
    speeds = at + n
    accelerations = speeds + n
    whole = sum(values[at:], path_s)
    # NaN, infinity and an acceleration limit of 0 are invalid.
    if (
        state >= len(_STATES)
        or phase >= len(_PHASES)
        or whole - whole != 0.0
        or (n and min(values[accelerations:]) <= 0.0)
    ):
        return
    partner.time_ns, partner.motion, partner.brake_ns, partner.path_s = time_ns, motion, brake_ns, path_s
    partner.state, partner.phase, partner.cell = _STATES[state], _PHASES[phase], cell
    partner.emergency_stop = flags & FLAG_EMERGENCY_STOP != 0
    partner.motion_allowed = flags & FLAG_MOTION_ALLOWED != 0
    partner.position[:] = values[at:speeds]
    partner.velocity[:] = values[speeds:accelerations]
    partner.acceleration[:] = values[accelerations:]
