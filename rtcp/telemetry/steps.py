"""The steps of the targets from one cycle to the next, as cycle records have them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from rtcp.ipc.layout import FLAG_ENABLED


def target_steps(
    records: Mapping[str, npt.NDArray[Any]] | npt.NDArray[np.void],
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """Return each step that the drives followed: the index of its second cycle, and its size for each joint, rad.

    Two cycles make one where neither is missing between them and the drives are enabled in both: without that a target
    only repeats where the joint is.
    """
    numbers = records["number"].astype(np.int64)
    enabled = (records["flags"] & FLAG_ENABLED) != 0
    pairs = np.flatnonzero((np.diff(numbers) == 1) & enabled[1:] & enabled[:-1])
    targets = records["target"]
    return pairs + 1, np.abs(targets[pairs + 1] - targets[pairs])
