"""The machine's table for docs/machine.md, which `python docs/generate.py` writes.

A diagram (Mermaid, which the usual viewers of Markdown draw) and three tables, all from `rtcp.ipc.machine`.
"""

from __future__ import annotations

from rtcp.ipc.machine import TABLE, WITHOUT_LEASE, Command, Event, Refusal, State

_EVERYWHERE = (Event.BROKEN, Event.EMERGENCY, Event.SHUTDOWN)
"""Events that lead out of nearly every state: told in the table, left out of the picture."""


def words(member: State | Event | Command | Refusal) -> str:
    """Return a member's name in small letters, words apart."""
    return member.name.lower().replace("_", " ")


def diagram() -> str:
    """Return the Mermaid diagram of states and events."""
    lines = ["stateDiagram-v2", "    [*] --> OFF"]
    for state, row in TABLE.items():
        lines.append(f"    {state.name} : {row.words}")
        for event, target in row.left_by.items():
            if event not in _EVERYWHERE and target is not state:
                lines.append(f"    {state.name} --> {target.name} : {words(event)}")
    return "\n".join(lines)


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)


def states() -> str:
    """Return the table of states: what is commanded, how each is left."""
    rows = []
    for row in TABLE.values():
        left = "; ".join(f"{words(event)}: {TABLE[target].words}" for event, target in row.left_by.items())
        rows.append([row.words, row.commands, left])
    return _table(["state", "what the drives are commanded", "left by"], rows)


def commands() -> str:
    """Return the table of commands: in which states each is taken, and whether the lease is needed."""
    rows = []
    for command in Command:
        taken = ", ".join(row.words for row in TABLE.values() if command in row.takes)
        rows.append([f"`{words(command)}`", "anyone" if command in WITHOUT_LEASE else "the lease's holder", taken])
    return _table(["command", "who may ask", "in the states"], rows)


def page() -> str:
    """Return the whole page."""
    return f"""# The machine's state

Made from the table in `rtcp/ipc/machine.py` by `python docs/generate.py`; a test holds both together. Left out of the
picture: `broken` leads to fault, `emergency` to emergency stop and `shutdown` to closing, from nearly everywhere.

```mermaid
{diagram()}
```

## States

{states()}

## Commands

{commands()}
"""
