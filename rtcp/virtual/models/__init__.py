"""Device models of the virtual segment, by name: `create("cubemars-orh70", load_inertia=1.5)`."""

from __future__ import annotations

from rtcp.virtual.device import Device
from rtcp.virtual.models.cubemars import CubemarsDrive
from rtcp.virtual.models.diewu import DiewuIoBox
from rtcp.virtual.models.mechanics import SIZES

_DRIVE = "cubemars-"
_IO_BOX = "diewu-io"

MODELS: tuple[str, ...] = (_IO_BOX, *(_DRIVE + size for size in SIZES))
"""The names that `create` knows."""

__all__ = ["MODELS", "CubemarsDrive", "DiewuIoBox", "create"]


def create(model: str, **options: object) -> Device:
    """Return a new device of this model, powered on.

    Raises:
        ValueError: a model or an option that does not exist, or an option's value that is not allowed.
    """
    if model not in MODELS:
        raise ValueError(f"there is no device model {model!r}; there are: {', '.join(MODELS)}")
    if model == _IO_BOX:
        return DiewuIoBox(**options)
    return CubemarsDrive(model.removeprefix(_DRIVE), **options)
