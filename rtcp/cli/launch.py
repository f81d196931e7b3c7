"""How `start` and `demo` bring a platform up: one at a time, nothing left behind when it fails."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from rtcp.cli.errors import CommandError, ExitCode, code_of, interruption_code, orderly_signals
from rtcp.config.errors import ConfigError
from rtcp.ipc.runtime_directory import runtime_directory

if TYPE_CHECKING:
    from rtcp.launch.launcher import StartOptions
    from rtcp.launch.platform import Platform


def refuse_a_second_platform() -> None:
    """Refuse while a platform runs, be it one that has lost its gateway.

    Raises:
        CommandError: with the process that runs.
    """
    from rtcp.ipc.session import is_running, read_processes

    loop = read_processes(runtime_directory()).loop
    if is_running(loop):
        raise CommandError(
            f"a platform runs already (loop process {loop}): `rtcp status` shows it, `rtcp stop` ends it",
            ExitCode.REFUSED,
        )


def launch(options: StartOptions, report: Callable[[str], None]) -> Platform:
    """Start the platform and return it in the state ready; `report` is given each step in one line.

    Raises:
        CommandError: with the launcher's sentence or the configuration's mistakes, or when a signal ended the start.
    """
    from rtcp.launch import launcher
    from rtcp.launch.platform import StartError
    from rtcp.virtual.check import check_segment

    try:
        with orderly_signals():
            return launcher.start(options, report, check_segment)
    except StartError as error:
        raise CommandError(str(error), code_of(error.kind)) from error
    except ConfigError as error:
        raise CommandError(str(error), ExitCode.USAGE) from error
    except KeyboardInterrupt as interruption:
        raise CommandError(
            "interrupted while starting: nothing is left running", interruption_code(interruption)
        ) from None


def serve(options: StartOptions, report: Callable[[str], None], announce: Callable[[], None]) -> int:
    """Start the platform, call `announce` when it is ready, wait for its end and return the exit code.

    Raises:
        CommandError: as `launch`.
    """
    from rtcp.launch.supervisor import supervise

    with orderly_signals():
        running = launch(options, report)
        try:
            announce()
            return supervise(running, report)
        except KeyboardInterrupt:  # a signal that came before `wait` had taken them over
            return ExitCode.FAULT if running.stop(report) else ExitCode.DONE
