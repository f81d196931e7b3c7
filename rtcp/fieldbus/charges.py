"""The slaves in the watcher's care: what it knows of each, and the table of what it does."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from rtcp.fieldbus.alstatus import AlState
from rtcp.fieldbus.bus import SlaveState, slave_label, station_of
from rtcp.fieldbus.steps import Steps

LONG_AGO = float("-inf")
SAY_AGAIN_S = 10.0
"""A slave's trouble is told at once, and then at most so often."""


class Action(Enum):
    """What is done with a slave."""

    NOTHING = "nothing"
    ACKNOWLEDGE = "acknowledge its error"
    REQUEST_SAFEOP = "request SAFE-OP"
    REQUEST_OP = "request OP"
    REQUEST_PREOP = "request PRE-OP: it was to be parked"
    RECONFIGURE = "set it up again"
    MARK_LOST = "mark it lost; when it answers again, recover it"


# (state, error) -> what is done; any other state that answers is RECONFIGURE.
TABLE: dict[tuple[AlState, bool], Action] = {
    (AlState.OP, False): Action.NOTHING,
    (AlState.OP, True): Action.ACKNOWLEDGE,
    (AlState.SAFEOP, True): Action.ACKNOWLEDGE,
    (AlState.SAFEOP, False): Action.REQUEST_OP,
    (AlState.NONE, False): Action.MARK_LOST,
}


def action_for(state: AlState, error: bool) -> Action:
    """Return what is done with a slave that is in `state`."""
    return TABLE.get((state, error), Action.RECONFIGURE)


@dataclass
class Charge:
    """One slave in the watcher's care."""

    position: int
    name: str
    state: AlState = AlState.OP
    error: bool = False
    code: int = 0
    lost: int = 0
    """How often it left OP."""
    recovered: int = 0
    """How often it was back in OP after that."""
    left_at: float | None = None
    was_in_op: bool = True
    back_at: float = LONG_AGO
    """When it last came to OP."""
    flaps: int = 0
    """How often in a row it fell out of OP again at once."""
    kept: bool = False
    """Whether it is in PRE-OP because it was sent there, its set-up untouched."""
    leaving: bool = False
    """Whether it was sent to PRE-OP and has been seen in nothing but OP since."""
    unfinished: bool = False
    """Whether a restoration was begun that did not come to its end."""
    work: Steps[None] | None = None
    asked: tuple[Action, AlState, bool, float] | None = None
    """What was asked, in which state it was then, and until when it may take."""
    failed: int = 0
    pause_until: float = 0.0
    probe_at: float = 0.0
    told_at: float = LONG_AGO
    fall_told_at: float = LONG_AGO
    untold: int = 0
    """How often it left OP since that was told last."""
    return_due: bool = False
    """Whether its return is to be told: its fall was."""

    @property
    def label(self) -> str:
        """How sentences name it."""
        return slave_label(self.position, self.name)

    @property
    def station(self) -> int:
        """Its configured station address."""
        return station_of(self.position)

    @property
    def well(self) -> bool:
        """Whether it is in OP, without an error, and not about to leave it as it was told to."""
        return self.state is AlState.OP and not self.error and not self.leaving

    def take(self, state: AlState, error: bool, code: int) -> None:
        """Note the state in which it was found."""
        self.state, self.error, self.code = state, error, code
        if state not in (AlState.OP, AlState.NONE):
            self.leaving = False

    def words(self) -> str:
        """Return its state in words."""
        return SlaveState(self.position, self.station, self.name, self.state, self.error, self.code).words()
