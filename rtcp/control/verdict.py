"""What a command is answered with."""

from __future__ import annotations

from typing import TypeAlias

from rtcp.ipc.codes import Refusal

Verdict: TypeAlias = tuple[Refusal] | tuple[Refusal, int, float] | tuple[Refusal, int, float, float]
"""A refusal (or NONE), the axis that it is about, the value and the limit."""
DONE: Verdict = (Refusal.NONE,)
