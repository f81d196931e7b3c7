"""How `rtcp segment` runs: the segment in this process, and how to point a master at it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from rtcp.cli.outcome import CommandError, ExitCode
from rtcp.cli.output import report
from rtcp.virtual.network import NetworkError
from rtcp.virtual.server import run


def run_segment(config: Path, interface: str | None, poll: bool, cpu: int | None) -> None:
    """Run the slaves that `config` lists until SIGINT, SIGTERM or SIGHUP.

    Args:
        config: the file of the segment.
        interface: name of the master's end in the caller's network; None: in a namespace of the segment's own.
        poll: never sleep.
        cpu: CPU to run on, any when None.

    Raises:
        CommandError: when the interfaces cannot be made, or a model or an option is unknown.
        ConfigError: with every mistake of the file.
    """
    users_before = _user_namespace()

    def ready(facts: dict[str, int | str | bool]) -> None:
        # The segment has taken SIGTERM for its end by now; a terminal that closes is to end it in the same order.
        signal.signal(signal.SIGHUP, signal.getsignal(signal.SIGTERM))
        count, name, pid = facts["slaves"], facts["interface"], facts["pid"]
        report(f"segment of {count} {'slave' if count == 1 else 'slaves'} (process {pid})")
        if not facts["namespace"]:
            report(f"the master's end is {name}: `rtcp start --bus {name}`, or any other EtherCAT master on {name}")
        else:
            users = "" if _user_namespace() == users_before else " -U --preserve-credentials"
            report(f"the master's end is {name} in the network namespace of process {pid}; a master gets there by")
            report(f"  nsenter -t {pid}{users} -n COMMAND {name}")
        report("Ctrl-C ends it")

    try:
        run(config, interface, poll, cpu, ready)
    except (NetworkError, ValueError) as error:
        raise CommandError(str(error), ExitCode.USAGE) from error
    report("ended")


def _user_namespace() -> str:
    return os.readlink("/proc/self/ns/user")
