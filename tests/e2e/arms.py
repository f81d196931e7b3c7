"""Other arms for the end-to-end tests, by files alone: `RTCP_TEST_ARM=myactuator python -m pytest tests/e2e`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from rtcp.config import load_device
from tests.drive_esi import Objects, write_esi

TWO_AXIS: Objects = {
    index + shift: held
    for shift in (0, 0x800)
    for index, held in ((0x608F, (131072, 1)), (0x6091, (50, 1)), (0x6076, ("UDINT", 40_000)), (0x603F, ("UINT", 0)))
}
MYACTUATOR: Objects = {0x608F: (131072, 1), 0x603F: ("UINT", 0)}
ARMS: dict[str, tuple[str, int, Objects, float]] = {
    "two-axis": ("two-axis-drive", 2, TWO_AXIS, 40.0),
    "myactuator": ("myactuator-x6-60", 1, MYACTUATOR, 9.5 * 2.1),
}
"""By name: device file, axes of a drive, what the drive holds, its rated torque, Nm."""


def replace_drives(folder: Path, name: str) -> None:
    """Replace the six drives of the configuration in `folder` by those of another arm."""
    device, axes, objects, rated_torque = ARMS[name]
    write_esi(folder / "drive.xml", load_device(folder / "devices" / f"{device}.yaml"), objects)
    arm, segment = (yaml.safe_load((folder / file).read_text()) for file in ("assistive_arm.yaml", "segment.yaml"))
    drives = [{"name": f"drive{i}", "device": device} for i in range(1, 6 // axes + 1)]
    arm["slaves"] = [arm["slaves"][0], *drives]
    for i, joint in enumerate(arm["joints"]):
        joint |= {"slave": f"drive{i // axes + 1}", "axis": i % axes + 1}
    # A described drive has no 0x10F1: its limit of missed SYNC0 is an option.
    options: dict[str, Any] = {"rated_torque": rated_torque, "sync_error_limit": 0}
    drive = {"esi": "drive.xml", "behaviour": "cia402", "options": options}
    segment["slaves"] = [segment["slaves"][0], *[drive] * len(drives)]
    for file, data in (("assistive_arm.yaml", arm), ("segment.yaml", segment)):
        (folder / file).write_text(yaml.safe_dump(data, sort_keys=False))
