"""The processes of a platform by identity, its session and the exit report of its loop, as files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config, load
from rtcp.ipc.session import (
    NO_PROCESS,
    Pid,
    Processes,
    Session,
    SessionError,
    exit_problems,
    identify,
    is_running,
    read_processes,
    read_session,
    remove_exit_report,
    session_file,
    terminate,
    write_exit_report,
)


@pytest.fixture
def child() -> Iterator[subprocess.Popen[bytes]]:
    made = subprocess.Popen(["sleep", "600"])
    yield made
    made.kill()
    made.wait()


def test_a_process_is_known_by_its_identity_in_every_other_process(
    tmp_path: Path, child: subprocess.Popen[bytes]
) -> None:
    written = Processes(loop=identify(child.pid))
    written.write(tmp_path)
    program = "import sys; from pathlib import Path; from rtcp.ipc.session import *; " \
        "print(is_running(read_processes(Path(sys.argv[1])).loop))"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
    assert read_processes(tmp_path) == written
    assert read_processes(tmp_path).loop.identity == written.loop.identity


def test_a_full_disk_is_an_error_that_names_the_file(tmp_path: Path) -> None:
    full = tmp_path / "processes.new"
    full.symlink_to("/dev/full")
    with pytest.raises(OSError, match=f"No space left on device: '{full}'"):
        Processes().write(tmp_path)


def test_a_later_process_with_the_same_id_is_not_running_and_not_signalled(child: subprocess.Popen[bytes]) -> None:
    earlier = Pid(child.pid, identify(child.pid).identity + 1)
    assert not is_running(earlier)
    assert terminate(earlier, 0.1)
    assert child.poll() is None
    assert not is_running(NO_PROCESS)
    assert not is_running(child.pid)  # a number without an identity


def test_a_zombie_is_not_running_and_keeps_its_exit_code_for_its_parent(child: subprocess.Popen[bytes]) -> None:
    pid = identify(child.pid)
    assert is_running(pid)
    assert terminate(pid, 10.0)
    assert not is_running(pid)
    assert child.wait() == -signal.SIGTERM
    assert identify(child.pid).identity == 0


def test_a_process_that_ignores_sigterm_is_killed() -> None:
    program = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(600)"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as stubborn:
        assert stubborn.stdout is not None
        stubborn.stdout.readline()
        assert not terminate(identify(stubborn.pid), 0.1)
        assert stubborn.wait() == -signal.SIGKILL


@pytest.fixture
def session(tmp_path: Path) -> Session:
    made = Session(load(default_config()), "virtual", "ecat0", 7, time.monotonic_ns(), tmp_path, tmp_path / "socket")
    made.write(tmp_path)
    return made


def change(directory: Path, **values: Any) -> None:
    file = session_file(directory)
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def test_a_session_is_read_as_it_was_written(tmp_path: Path, session: Session) -> None:
    assert read_session(tmp_path) == session
    assert session_file(tmp_path).stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("version", ["0.0.1", None])
def test_a_session_of_another_version_is_refused(tmp_path: Path, session: Session, version: str | None) -> None:
    change(tmp_path, version=version)
    with pytest.raises(SessionError, match=r"session\.json was written by another version of rtcp"):
        read_session(tmp_path)


@pytest.mark.parametrize("stops", [None, "none"])
def test_a_session_whose_fields_do_not_fit_is_refused_with_the_key(
    tmp_path: Path, session: Session, stops: str | None
) -> None:
    fields = json.loads(session_file(tmp_path).read_text())["session"]
    fields["config"].pop("stops")
    change(tmp_path, session={**fields, "config": fields["config"] | ({"stops": stops} if stops else {})})
    with pytest.raises(SessionError, match=r"session\.json is damaged: .*stops"):
        read_session(tmp_path)


@pytest.mark.parametrize("was_running", [True, False])
def test_the_exit_report_counts_for_the_loop_that_wrote_it_alone(tmp_path: Path, was_running: bool) -> None:
    this = identify(os.getpid())
    write_exit_report(tmp_path, this, ["a slave stayed in OP"])
    assert exit_problems(tmp_path, this, was_running) == ("a slave stayed in OP",)
    other = Pid(this + 1, this.identity)
    (problem,) = exit_problems(tmp_path, other, was_running)
    assert ("was killed" in problem) == was_running
    assert "left to their watchdog" in problem
    remove_exit_report(tmp_path)
    (problem,) = exit_problems(tmp_path, this, was_running)
    assert "does not end, also not by SIGKILL" in problem
    assert exit_problems(tmp_path, NO_PROCESS, was_running) == ()
