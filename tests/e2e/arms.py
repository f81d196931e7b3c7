"""Other arms for the end-to-end tests, by files alone: `RTCP_TEST_ARM=myactuator python -m pytest tests/e2e`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from rtcp.config import default_config, load_device
from tests.drive_esi import ARMS, write_esi


def slaves_of(name: str) -> int:
    """Return how many slaves an arm has, its IO box counted."""
    device, _, _ = ARMS[name]
    return 1 + 6 // len(load_device(default_config().parent / "devices" / f"{device}.yaml").axes)


def replace_drives(folder: Path, name: str) -> None:
    """Replace the six drives of the configuration in `folder` by those of another arm."""
    device, objects, own = ARMS[name]
    described = load_device(folder / "devices" / f"{device}.yaml")
    write_esi(folder / "drive.xml", described, objects)
    axes = len(described.axes)
    arm, segment = (yaml.safe_load((folder / file).read_text()) for file in ("assistive_arm.yaml", "segment.yaml"))
    # A described drive has no 0x10F1: its limit of missed SYNC0 is an option.
    drives: list[dict[str, Any]] = [
        {"esi": "drive.xml", "behaviour": "cia402", "options": {**own, "sync_error_limit": 0}} for _ in range(6 // axes)
    ]
    # Its inertia at the last joint is not that of the smallest Cubemars: the gains of the joint before it suit.
    arm["joints"][5] |= {key: value for key, value in arm["joints"][4].items() if key.startswith("cst_")}
    for i, joint in enumerate(arm["joints"]):
        at, axis = i // axes, i % axes + 1
        joint |= {"slave": f"drive{at + 1}", "axis": axis, "torque": 1000.0 * described.scaling_of(axis).torque}
        del joint["drive_torque"]
        drives[at]["options"][f"axis{axis}_load_inertia"] = segment["slaves"][i + 1]["options"]["load_inertia"]
    arm["slaves"] = [arm["slaves"][0], *({"name": f"drive{i + 1}", "device": device} for i in range(len(drives)))]
    segment["slaves"] = [segment["slaves"][0], *drives]
    for file, data in (("assistive_arm.yaml", arm), ("segment.yaml", segment)):
        (folder / file).write_text(yaml.safe_dump(data, sort_keys=False))
