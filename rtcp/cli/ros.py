"""`rtcp ros`: the arm as ROS sees it."""

from __future__ import annotations

import logging
import signal
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.cli.arguments import is_loopback, option
from rtcp.cli.output import CommandError, report
from rtcp.ipc.runtime_directory import log_format

if TYPE_CHECKING:
    from rtcp.ros.simple_message.server import ServerOptions

commands = typer.Typer()


@commands.command("ros")
def _ros(
    simple_message: Annotated[bool, option("--simple-message", "Serve Simple Message: motion and state.")] = False,
    motion_port: Annotated[int, typer.Option("--motion-port", min=0, max=65535, help="Port; 0: a free one.")] = 11000,
    state_port: Annotated[int, typer.Option("--state-port", min=0, max=65535, help="Port; 0: a free one.")] = 11002,
    bind: Annotated[
        str, option("--bind", "ADDRESS", "Address to listen at. Default: this machine only.")
    ] = "127.0.0.1",
    byte_order: Annotated[
        str, option("--byte-order", "auto|little|big", "Of the clients; auto: as they speak, else little.")
    ] = "auto",
    joint_feedback: Annotated[
        bool,
        option("--joint-feedback", "Send velocities too (JOINT_FEEDBACK), which the reference client complains of."),
    ] = False,
) -> None:
    """Serve the arm to ROS-Industrial, until Ctrl-C; it waits for a platform that does not run."""
    import asyncio

    from rtcp.ros.simple_message.messages import ByteOrder
    from rtcp.ros.simple_message.server import ServerOptions

    if not simple_message:
        raise CommandError("nothing to serve: give --simple-message")
    orders = {"auto": None, "little": ByteOrder.LITTLE, "big": ByteOrder.BIG}
    if byte_order not in orders:
        raise CommandError(f"--byte-order {byte_order} is not known: {', '.join(orders)}")
    options = ServerOptions(bind, motion_port, state_port, orders[byte_order], joint_feedback)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(log_format())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    asyncio.run(_serve(options))


async def _serve(options: ServerOptions) -> None:
    """Serve until a signal comes; the arm stops then as if its client was lost."""
    import asyncio

    from rtcp.ros.simple_message.robot_arm import RobotArm
    from rtcp.ros.simple_message.server import SimpleMessageServer

    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    arm = RobotArm()
    connection = asyncio.create_task(arm.run())
    try:
        async with SimpleMessageServer(arm, options) as server:
            motion, state = server.ports
            report(f"motion at {options.bind}:{motion}, state at {options.bind}:{state}; Ctrl-C ends it")
            if not is_loopback(options.bind):
                report(f"whoever reaches {options.bind} can move the arm: nobody is asked for a name")
            await ended.wait()
    finally:
        connection.cancel()
