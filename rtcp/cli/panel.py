"""`rtcp panel`: the arm in a browser."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Annotated

import typer

from rtcp.cli.arguments import option
from rtcp.cli.output import CommandError, report

commands = typer.Typer()
panel = typer.Typer(
    name="panel", help="Show and operate the arm in a browser, until Ctrl-C.", invoke_without_command=True
)
commands.add_typer(panel)


@panel.callback()
def _panel(
    context: typer.Context,
    host: Annotated[
        str, option("--host", "ADDRESS", "Address to listen at; another than this machine's own needs a password.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: a free one.")] = 8080,
    open_browser: Annotated[bool, option("--open", "Open it in a browser here.")] = False,
    certificate: Annotated[Path | None, option("--certificate", "FILE", "TLS certificate, PEM.")] = None,
    key: Annotated[Path | None, option("--key", "FILE", "Its key, PEM. Default: in the certificate's file.")] = None,
) -> None:
    """Show and operate the arm in a browser, until Ctrl-C."""
    if context.invoked_subcommand is not None:
        return
    require_panel()
    from rtcp.panel.server import PanelOptions, serve

    for name, file in (("--certificate", certificate), ("--key", key)):
        if file is not None and not file.is_file():
            raise CommandError(f"{name} {file} is no file")
    serve(PanelOptions(host, port, open_browser, certificate, key), lambda url: report(f"{url}: Ctrl-C ends the panel"))


@panel.command("password")
def _password(
    role: Annotated[
        str,
        option(
            "--role", "operator|viewer", "Who gets in with it: an operator, or a viewer, who may only look and stop."
        ),
    ] = "operator",
) -> None:
    """Set the password of a role, asked for at the terminal, else the first line of standard input; kept as a hash."""
    from rtcp.panel.access import ROLES, password_file, set_password

    if role not in ROLES:
        raise CommandError(f"--role {role} is not known: {', '.join(ROLES)}")
    if sys.stdin.isatty():
        password = typer.prompt(f"Password of the {role}s", hide_input=True, confirmation_prompt=True)
    else:
        password = sys.stdin.readline().rstrip("\n")
    set_password(password_file(), role, password)
    report(f"kept in {password_file()}; a panel that runs takes it at its next start")


def require_panel() -> None:
    """Raise CommandError where the panel's packages are not installed."""
    if importlib.util.find_spec("nicegui") is None:
        raise CommandError("the panel is not installed: `make panel`, or `pip install 'rtcp[panel]'`")
