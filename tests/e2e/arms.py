"""Other arms for the end-to-end tests, by files alone: `RTCP_TEST_ARM=myactuator python -m pytest tests/e2e`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from rtcp.config import load_device
from tests.drive_esi import ARMS, write_esi


def replace_drives(folder: Path, name: str) -> None:
    """Replace the six drives of the configuration in `folder` by those of another arm."""
    device, objects, own = ARMS[name]
    described = load_device(folder / "devices" / f"{device}.yaml")
    axes = len(described.axes)
    write_esi(folder / "drive.xml", described, objects)
    arm, segment = (yaml.safe_load((folder / file).read_text()) for file in ("assistive_arm.yaml", "segment.yaml"))
    drives = [{"name": f"drive{i}", "device": device} for i in range(1, 6 // axes + 1)]
    arm["slaves"] = [arm["slaves"][0], *drives]
    for i, joint in enumerate(arm["joints"]):
        joint |= {"slave": f"drive{i // axes + 1}", "axis": i % axes + 1}
    # A described drive has no 0x10F1: its limit of missed SYNC0 is an option.
    options: dict[str, Any] = {**own, "sync_error_limit": 0}
    drive = {"esi": "drive.xml", "behaviour": "cia402", "options": options}
    segment["slaves"] = [segment["slaves"][0], *[drive] * len(drives)]
    for file, data in (("assistive_arm.yaml", arm), ("segment.yaml", segment)):
        (folder / file).write_text(yaml.safe_dump(data, sort_keys=False))
