"""`python -m tests.sessions.reverted [NAME ...]`: count the sessions until one finds a fix that was taken out.

Each patch takes a fix out of a copy of this tree. In the copy, sessions of an arm (`arm/`) or of a cell of two arms
(`cell/`) run until one does not pass that passes in this tree.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from tests.copied_tree import copy_tree
from tests.sessions.reverted.sessions import configured, run

FOLDER = Path(__file__).parent


class Unreachable(NamedTuple):
    """A fix that no simulated session can find."""

    fix: str
    reason: str
    test: str
    """File and function of the test that fails without the fix."""


UNREACHABLE = (
    Unreachable(
        "stops overtake the queues of the gateway",
        "a session has no sockets: it writes into the blackboard itself",
        "tests/gateway/test_server.py::test_a_stop_overtakes_the_requests_of_a_hundred_clients",
    ),
    Unreachable(
        "stops overtake the command ring",
        "a session waits for each answer, so that its ring has one command at most",
        "tests/ipc/test_stops.py::test_a_stop_overtakes_a_full_ring",
    ),
    Unreachable(
        "STOP of the panel needs no session",
        "a session has no panel",
        "tests/panel/test_access.py::test_stop_needs_no_session_and_commands_do",
    ),
    Unreachable(
        "STOP of the panel needs no file descriptor",
        "a session has no panel",
        "tests/panel/test_access.py::test_a_connection_is_accepted_while_all_file_descriptors_are_used",
    ),
    Unreachable(
        "a wrong plug-in is refused at load",
        "a session begins after the configuration was loaded",
        "tests/control/test_wrong_plugins.py::test_a_plug_in_that_cannot_be_made_is_refused_at_load_with_file_and_line",
    ),
    Unreachable(
        "rtcp cell start brings back an arm whose loop was killed",
        "a session starts no processes",
        "tests/cli/test_cell.py::test_an_arm_whose_loop_was_killed_is_started_again_although_its_gateway_still_listens",
    ),
    Unreachable(
        "an enabling switch that nobody reads counts as released",
        "an IO box that is not read is a fault of its own arm at once; the switch counts for heating in a cell",
        "tests/control/test_emergency_stop.py::test_an_enabling_switch_that_nobody_reads_counts_as_released",
    ),
    Unreachable(
        "limits do not change while drives brake by themselves",
        "the drives of a session have a ramp of their own, which does not follow the limits",
        "tests/control/test_set_limits.py::test_no_limit_changes_while_drives_brake_by_themselves",
    ),
    Unreachable(
        "a torque motion looks ahead",
        "without it the drives stop the arm before the box (`pushed_near`), which is no motion that nobody commanded",
        "tests/control/test_torque_in_boxes.py::test_full_torque_towards_a_box_stops_before_its_margin",
    ),
    Unreachable(
        "a silent partner permits no motion",
        "only heating asks for that, and a session of a cell has arms alone",
        "tests/cell/test_partners.py::test_a_silent_partner_counts_as_pressed_and_permits_no_motion",
    ),
    Unreachable(
        "readers of the blackboard check their copies",
        "in a session reader and writer take turns in one process",
        "tests/ipc/test_record_view.py::test_a_record_that_is_overwritten_while_it_is_read_is_none",
    ),
)


def patches(names: list[str]) -> list[Path]:
    """Return the patches with these names, or all of them."""
    files = {file.stem: file for file in sorted(FOLDER.glob("*/*.patch"))}
    return [files[name] for name in names or files]


def apply(patch: Path, tree: Path) -> None:
    """Apply a patch to a copy of the tree; raises CalledProcessError where it does not fit."""
    subprocess.run(["git", "apply", "-C1", str(patch)], cwd=tree, check=True)


class Found(NamedTuple):
    """How a fault was found."""

    sessions: int
    """Number of sessions until one found it, or 0."""
    report: str
    """What that session reports."""
    before: int
    """Sessions before it that do not pass in this tree either: they find something else."""


def sessions_until_found(patch: Path, seed: int, count: int, fast: bool) -> Found:
    """Run sessions of the changed copy until one does not pass that passes in this tree; `fast`: compile it first."""
    kind, before = patch.parent.name, 0
    config, segment = configured(kind)
    with tempfile.TemporaryDirectory(prefix="rtcp-reverted-") as folder:
        tree = Path(folder) / "tree"
        tree.mkdir()
        copy_tree(tree)
        apply(patch, tree)
        if fast:
            subprocess.run([sys.executable, "hatch_build.py"], cwd=tree, stdout=subprocess.DEVNULL, check=True)
        command = [sys.executable, "-m", "tests.sessions.reverted.sessions", kind, str(seed), str(count)]
        environment = {**os.environ, "PYTHONPATH": str(tree)}
        child = subprocess.Popen(command, cwd=tree, env=environment, stdout=subprocess.PIPE, start_new_session=True)
        assert child.stdout is not None
        with child:
            for line in child.stdout:
                number, report = json.loads(line)
                if run(config, segment, number).outcome == "passed":
                    os.killpg(child.pid, signal.SIGKILL)
                    return Found(number - seed + 1, f"seed {number}: {report}", before)
                before += 1
        if child.returncode:
            raise subprocess.CalledProcessError(child.returncode, command)
    return Found(0, f"in {count} sessions", before)


def main() -> int:
    """Print a row for each patch; return 1 if a fault is not found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="a patch without `.patch`; all of them by default")
    parser.add_argument("--sessions", type=int, default=2000, help="sessions of a patch at most")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first session")
    parser.add_argument("--fast", action="store_true", help="compile each copy; worth its minutes from 200 sessions on")
    options = parser.parse_args()
    missed = 0
    for patch in patches(options.names):
        found, report, before = sessions_until_found(patch, options.seed, options.sessions, options.fast)
        missed += not found
        other = f"; {before} before it fail without the patch too" if before else ""
        print(f"{patch.stem:28}{found or 'not found':>10}  {report}{other}", flush=True)
    if not options.names:
        print("\nout of reach of simulated sessions:")
        for fix in UNREACHABLE:
            print(f"{fix.fix}: {fix.reason}\n    {fix.test}")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
