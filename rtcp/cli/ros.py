"""`rtcp ros`: the arm as a ROS node."""

from __future__ import annotations

from typing import Annotated

import typer

from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, ExitCode, report

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
    enable: Annotated[
        bool, option("--auto-enable", "A motion enables the drives, but not after a stop, a fault or robot_disable.")
    ] = False,
    partial: Annotated[bool, option("--partial", "Joints that a trajectory does not name hold.")] = False,
) -> None:
    """Run the arm as a ROS 1 node, until Ctrl-C (docs/ros.md); waits for the master and the platform."""
    from rtcp.ros import ros1_messages

    try:
        ros1_messages.make_importable()
    except ros1_messages.RosMissing as error:
        raise CommandError(str(error)) from None
    from rtcp.ros import ros1
    from rtcp.ros.commands import CommandOptions

    for argument in remappings or ():
        if ":=" not in argument:
            raise CommandError(f"{argument} is no remapping: write NAME:=VALUE", ExitCode.USAGE)
    report(f"node {name}: Ctrl-C ends it")
    ros1.run(ros1.NodeOptions(name, rate, remappings or (), CommandOptions(enable, partial)))
