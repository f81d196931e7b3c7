"""`rtcp ros`: the arm as a node of ROS 1 or ROS 2, or as a Simple Message server."""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rtcp.cli.arguments import is_loopback, option
from rtcp.cli.output import CommandError, ExitCode, report
from rtcp.ipc.runtime_directory import log_format, platform_name

if TYPE_CHECKING:
    from rtcp.ros.commands import CommandOptions
    from rtcp.ros.ros2_node import Ros2Options
    from rtcp.ros.simple_message.server import ServerOptions

commands = typer.Typer()


@commands.command("ros")
def _ros(
    remappings: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME:=VALUE]...", help="Remappings, as roslaunch passes them.")
    ] = None,
    rate: Annotated[
        float, typer.Option("--rate", min=1.0, max=10_000.0, help="Joint states a second, at most one a cycle.")
    ] = 100.0,
    name: Annotated[str, option("--name", "NAME", "Of the node.")] = "rtcp",
    group: Annotated[
        bool, option("--cell", "All arms of the cell as one group of joints, in step: left_joint_1, ...")
    ] = False,
    enable: Annotated[
        bool, option("--auto-enable", "A motion enables the drives, but not after a stop, a fault or robot_disable.")
    ] = False,
    partial: Annotated[bool, option("--partial", "Joints that a trajectory does not name hold.")] = False,
    tf: Annotated[bool, option("--tf", "Publish the frames of the links too: no robot_state_publisher runs.")] = False,
    buffer: Annotated[
        float,
        typer.Option(
            "--buffer", min=0.0, max=60.0, help="joint_command is executed so many seconds later; 0: each replaces."
        ),
    ] = 0.0,
    most_points: Annotated[
        int,
        typer.Option(
            "--downsample",
            min=0,
            max=4096,
            help="Points to which a longer trajectory is reduced, at least 2. 0: more than 4096 points are refused.",
        ),
    ] = 0,
    zenoh: Annotated[bool, option("--zenoh", "ROS 2 without ROS, over a Zenoh router (docs/ros2.md).")] = False,
    router: Annotated[str, option("--router", "tcp/HOST:PORT", "Zenoh router.")] = "tcp/localhost:7447",
    dds: Annotated[bool, option("--dds", "ROS 2 without ROS, over DDS: topics only (docs/ros2.md).")] = False,
    ros2: Annotated[bool, option("--ros2", "ROS 2 with rclpy, from a sourced ROS environment.")] = False,
    domain: Annotated[int, typer.Option("--domain", min=0, max=232, envvar="ROS_DOMAIN_ID", help="Of ROS 2.")] = 0,
    simple_message: Annotated[
        bool, option("--simple-message", "No node: serve Simple Message, motion and state (docs/simple_message.md).")
    ] = False,
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
    messages: Annotated[
        bool,
        option("--messages", "Print the folder of the message classes, for PYTHONPATH of rostopic and rosservice."),
    ] = False,
    until: Annotated[int, typer.Option("--until", hidden=True, help="End with this process; 0: with none.")] = 0,
) -> None:
    """Serve the arm to ROS until Ctrl-C: a node of ROS 1 (docs/ros.md) or ROS 2, or a Simple Message server.

    Waits for a platform, and for a master or router, that do not run.
    """
    if messages:
        print(_messages())
        return
    for argument in remappings or ():
        if ":=" not in argument:
            raise CommandError(f"{argument} is no remapping: write NAME:=VALUE", ExitCode.USAGE)
    wires = [wire for wire, chosen in (("zenoh", zenoh), ("dds", dds), ("ros2", ros2)) if chosen]
    if len(wires) + simple_message > 1:
        raise CommandError("choose one of --zenoh, --dds, --ros2, --simple-message", ExitCode.USAGE)
    from rtcp.ros.commands import CommandOptions  # here: it loads slowly, as do the imports below

    if most_points == 1:
        raise CommandError("--downsample 1 keeps no motion: allowed are 0, 2 and more", ExitCode.USAGE)
    options = CommandOptions(enable, partial, buffer, most_points)
    # The name of a platform is its namespace; the group has that of no arm.
    space = "" if group else platform_name().replace("-", "_")
    if simple_message:
        import asyncio

        from rtcp.fieldbus.simple_message.messages import ByteOrder
        from rtcp.ros.simple_message.server import ServerOptions

        orders = {"auto": None, "little": ByteOrder.LITTLE, "big": ByteOrder.BIG}
        if byte_order not in orders:
            raise CommandError(f"--byte-order {byte_order} is not known: {', '.join(orders)}", ExitCode.USAGE)
        server = ServerOptions(bind, motion_port, state_port, orders[byte_order], joint_feedback)
        asyncio.run(_serve(server, until, group))
    elif wires:
        if remappings and not ros2:
            raise CommandError(f"--{wires[0]} knows no remappings: leave out {remappings[0]}", ExitCode.USAGE)
        from rtcp.ros.ros2_node import Ros2Options

        _run_ros2(wires[0], router, Ros2Options(name, rate, domain, options, remappings or (), group, space))
    else:
        given = [word.partition(":=")[2] for word in remappings or () if word.startswith("__ns:=")]
        # rospy reads the namespace when it is imported, from there.
        if space or given:
            os.environ["ROS_NAMESPACE"] = given[-1] if given else f"/{space}"
        _run_node(name, rate, remappings or (), tf, options, group)


def _messages() -> Path:
    """Return the folder of the generated message classes."""
    from rtcp.ros import ros1_messages

    try:
        return ros1_messages.generated()
    except ros1_messages.RosMissing as error:
        raise CommandError(str(error)) from None


def _run_node(
    name: str, rate: float, remappings: Sequence[str], tf: bool, options: CommandOptions, group: bool
) -> None:  # fmt: skip
    """Run a ROS 1 node."""
    from rtcp.ros import ros1_messages

    try:
        ros1_messages.make_importable()
    except ros1_messages.RosMissing as error:
        raise CommandError(str(error)) from None
    from rtcp.ros import ros1

    report(f"node {name}: Ctrl-C ends it")
    ros1.run(ros1.NodeOptions(name, rate, tf, remappings, options, group))


def _run_ros2(wire: str, router: str, options: Ros2Options) -> None:
    """Run a ROS 2 node."""
    try:
        from rtcp.ros.ros2_node import OpenWire, run

        open_wire: OpenWire
        if wire == "zenoh":
            from rtcp.ros import ros2_zenoh

            open_wire = ros2_zenoh.open_wire(router)
        elif wire == "dds":
            from rtcp.ros import ros2_dds

            open_wire = ros2_dds.open_wire
        else:
            from rtcp.ros import ros2_rclpy

            open_wire = ros2_rclpy.open_wire
    except ImportError as error:
        if wire == "ros2":
            how = "source a ROS 2 environment, in its Python"
        else:
            how = f"pip install 'rtcp[{wire}]'" + (" (x86_64)" if wire == "dds" else "")
        raise CommandError(f"--{wire} cannot run here, {error}: {how}") from None
    _log_to_stderr()
    report(f"node {options.name}: Ctrl-C ends it")
    run(options, open_wire)


def _log_to_stderr() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(log_format())
    logging.basicConfig(level=logging.INFO, handlers=[handler])


async def _serve(options: ServerOptions, until: int, group: bool) -> None:
    """Serve Simple Message until a signal comes or a process ends; the arm stops then as if its client was lost."""
    import asyncio

    from rtcp.ros.simple_message.cell_arm import CellArm
    from rtcp.ros.simple_message.robot_arm import RobotArm
    from rtcp.ros.simple_message.server import SimpleMessageServer

    _log_to_stderr()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    if until:
        try:
            asyncio.get_running_loop().add_reader(os.pidfd_open(until), ended.set)
        except ProcessLookupError:
            return
    arm = CellArm() if group else RobotArm()
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
