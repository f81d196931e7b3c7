"""Arms of six joints with drives as six makers build them: `python -m tests.makers.arms` moves each of them.

For each: `rtcp device new` from an ESI file, the figures filled in that it asks for, nothing else edited; then a joint
move on the segment, whose drives turn by their name plate and know nothing of the device's file. The ESI files here
are ours: structure, process data, types and objects are those of the makers' public files, their texts are not.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from rtcp.config import default_config, load
from rtcp.ipc.commands import MoveJoints
from rtcp.ipc.states import State
from rtcp.testing.simulation import Simulation
from tests.required import filled

FOLDER = Path(__file__).parent
GOAL = (0.2, 0.35, 2.2, -0.2, 0.4, 0.3)
"""Positions that the joints move to, rad."""
_RATED_NM, _PERIOD_US = 0.64, 1000


@dataclass(frozen=True)
class Maker:
    """A maker's drive at a joint."""

    figures: Mapping[str, object]
    """What a person fills in, from the name plate and the manual."""
    counts_per_turn: int
    """Position counts of a revolution of the joint, as the drive counts them."""
    gear: int
    """Motor revolutions per revolution of the joint."""


_TORQUE: Mapping[str, object] = {"rated_torque": _RATED_NM, "torque_at": "motor"}
_VELOCITY: Mapping[str, object] = {"velocity_unit": "counts/s", "velocity_at": "motor"}
MAKERS: Mapping[str, Maker] = {
    "elmo_gold": Maker(
        {"encoder_increments": 16384, "gear_ratio": 1, "external_gear_ratio": 120, "feed_constant": 16384},
        16384 * 120, 120,
    ),
    "inovance_is620n": Maker({"encoder_increments": 8388608, "external_gear_ratio": 50, **_TORQUE}, 8388608 * 50, 50),
    "copley_bel": Maker(
        {"encoder_increments": 20000, "gear_ratio": 1, "external_gear_ratio": 100, "feed_constant": 0,
         **_VELOCITY, **_TORQUE},
        20000 * 100, 100,
    ),
    "ingenia_everest": Maker(
        {"encoder_increments": 65536, "gear_ratio": 1, "external_gear_ratio": 121, **_VELOCITY}, 65536 * 121, 121
    ),
    "synapticon_somanet": Maker(
        {"encoder_increments": 524288, "gear_ratio": 100, "external_gear_ratio": 1, **_VELOCITY, **_TORQUE},
        524288 * 100, 100,
    ),
    "leadshine_2dm3": Maker({"encoder_increments": 131072, "external_gear_ratio": 80, **_TORQUE}, 10000 * 80, 80),
}  # fmt: skip
"""By the file of their drive. The last counts 10 000 a turn of the motor whatever its encoder has (0x6092)."""


def make(folder: Path, name: str, figures: Mapping[str, object]) -> Path:
    """Write the arm with a maker's drives into a folder, as a user does; return the arm's file."""
    maker, esi, device = MAKERS[name], FOLDER / f"{name}.xml", folder / "devices" / f"{name}.yaml"
    shutil.copytree(default_config().parent, folder, dirs_exist_ok=True)
    command = [sys.executable, "-m", "rtcp.cli", "device", "new", "--esi", str(esi), "--out", str(device)]
    subprocess.run(command, check=True, capture_output=True)
    device.write_text(filled(device.read_text(), figures))
    arm, segment = (yaml.safe_load((folder / file).read_text()) for file in ("assistive_arm.yaml", "segment.yaml"))
    axes = device.read_text().count("encoder_increments:")
    # A described drive has no 0x10F1: its limit of missed SYNC0 is an option.
    options: dict[str, Any] = {
        "counts_per_turn": float(maker.counts_per_turn),
        "rated_torque": _RATED_NM * maker.gear,
        "torque_ratio": float(maker.gear),
        "sync_error_limit": 0,
    }
    drives: list[dict[str, Any]] = [
        {"esi": str(esi), "behaviour": "cia402", "options": dict(options)} for _ in range(6 // axes)
    ]
    arm["cycle"]["period_us"] = _PERIOD_US
    arm["slaves"] = [arm["slaves"][0], *({"name": f"drive{i + 1}", "device": name} for i in range(len(drives)))]
    for i, joint in enumerate(arm["joints"]):
        at, axis = i // axes, i % axes + 1
        joint |= {"slave": f"drive{at + 1}", "axis": axis}
        del joint["drive_torque"]  # the drive keeps its own
        own = segment["slaves"][i + 1]["options"]
        drives[at]["options"] |= {f"axis{axis}_{key}": value for key, value in own.items() if key != "serial"}
    segment["slaves"] = [segment["slaves"][0], *drives]
    for file, data in (("assistive_arm.yaml", arm), ("segment.yaml", segment)):
        (folder / file).write_text(yaml.safe_dump(data, sort_keys=False))
    return folder / "assistive_arm.yaml"


def move(file: Path) -> tuple[list[float], list[float]]:
    """Enable the arm and move its joints to `GOAL`; return the positions of the shafts, and those reported, rad."""
    with Simulation(load(file), follow_clock=False) as arm:
        arm.hold()
        arm.do(MoveJoints(GOAL, 0.5, True))
        arm.bring_to(State.HOLDING, 20.0)
        arm.run(0.3)
        servos = [servo for slave in arm.bus.slaves for servo in slave.device.servos]
        return [servo.mechanics.position for servo in servos], list(arm.loop.arm.state.actual)


def main() -> None:
    """Move the arm of each maker, and print the largest error of its joints."""
    for name, maker in MAKERS.items():
        with tempfile.TemporaryDirectory(prefix="rtcp-makers-") as folder:
            shafts, reported = move(make(Path(folder), name, maker.figures))
        errors = [max(abs(a - b) for a, b in zip(found, GOAL, strict=True)) for found in (shafts, reported)]
        print(f"{name:20} shafts within {errors[0]:.5f} rad of the goal, reported within {errors[1]:.5f} rad")


if __name__ == "__main__":
    main()
