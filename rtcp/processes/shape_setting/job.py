"""Jobs of `rtcp shape-set`: the rod, its shape, its chucks and place, and the profile of the heat; a YAML file."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import pi
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Gt, Le, MaxLen, MinLen

from kinematics import Pose
from rtcp.config.cell import Base
from rtcp.config.document import read
from rtcp.config.findings import Finding
from rtcp.config.model import MOST_AXES, ConfigError
from rtcp.config.numbers import FractionOfPi, Name
from rtcp.config.validation import Checker, rule
from rtcp.processes.rod import Chuck, Equilibrium, Rod, bend, pre_bend
from rtcp.processes.shape_setting.heat_profile import HeatProfile
from rtcp.processes.shape_setting.profile import read_profile

_Place = Base
_SAME_M = 1e-3
_Turns = Annotated[float, FractionOfPi(), Ge(-4 * pi), Le(4 * pi)]


@dataclass(frozen=True)
class RodKeys:
    """The rod between the chucks."""

    length: Annotated[float, Ge(0.1), Le(0.5)]
    """Free length, m."""
    diameter: Annotated[float, Ge(0.0003), Le(0.004)]
    """Diameter, m."""


@dataclass(frozen=True)
class Arc:
    """An arc of constant curvature."""

    angle: Annotated[float, Gt(0), Le(3)]
    """Angle between the ends, rad."""
    side: Annotated[tuple[float, ...], MinLen(2), MaxLen(2)] = (0.0, 1.0)
    """Direction in y and z of the rod's start to which it bends."""


@dataclass(frozen=True)
class ChuckKeys:
    """A chuck on the flange of an arm."""

    arm: Name
    """Name of the arm in the cell."""
    pose: _Place
    """The chuck's mouth on the flange, its x axis out of the chuck, along the rod."""
    radius: Annotated[float, Gt(0), Le(0.2)]
    """Radius of the chuck, m."""
    near: Annotated[tuple[_Turns, ...], MinLen(1), MaxLen(MOST_AXES)]
    """Joint positions that choose between the configurations of the arm, rad."""


@dataclass(frozen=True)
class Job:
    """A shape to set. It has either `arc` or `end`."""

    heat: Name
    """File of the heat profile, relative to this file's directory."""
    rod: RodKeys
    held: _Place
    """The rod's middle in the world, x along the straight rod; it stays there."""
    chucks: Annotated[tuple[ChuckKeys, ...], MinLen(2), MaxLen(2)]
    arc: Arc | None = None
    end: _Place | None = None
    """Pose of the rod's end in the frame of its start, x along the rod."""
    approach_speed: Annotated[float, Gt(0), Le(2)] = 0.3
    """Speed of the fastest joint to where the straight rod is gripped, rad/s."""

    @property
    def mechanics(self) -> Rod:
        """The rod for `rtcp.processes.rod`."""
        return Rod(self.rod.length, self.rod.diameter)

    @property
    def holders(self) -> dict[str, Chuck]:
        """The chucks by their arms."""
        return {chuck.arm: Chuck(pose_of(chuck.pose), chuck.radius) for chuck in self.chucks}

    @property
    def near(self) -> dict[str, tuple[float, ...]]:
        """Joint positions by arm, rad."""
        return {chuck.arm: chuck.near for chuck in self.chucks}

    def steps(self) -> tuple[Equilibrium, ...]:
        """Return the path of the rod from straight to the shape; raises Refused as `pre_bend` and `bend`."""
        if self.arc is not None:
            return pre_bend(self.mechanics, (self.arc.side[0], self.arc.side[1]), self.arc.angle)
        assert self.end is not None
        return bend(self.mechanics, pose_of(self.end))


@rule(Job, "arc", "end", "chucks")
def _shape(job: Job) -> Iterator[Finding]:
    if (job.arc is None) == (job.end is None):
        count = "neither" if job.arc is None else "both"
        yield Finding((), "one_of_both", found=f"{count} of arc and end", allowed="one of them")
    if job.arc is not None and not any(job.arc.side):
        yield Finding(("arc", "side"), "no_direction", text="found 0, 0, allowed is a direction")
    if job.chucks[0].arm == job.chucks[1].arm:
        yield Finding(("chucks", 1, "arm"), "twice", found=job.chucks[1].arm, unit=" twice", allowed="another arm")


_FILE = Checker(Job)


def pose_of(place: Base) -> Pose:
    """Return a place as a pose."""
    return Pose.from_xyzrpy(*place.position, *place.rpy)


def read_job(path: Path) -> tuple[Job, HeatProfile]:
    """Return the job in a file, and the heat profile that it names.

    Raises:
        ConfigError: one sentence per mistake in both files, with its line.
    """
    document = read(path)
    job = _FILE.read(document)
    profile = read_profile(path.parent / job.heat, job.rod.length, job.rod.diameter)
    if abs(profile.ends.length - job.rod.length) > _SAME_M:
        text = f"found {job.rod.length:g} m, the profile {job.heat} has ends.length {profile.ends.length:g} m: one rod"
        raise ConfigError(document.placed([Finding(("rod", "length"), "other_length", text=text)]))
    return job, profile
