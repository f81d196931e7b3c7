"""The tables of `rtcp soak`."""

from __future__ import annotations

from rich.table import Table

from rtcp.telemetry.trials.soak import Account, Summary


def tables(summary: Summary) -> tuple[Table, Table]:
    """Return the account of the faults and that of the processes."""
    return _faults(summary), _processes(summary)


def _faults(summary: Summary) -> Table:
    table = Table(title=f"{summary.minutes:.1f} min, seed {summary.seed}", title_justify="left")
    table.add_column("fault")
    for name in ("injected", "noticed", "went on", "stopped", "recovered"):
        table.add_column(name, justify="right")
    whole = Account()
    for kind, account in sorted(summary.accounts.items()):
        table.add_row(kind, *_numbers(account))
        for name in ("injected", "went_on", "stopped", "noticed", "recovered"):
            setattr(whole, name, getattr(whole, name) + getattr(account, name))
    table.add_section()
    table.add_row("all", *_numbers(whole))
    return table


def _numbers(account: Account) -> list[str]:
    counts = (account.injected, account.noticed, account.went_on, account.stopped, account.recovered)
    return [str(count) for count in counts]


def _processes(summary: Summary) -> Table:
    table = Table(
        title=f"{summary.records} cycles, {summary.torn} records torn or lost, "
        f"largest step of a target {summary.largest_step:.3f} of what is allowed",
        title_justify="left",
    )
    table.add_column("process")
    for name in ("RSS, MiB", "threads", "open files"):
        table.add_column(name, justify="right")
    for name, last in summary.last.items():
        first = summary.first.get(name, last)
        table.add_row(
            name,
            f"{first.rss / 2**20:.1f} -> {last.rss / 2**20:.1f}",
            f"{first.threads} -> {last.threads}",
            f"{first.files} -> {last.files}",
        )
    return table
