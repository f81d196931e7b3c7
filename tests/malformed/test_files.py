"""Every file that is read, damaged at random: it is read, or refused with one message a mistake."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

import pytest

from rtcp.config import ConfigError, default_config, load
from rtcp.config.loader import load_kinematics
from rtcp.config.motion_file import read_motion
from rtcp.config.segment import load_segment
from rtcp.config.zero import read_zeros, store_zero, zero_file
from rtcp.gateway.limit_settings import _read as read_kept_limits
from rtcp.ipc import session
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.events import ErrorReported, SlaveLost
from rtcp.ipc.layout import EVENTS_AT, EVENTS_HEAD_AT, RECORDS_AT, RECORDS_HEAD_AT
from rtcp.ipc.observer import BlackboardError, Observer
from rtcp.ipc.runtime_directory import blackboard_file
from rtcp.ipc.schema import arm_schema
from rtcp.virtual.faults.registry import load_script
from rtcp.virtual.segment import make_segment
from tests.malformed.files import damaged

SHIPPED = default_config().parent
HANGS_S = 120
"""Time limit of a read, s, far above any machine's; a signal ends a reader that hangs."""
SCRIPT = b"""# A script of faults.
faults:
  - {fault: loss, at: 1.0, rate: 0.1, lasts: 2.0}
  - {fault: cable, at: 2, after: 3, lasts: 1}
  - {fault: drive, at: 3.5, slave: 2, error: encoder}
"""
TRAJECTORY = b"""trajectory:
  - {t: 0.0, q: [0, 0, 0, 0, 0, 0], v: [0, 0, 0, 0, 0, 0]}
  - {t: 2.0, q: [0, 0.3, pi/4, 0, 0.3, 0], v: [0, 0, 0, 0, 0, 0]}
"""
PATH = b"speed: 0.1\npath:\n  - {pose: [-0.5, 0.1, 0.6, 0, 0, 0]}\n  - {q: [0, 0.3, pi/2, 0, 0.3, 0], speed: 0.05}\n"
CSV = b"t,q1,q2,q3,q4,q5,q6\n0,0,0,0,0,0,0\n1.5,0.1,0,0,0,0,-1e-2\n2,0.2,0,0,0,0,0\n"
POSES = b"x,y,z,rx,ry,rz,speed\n-0.5,0.1,0.6,0,0,0,0.1\n-0.5,0.2,0.6,0,0,0,0.2\n"


@pytest.fixture(autouse=True)
def _no_hang() -> Iterator[None]:
    def late(number: int, frame: object) -> None:
        raise AssertionError("a reader hangs")

    before = signal.signal(signal.SIGALRM, late)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def sentences_of(read: Callable[[], object]) -> list[str]:
    """Return the messages of a reader, none if it accepts the file."""
    signal.alarm(HANGS_S)
    try:
        read()
    except ConfigError as error:
        problems = error.problems
    else:
        return []
    finally:
        signal.alarm(0)
    assert problems
    assert all(len(problem) > 10 and "Traceback" not in problem for problem in problems)
    return problems


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("config") / "config"
    shutil.copytree(SHIPPED, made)
    return made


@pytest.mark.parametrize(
    ("name", "turns"),
    [("assistive_arm.yaml", 30), ("devices/cubemars-orh.yaml", 30), ("devices/diewu-io.yaml", 30),
     ("segment.yaml", 60), ("abb_irb120.yaml", 30)],
)  # fmt: skip
def test_a_damaged_configuration_is_reported_in_sentences(folder: Path, name: str, turns: int) -> None:
    random = Random(name)
    file = folder / name
    whole = file.read_bytes()
    refused = 0

    def read() -> object:
        if name == "segment.yaml":
            config = load_segment(file)
            try:
                return make_segment(config, 0)
            except ValueError as error:
                raise ConfigError([str(error)]) from error
        if name == "abb_irb120.yaml":
            return load_kinematics(file)
        return load(folder / "assistive_arm.yaml")

    assert sentences_of(read) == []
    for _ in range(turns):
        file.write_bytes(damaged(whole, random))
        refused += bool(sentences_of(read))
    file.write_bytes(whole)
    assert refused > turns // 3
    assert sentences_of(read) == []


@pytest.mark.parametrize(
    ("name", "content", "read"),
    [("a.yaml", TRAJECTORY, read_motion), ("b.yaml", PATH, read_motion), ("a.csv", CSV, read_motion),
     ("b.csv", POSES, read_motion), ("faults.yaml", SCRIPT, load_script)],
    ids=["trajectory", "path", "trajectory in CSV", "poses in CSV", "script of faults"],
)  # fmt: skip
def test_a_damaged_motion_or_script_is_reported_in_sentences(
    tmp_path: Path, name: str, content: bytes, read: Callable[[Path], object]
) -> None:
    random = Random(name)
    file = tmp_path / name
    file.write_bytes(content)
    assert sentences_of(lambda: read(file)) == []
    refused = 0
    for _ in range(300):
        file.write_bytes(damaged(content, random))
        refused += bool(sentences_of(lambda: read(file)))
    # Some mutants are sound: a comment was hit, or a number changed.
    assert 100 < refused < 300


def test_a_damaged_file_of_zero_offsets_is_reported_in_sentences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTCP_STATE_DIR", str(tmp_path))
    config = load(default_config())
    store_zero(config, 1, 0.25)
    file = zero_file(config.name)
    whole, random = file.read_bytes(), Random(1)
    before = read_zeros(config)
    for _ in range(300):
        content = damaged(whole, random)
        file.write_bytes(content)
        zeros: list[object] = []
        if not sentences_of(lambda: zeros.append(read_zeros(config))):  # noqa: B023
            # Accepted: the values are the same (a comment or white space was hit).
            assert zeros == [before], content


def test_damaged_files_of_process_ids_name_no_process_that_is_not_ours(tmp_path: Path) -> None:
    random = Random(1)
    mine = session.identify(os.getpid())
    session.Processes(mine, mine, session.Pid(0)).write(tmp_path)
    content = session.processes_file(tmp_path).read_bytes()
    for _ in range(500):
        session.processes_file(tmp_path).write_bytes(damaged(content, random))
        processes = session.read_processes(tmp_path)
        for pid in (processes.loop, processes.gateway, processes.segment):
            assert isinstance(pid, session.Pid)
    for text in (b"[" * 100_000, b'{"loop":1e999}', b'{"loop":NaN}', b"\xff", b'{"loop":[],"gateway":0,"segment":0}'):
        session.processes_file(tmp_path).write_bytes(text)
        assert session.read_processes(tmp_path) == session.Processes()


def test_a_damaged_file_of_limits_kept_is_as_none(tmp_path: Path) -> None:
    file = tmp_path / "limits.json"
    for content in (b"", b"{", b"null", b"[]", b"[" * 100_000, b"\xff", b'{"loop": 1}', b'{"loop": 1, "values": 5}',
                    b'{"loop": 1, "values": {"box": 1}}'):  # fmt: skip
        file.write_bytes(content)
        assert read_kept_limits(file, 1) is None


def test_a_damaged_blackboard_is_refused_in_a_sentence_or_read_without_an_exception(tmp_path: Path) -> None:
    random = Random(1)
    path = tmp_path / "board"
    board = Blackboard(path, arm_schema(6), 500_000)
    for number in range(5):
        board.event(SlaveLost(number + 1))
        board.event(ErrorReported("a sentence"))
    board.close()
    whole = path.read_bytes()[:RECORDS_AT]
    size = path.stat().st_size
    refused = 0
    for turn in range(120):
        with open(path, "r+b") as file:
            content = bytearray(whole)
            first = 0 if turn % 2 else 64
            for _ in range(random.choice((1, 4, 60))):
                at = first + random.randrange(len(content) - first - 8)
                at = random.choice((at, RECORDS_HEAD_AT, EVENTS_HEAD_AT, EVENTS_AT))
                content[at : at + 8] = random.choice(
                    (bytes(8), b"\xff" * 8, b"\xff" * 7 + b"\x7f", random.randbytes(8))
                )
            file.write(content)
            file.truncate(size if random.random() < 0.8 else random.randrange(size))
        try:
            observer = Observer(path)
        except BlackboardError as error:
            refused += str(path) in str(error)
        else:
            observer.latest()
            observer.since(0)
            observer.events_since(0)
            observer.slaves(7)
            observer.holder()
            observer.close()
    assert refused > 5


SESSIONS: dict[str, bytes] = {
    "nothing": b"",
    "no JSON": b"hello",
    "no text": b"\xff\xfe",
    "another value": b"[]",
    "too deep": b"[" * 100_000,
    "half": b"",
}


@pytest.mark.parametrize("how", SESSIONS)
def test_a_damaged_session_is_a_sentence_of_the_process_that_reads_it(tmp_path: Path, how: str) -> None:
    file = session.session_file(tmp_path)
    session.Session(load(default_config()), "virtual", "ecat0", 0, time.monotonic_ns()).write(tmp_path)
    assert file.stat().st_mode & 0o077 == 0
    assert session.read_session(tmp_path).bus == "virtual"
    file.write_bytes(file.read_bytes()[:500] if how == "half" else SESSIONS[how])
    with pytest.raises(session.SessionError, match=r"session\.json is damaged: "):
        session.read_session(tmp_path)


def test_a_session_that_others_may_write_is_not_read(tmp_path: Path) -> None:
    file = session.session_file(tmp_path)
    session.Session(load(default_config()), "virtual", "ecat0", 0, time.monotonic_ns()).write(tmp_path)
    file.chmod(0o666)
    with pytest.raises(session.SessionError, match="others may write"):
        session.read_session(tmp_path)


@pytest.mark.parametrize("name", ["session", "started.json", "blackboard"])
def test_a_gateway_that_finds_a_damaged_file_says_so_without_a_traceback(tmp_path: Path, name: str) -> None:
    session.Session(load(default_config()), "virtual", "ecat0", 0, time.monotonic_ns()).write(tmp_path)
    (tmp_path / "started.json").write_text("{}")
    file = blackboard_file(tmp_path)
    Blackboard(file, arm_schema(6), 500_000).close()
    damage = {"blackboard": file, "session": session.session_file(tmp_path)}.get(name, tmp_path / name)
    damage.write_bytes(b"{")
    done = subprocess.run(
        [sys.executable, "-m", "rtcp.gateway.server", "--directory", str(tmp_path), "--ready-fd", "1"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    file.unlink(missing_ok=True)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.startswith("gateway: ")
    assert str(damage) in done.stderr
