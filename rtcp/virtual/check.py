"""A segment's file checked whole before a process is started: its form, and what only the models know."""

from __future__ import annotations

from pathlib import Path

from rtcp.config.document import Finding, read
from rtcp.config.model import ConfigError
from rtcp.config.segment import SegmentSlave, load_segment
from rtcp.virtual.models import MODELS, create
from rtcp.virtual.server import default_delays


def check_segment(path: Path) -> None:
    """Check that a segment can be made of the file.

    Raises:
        ConfigError: with one sentence for every mistake: file, line, key, what was found and what is allowed.
    """
    slaves = load_segment(path).slaves
    findings = [finding for i, slave in enumerate(slaves) for finding in _model_findings(i, slave)]
    findings += _delay_findings(slaves)
    if findings:
        raise ConfigError(read(path).sentences(findings))


def _model_findings(i: int, slave: SegmentSlave) -> list[Finding]:
    if slave.model not in MODELS:
        text = f'found the text "{slave.model}", allowed is one of {", ".join(MODELS)}'
        return [(("slaves", i, "model"), text)]
    findings: list[Finding] = []
    for name, value in slave.options.items():
        try:
            create(slave.model, **{name: value})
        except ValueError as error:
            findings.append((("slaves", i, "options", name), str(error)))
    return findings


def _delay_findings(slaves: tuple[SegmentSlave, ...]) -> list[Finding]:
    findings: list[Finding] = []
    before = 0
    for i, (slave, usual) in enumerate(zip(slaves, default_delays(len(slaves)), strict=True)):
        delay = usual if slave.delay_ns is None else slave.delay_ns
        if delay < before:
            text = f"found {delay} ns, allowed is at least the {before} ns of the slave before it"
            findings.append((("slaves", i, "delay_ns"), text))
        before = delay
    return findings
