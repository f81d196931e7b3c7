"""The configuration: `find_config()` names the file, `load()` checks it whole, `rtcp.config.model` is the result.

What needs the validator is imported on first use: the loop's process holds the model's objects and never the validator.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from rtcp.config.errors import ConfigError
from rtcp.config.find import default_config, find_arm, find_config

if TYPE_CHECKING:
    from rtcp.config.kinematics import load_kinematics
    from rtcp.config.schema import load, load_device, segment_path, with_period
    from rtcp.config.segment import SegmentConfig, SegmentSlave, load_segment

__all__ = [
    "ConfigError",
    "SegmentConfig",
    "SegmentSlave",
    "default_config",
    "find_arm",
    "find_config",
    "load",
    "load_device",
    "load_kinematics",
    "load_segment",
    "segment_path",
    "with_period",
]

_ON_FIRST_USE = {
    "load_kinematics": "rtcp.config.kinematics",
    **dict.fromkeys(("load", "load_device", "segment_path", "with_period"), "rtcp.config.schema"),
    **dict.fromkeys(("SegmentConfig", "SegmentSlave", "load_segment"), "rtcp.config.segment"),
}


def __getattr__(name: str) -> object:
    if name not in _ON_FIRST_USE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_ON_FIRST_USE[name]), name)
