"""How `rtcp segment` runs: the segment in this process, and how to point a master at it."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

from rtcp.cli.errors import CommandError, ExitCode
from rtcp.cli.output import report
from rtcp.ipc.runtime_directory import (
    RuntimeDirectoryError,
    free_segment_control,
    make_runtime_directory,
    runtime_directory,
    segment_control,
)
from rtcp.virtual.network import NetworkError
from rtcp.virtual.server import run


def run_segment(config: Path, interface: str | None, poll: bool, cpu: int | None, script: Path | None) -> None:
    """Run the slaves that `config` lists until SIGINT, SIGTERM or SIGHUP.

    Args:
        config: the file of the segment.
        interface: name of the master's end in the caller's network; None: in a namespace of the segment's own.
        poll: never sleep.
        cpu: CPU to run on, any when None.
        script: file of faults with their times.

    Raises:
        CommandError: when the interfaces cannot be made, or a model or an option is unknown.
        ConfigError: with every mistake of the files.
    """
    users_before = _user_namespace()
    control = _control()

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
        where = "" if control == segment_control(runtime_directory()) else f" --segment {control}"
        report(f"faults are made by `rtcp segment fault NAME{where}`: control socket {control}")
        report("Ctrl-C ends it")

    try:
        run(config, interface, poll, cpu, ready, control, script)
    except (NetworkError, ValueError) as error:
        raise CommandError(str(error), ExitCode.USAGE) from error
    report("ended")


def _control() -> Path:
    """Return where the control socket is to be: where it is looked for, or else where nobody else's is."""
    directory = runtime_directory()
    try:
        make_runtime_directory(directory)
    except RuntimeDirectoryError:
        return Path(tempfile.gettempdir()) / f"rtcp-segment-{os.getpid()}.sock"
    return free_segment_control(directory)


def _user_namespace() -> str:
    return os.readlink("/proc/self/ns/user")
