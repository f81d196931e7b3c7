"""`rtcp live`: the running platform in Foxglove or Lichtblick."""

from __future__ import annotations

from typing import Annotated

import typer

from rtcp.cli.arguments import is_loopback, option
from rtcp.cli.output import CommandError, ExitCode, report, signals_raise
from rtcp.config.find import default_config
from rtcp.ipc.runtime_directory import runtime_directory

commands = typer.Typer()


@commands.command("live")
def _live(
    host: Annotated[
        str, option("--host", "ADDRESS", "Address to listen at. Default: this machine only.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: a free one.")] = 8765,
    every: Annotated[int, typer.Option("--every", min=1, max=1_000_000, help="Show every Nth cycle.")] = 1,
) -> None:
    """Show the running platform in Foxglove or Lichtblick, until Ctrl-C or its end."""
    from rtcp.telemetry.live import LiveView

    try:
        with signals_raise():
            view = LiveView(runtime_directory(), host, port, every)
            layout = default_config().parent / "layouts" / "foxglove.json"
            report(f"{view.url}: open it in Foxglove or Lichtblick, with the layout {layout}; Ctrl-C ends it")
            if not is_loopback(host):
                report(f"whoever reaches {host} can watch: nobody is asked for a name")
            view.run()
    except KeyboardInterrupt:
        raise typer.Exit(ExitCode.DONE) from None  # the normal end of a view
    raise CommandError("the platform has ended", ExitCode.NOT_RUNNING)
