"""The other arms of the cell as a panel sees them: their newest records, read from shared memory."""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
from collections.abc import Sequence
from typing import Any

from kinematics.pose import Pose, applied
from rtcp.api import Feed, RtcpError, State
from rtcp.api.cell import cell_of_this_arm, rod_file
from rtcp.config.cell import CellConfig, Member
from rtcp.config.model import ConfigError

Json = dict[str, Any]
_STEP = ("no", "waits to begin", "moves", "brakes", "no", "no")
"""Phases of a motion in step, by the number in the record: `rtcp.motion.step_group.StepPhase`."""
_SILENT_NS = 1_000_000_000
"""Age from which on an arm counts as silent, ns."""
_ROD_S = 3600.0
"""Longest time for which a rod is drawn, s."""


class Partners:
    """Follows the other arms of the cell to which this panel's arm belongs.

    Attributes:
        cell: None: the arm is in none.
        own: the arm itself.
    """

    def __init__(self) -> None:
        self.cell: CellConfig | None = None
        self.own: Member | None = None
        self._feeds: dict[str, Feed] = {}
        self.rod: list[list[list[float]]] = []
        """Curves of the rod that the arms are to bend, seen from the own base, m."""

    @property
    def members(self) -> tuple[Member, ...]:
        """The others, in the order of the cell."""
        return () if self.cell is None else tuple(arm for arm in self.cell.arms if arm is not self.own)

    @property
    def feeds(self) -> tuple[Feed, ...]:
        """Feeds of the others that run."""
        return tuple(self._feeds.values())

    def find_cell(self) -> None:
        """Look up the cell: it is known while an arm of it runs."""
        cell, own = cell_of_this_arm() or (None, None)
        if cell != self.cell:
            self.close()
        self.cell, self.own = cell, own

    def find(self) -> None:
        """Begin to read the arms that have started; drop those that have ended."""
        for member in self.members:
            if (feed := self._feeds.get(member.name)) is not None and feed.ended(0.0):
                self._feeds.pop(member.name).close()
            if member.name not in self._feeds:
                with contextlib.suppress(RtcpError, ConfigError, OSError):
                    self._feeds[member.name] = Feed(member.directory)

        self.rod = self._read_rod()

    def _read_rod(self) -> list[list[list[float]]]:
        """Return the curves of the rod that the arms are to bend, in the frame of the own base, m; often none."""
        if self.own is None:
            return []
        base = self.own.base
        back = Pose.from_xyzrpy(*base.position, *base.rpy).inverse()

        def in_own_frame(point: Sequence[float]) -> list[float]:
            x, y, z = point
            return [round(a + b, 4) for a, b in zip(applied(back.rotation, (x, y, z)), back.position, strict=True)]

        try:
            file = rod_file(self.own.directory.parent)
            rod = json.loads(file.read_text())
            os.kill(rod["pid"], 0)
            if time.time() - file.stat().st_mtime > _ROD_S:
                return []
            return [[in_own_frame(point) for point in curve] for curve in rod["curves"]]
        except (OSError, OverflowError, ValueError, TypeError, KeyError):
            # Also where its writer has died (`os.kill`).
            return []

    def close(self) -> None:
        """Release the shared memory of all."""
        while self._feeds:
            self._feeds.popitem()[1].close()

    def state(self) -> Json:
        """Return the state of each by name: state, q (rad; only where it runs), step, holder, message."""
        return {member.name: arm_state(self._feeds.get(member.name)) for member in self.members}


def arm_state(feed: Feed | None) -> Json:
    """Return the state of an arm of a cell for the pages; `feed` None: it does not run."""
    record = None if feed is None or feed.ended(0.0) else feed.latest()
    if feed is None or record is None:
        return {"state": "off", "message": "its platform does not run"}
    state: Json = {
        "state": State(int(record["state"][0])).name.lower(),
        "step": _STEP[int(record["step_phase"][0])],
        "holder": feed.holder,
        "message": feed.last_event(),
    }
    if time.monotonic_ns() - int(record["time_ns"][0]) > _SILENT_NS:
        state["state"] = "silent"
    if all(map(math.isfinite, q := record["actual_position"][0].tolist())):
        state["q"] = [round(angle, 5) for angle in q]
    return state
