"""The segment as a process: a real master over a real cable, namespaces, signals, refusals."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from rtcp.virtual.server import SO_TIMESTAMPNS, TIMESPEC, arrival
from tests.forked import answer_of
from tests.waiting import until

ROOT = Path(__file__).parents[2]
CHILD = Path(__file__).with_name("soem_child.py")
RAW_CHILD = Path(__file__).with_name("frames_child.py")
FACTS = [0, 820, 1660, 2500, 3320, 4160, 5020]
NOBODY = 65534


def runs_as_nobody() -> bool:
    """Whether root may start this interpreter as nobody, who may be barred from the folder that it is in."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", "import rtcp"], user=NOBODY, group=NOBODY, extra_groups=[], cwd=ROOT, check=False
        )
    except PermissionError:
        return False
    return done.returncode == 0


needs_nobody = pytest.mark.skipif(os.getuid() == 0 and not runs_as_nobody(), reason="nobody cannot start this Python")
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root may leave an interface in the caller's network")

Segment = tuple["subprocess.Popen[str]", dict[str, Any]]


@pytest.fixture
def name() -> str:
    """The name of an interface, of this process's own."""
    return f"rt{os.getpid()}"


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "segment.yaml"
    models = ["diewu-io", *["cubemars-orh70"] * 6]
    drifts = [3.0, -12.0, 17.5, -20.0, 8.0, -5.5, 20.0]
    lines = [f"  - {{model: {model}, drift_ppm: {drift}}}" for model, drift in zip(models, drifts, strict=True)]
    path.write_text("slaves:\n" + "\n".join(lines) + "\n", encoding="utf-8")
    for folder in (tmp_path, *tmp_path.parents[:2]):
        folder.chmod(folder.stat().st_mode | 0o055)
    return path


def start(config: Path, *options: str, user: int | None = None, module: str = "rtcp.virtual") -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", module, "--config", str(config), *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT, user=user, group=user,
        extra_groups=None if user is None else [],
    )  # fmt: skip


@contextmanager
def running(config: Path, *options: str, **more: Any) -> Iterator[Segment]:
    segment = start(config, *options, **more)
    try:
        line = segment.stdout.readline()
        assert line, segment.communicate()[1]
        yield segment, json.loads(line)
    finally:
        segment.kill()
        segment.communicate()


def master(pid: str, interface: str, cycles: int, *more: str, user: int | None = None) -> dict[str, Any]:
    if user is None:
        return answer_of("tests.virtual.soem_child", pid, interface, str(cycles), *more)
    done = subprocess.run(
        [sys.executable, str(CHILD), pid, interface, str(cycles), *more],
        stdout=subprocess.PIPE, text=True, check=True, user=user, group=user, extra_groups=[],
    )  # fmt: skip
    result: dict[str, Any] = json.loads(done.stdout)
    return result


def interfaces() -> set[str]:
    return {name for _, name in socket.if_nameindex()}


def wait_until_gone(name: str) -> None:
    until(lambda: name not in interfaces(), "the interface is gone")


def assert_all_in_op(result: dict[str, Any]) -> None:
    assert result["slaves"] == 7
    assert result["delays"] == FACTS
    assert result["safe_op"] == 4
    assert result["sizes"] == [[2, 6], *[[15, 15]] * 6]
    assert (result["state"], result["codes"]) == (8, [0] * 7)
    assert result["expected"] == 21
    # -1: the host delayed the frame beyond the master's timeout.
    assert {*result["counters"]} <= {21, -1}
    assert 21 in result["counters"]
    assert result["init"] == 1


def test_a_real_master_brings_seven_slaves_to_op_with_their_delays_and_a_full_working_counter(config: Path) -> None:
    with running(config) as (segment, ready):
        assert ready == {"pid": segment.pid, "interface": "ecat0", "namespace": True, "slaves": 7}
        result = master(str(segment.pid), "ecat0", 300)
    assert_all_in_op(result)
    assert max(result["differences"][1:]) < 5000


def test_a_segment_that_polls_answers_too(config: Path) -> None:
    with running(config, "--poll", "--cpu", str(max(os.sched_getaffinity(0)))) as (segment, _):
        assert_all_in_op(master(str(segment.pid), "ecat0", 100))


def test_a_model_of_another_package_serves_files_over_foe(tmp_path: Path) -> None:
    config = tmp_path / "files.yaml"
    config.write_text("slaves:\n  - model: tests.virtual.file_models:FileServer\n", encoding="utf-8")
    with running(config) as (segment, _):
        child = [sys.executable, "-m", "tests.virtual.foe_child", str(segment.pid), "ecat0"]
        files = json.loads(subprocess.run(child, stdout=subprocess.PIPE, text=True, check=True, cwd=ROOT).stdout)
    assert files["firmware"] == (bytes(range(256)) * 2).hex()
    assert files["settings"] == files["written"]


@pytest.mark.skipif(os.getuid() != 0, reason="an ordinary user runs every test of this file this way")
@needs_nobody
def test_an_ordinary_user_gets_the_same_from_user_namespaces(config: Path) -> None:
    with running(config, user=NOBODY) as (segment, _):
        assert_all_in_op(master(str(segment.pid), "ecat0", 100, user=NOBODY))


@pytest.mark.timing
def test_slaves_stay_in_op_when_the_process_is_stopped_for_50_ms(config: Path) -> None:
    with running(config) as (segment, _):
        result = master(str(segment.pid), "ecat0", 150, str(segment.pid))
    assert (result["state"], result["codes"]) == (8, [0] * 7)
    assert -1 in result["counters"][:20]
    assert 21 in result["counters"][-50:]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_process_with_code_0(config: Path, number: signal.Signals) -> None:
    with running(config) as (segment, _):
        segment.send_signal(number)
        assert segment.communicate()[1] == ""
        assert segment.returncode == 0


def test_the_cable_is_not_seen_in_the_callers_network(config: Path) -> None:
    with running(config) as (_, ready):
        assert ready["interface"] not in interfaces()


@needs_root
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_with_interface_the_masters_end_is_here_under_its_name_until_the_process_ends(
    config: Path, number: signal.Signals, name: str
) -> None:
    with running(config, "--interface", name) as (segment, ready):
        assert ready == {"pid": segment.pid, "interface": name, "namespace": False, "slaves": 7}
        assert name in interfaces()
        assert_all_in_op(master("-", name, 50))
        segment.send_signal(number)
        segment.wait()
        wait_until_gone(name)


@needs_root
def test_a_cable_that_is_removed_ends_the_process_with_a_sentence(config: Path, name: str) -> None:
    from pyroute2 import IPRoute

    with running(config, "--interface", name) as (segment, _):
        with IPRoute() as links:
            links.link("del", index=socket.if_nametoindex(name))
        _, stderr = segment.communicate()
        assert segment.returncode == 2
        assert stderr == f"the cable at {name} is gone (Network is down): was it removed?\n"


@needs_root
def test_an_interface_that_exists_is_refused_and_left_alone(config: Path, name: str) -> None:
    with running(config, "--interface", name) as (first, _):
        second = start(config, "--interface", name)
        _, stderr = second.communicate()
        assert second.returncode == 2
        assert stderr == (
            f"--interface {name} exists already: choose another name, or remove it with 'ip link del'\n"
        )  # fmt: skip
        assert name in interfaces()
        first.terminate()
        first.wait()
        wait_until_gone(name)


# A user namespace that allows no further ones; the program in it has lost its rights by exec.
WITHOUT_NAMESPACES = """
import ctypes, os, sys
uid, gid = os.getuid(), os.getgid()
assert ctypes.CDLL(None).unshare(0x10000000) == 0
for path, text in (("/proc/self/setgroups", "deny"), ("/proc/self/uid_map", f"{uid} {uid} 1"),
                   ("/proc/self/gid_map", f"{gid} {gid} 1"), ("/proc/sys/user/max_user_namespaces", "0"),
                   ("/proc/sys/user/max_net_namespaces", "0")):
    with open(path, "w") as file:
        file.write(text)
os.execv(sys.executable, [sys.executable, "-m", "rtcp.virtual", *sys.argv[1:]])
"""


@needs_nobody
def test_where_namespaces_are_forbidden_one_sentence_says_what_to_allow(config: Path) -> None:
    user = NOBODY if os.getuid() == 0 else None
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_NAMESPACES, "--config", str(config)], capture_output=True, text=True, cwd=ROOT,
        user=user, group=user, extra_groups=None if user is None else [], check=False,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (2, "")
    assert "the system refuses a network namespace of this process's own" in done.stderr
    assert "user.max_user_namespaces" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "options", "expected"),
    [
        ("slaves:\n  - {model: toaster}\n", [], "toaster"),
        ("slaves:\n  - {model: diewu-io, delay_ns: 900}\n  - {model: diewu-io, delay_ns: 800}\n", [],
         "found 800 ns, allowed is at least the 900 ns of the slave before it"),
        ("slaves:\n  - {model: diewu-io}\n", ["--interface", "a/b"], "'a/b' is no interface name"),
        ("slaves:\n  - {model: diewu-io}\n", ["--cpu", "9999"], "--cpu 9999 cannot be used"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_a_sentence_with_code_2(
    tmp_path: Path, text: str, options: list[str], expected: str
) -> None:
    path = tmp_path / "segment.yaml"
    path.write_text(text, encoding="utf-8")
    segment = start(path, *options)
    out, stderr = segment.communicate()
    assert (segment.returncode, out) == (2, "")
    assert expected in stderr
    assert "Traceback" not in stderr
    assert stderr.count("\n") == 1


def raw_master(segment: dict[str, Any], frames: int, period_us: int, *more: str) -> dict[str, Any]:
    command = [sys.executable, str(RAW_CHILD), str(segment["pid"]), str(segment["interface"]), str(frames)]
    done = subprocess.run([*command, str(period_us), *more], stdout=subprocess.PIPE, text=True, check=True)
    result: dict[str, Any] = json.loads(done.stdout)
    return result


@pytest.mark.timing
@pytest.mark.parametrize(("options", "period_us"), [((), 0), (("--poll",), 1000)])
def test_under_sched_fifo_the_segment_leaves_the_kernel_its_share_of_the_cpu(
    config: Path, options: tuple[str, ...], period_us: int
) -> None:
    with running(config, *options) as (_, facts):
        if os.sched_getscheduler(facts["pid"]) != os.SCHED_FIFO:
            pytest.skip("no right to SCHED_FIFO")
        result = raw_master(facts, 2000 if period_us else 10_000, period_us)
    assert result["cpu_share"] < 0.945, "the kernel throttles SCHED_FIFO above 95 % (sched_rt_runtime_us)"
    assert result["counters"] == [7]


@pytest.mark.long("test_a_frame_with_a_vlan_tag_is_answered_with_its_tag")
@pytest.mark.parametrize(("options", "frames", "period_us"), [((), 100_000, 0), (("--poll",), 20_000, 1000)])
def test_no_frame_is_lost_back_to_back_nor_while_polling(
    config: Path, options: tuple[str, ...], frames: int, period_us: int
) -> None:
    with running(config, *options) as (_, facts):
        assert raw_master(facts, frames, period_us)["lost"] == 0


def test_a_frame_arrives_by_the_kernels_stamp_and_never_before_the_frame_before_it() -> None:
    before = time.monotonic_ns()
    stamp = TIMESPEC.pack(*divmod(time.time_ns() - 5_000_000, 1_000_000_000))
    ancillary = [(socket.SOL_SOCKET, SO_TIMESTAMPNS, stamp)]
    now = time.monotonic_ns()
    assert arrival(ancillary, now) == now
    assert 0 < arrival(ancillary, 0) < before


def test_a_frame_with_a_vlan_tag_is_answered_with_its_tag(config: Path) -> None:
    with running(config, module="tests.virtual.patient_segment") as (_, facts):
        result = raw_master(facts, 5, 2000, "5")
    assert (result["lost"], result["counters"], result["tags"]) == (0, [7], [5])


@needs_root
def test_an_interface_that_is_up_is_answered(config: Path, name: str) -> None:
    segment = start(config, "--interface", name, module="tests.virtual.patient_segment")
    try:
        flags = Path(f"/sys/class/net/{name}/flags")
        until(lambda: flags.exists() and int(flags.read_text(), 16) & 1, "the interface is up")
        done = subprocess.run(
            [sys.executable, str(RAW_CHILD), str(os.getpid()), name, "1", "0"], stdout=subprocess.PIPE, check=True
        )
        assert json.loads(done.stdout)["lost"] == 0
    finally:
        segment.kill()
        segment.communicate()
