"""The command `rtcp`: one file a group of commands; `main` is the entry point."""

from rtcp.cli.app import main

__all__ = ["main"]
