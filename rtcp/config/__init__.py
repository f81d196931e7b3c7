"""The configuration: `find_config()` names the file, `load()` checks it whole, `rtcp.config.model` is the result.

Modules that need the validator are imported on first use: the loop's process never loads it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from rtcp.config.find import default_config, find_arm, find_config
from rtcp.config.model import ConfigError

if TYPE_CHECKING:
    from rtcp.config.loader import load, load_device, load_kinematics, segment_path, with_period
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

_SEGMENT = ("SegmentConfig", "SegmentSlave", "load_segment")


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"rtcp.config.{'segment' if name in _SEGMENT else 'loader'}"), name)
