"""Findings in a file as tests compare them: `key: code`, with line and fields where they matter."""

from __future__ import annotations

import re
from collections.abc import Callable

import pytest

from rtcp.config import ConfigError
from rtcp.config.findings import Finding


def summary(finding: Finding, like: str) -> str:
    """The finding as `line key: code field=value`, with line and fields only where `like` has them."""
    line = f"{finding.line} " if re.match(r"\d+ ", like) else ""
    fields = (f" {name}={finding.fields.get(name)}" for name in re.findall(r" (\w+)=", like))
    return f"{line}{finding.key}: {finding.code}{''.join(fields)}"


def findings_of(read: Callable[[], object]) -> list[Finding]:
    """Return the findings of a reader."""
    with pytest.raises(ConfigError) as caught:
        read()
    return caught.value.findings


def assert_finds(read: Callable[[], object], *expected: str) -> None:
    """Assert that these are found, and nothing else."""
    findings = findings_of(read)
    assert len(findings) == len(expected), [*map(str, findings)]
    assert [summary(*pair) for pair in zip(findings, expected, strict=True)] == [*expected]
