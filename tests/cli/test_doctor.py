"""`rtcp doctor`: what it prints, for people and for programs, and how it ends."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.cli import doctor
from rtcp.realtime.host import Host

CPUS = "sys/devices/system/cpu"


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, str]], None]:
    """Let the doctor examine a host of these files alone."""
    root = tmp_path / "host"
    root.mkdir()
    monkeypatch.setattr(doctor, "Host", lambda: Host(root))

    def put(files: dict[str, str]) -> None:
        for name, text in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text)

    return put


@pytest.fixture
def on_cpu_0(arm: Path) -> Path:
    """An arm's file that has its cycle on CPU 0 and the drives on eth5."""
    text = arm.read_text()
    assert "\ncycle:" in text
    assert "interface: virtual" in text
    arm.write_text(text.replace("\ncycle:", "\ncycle:\n  cpu: 0", 1).replace("interface: virtual", "interface: eth5"))
    return arm


def severities(answer: dict[str, Any]) -> list[str]:
    return [finding["severity"] for finding in answer["findings"]]


@pytest.mark.parametrize(
    ("runtime_us", "code", "sentence"),
    [
        ("-1", 0, "no obstacle to real time was found"),
        ("950000", 0, "no obstacle to real time was found"),
        ("500000", 3, "cycles will be late at times"),
        ("0", 5, "the loop cannot keep its cycle here"),
    ],
)
def test_the_worst_finding_decides_the_exit_code(
    rtcp: Callable[..., Any], host: Callable[..., None], runtime_us: str, code: int, sentence: str
) -> None:
    kernel = "proc/sys/kernel/sched_rt_"
    host({f"{kernel}runtime_us": runtime_us, f"{kernel}period_us": "1000000"})
    ended = rtcp("doctor", "--bus", "virtual")
    assert (ended.code, ended.err) == (code, "")
    assert sentence in " ".join(ended.out.split())


def test_the_worst_finding_comes_first_in_json(rtcp: Callable[..., Any], host: Callable[..., None]) -> None:
    host({"proc/sys/kernel/sched_rt_runtime_us": "0", "proc/sys/kernel/sched_rt_period_us": "1000000"})
    host({f"{CPUS}/online": "0", f"{CPUS}/isolated": ""})
    answer = json.loads(rtcp("doctor", "--bus", "virtual", "--json").out)
    assert severities(answer) == sorted(severities(answer), key=["bad", "warning", "note", "ok"].index)


def test_json_shows_the_worst_severity_and_each_finding_whole(
    rtcp: Callable[..., Any], host: Callable[..., None]
) -> None:
    host({"proc/sys/kernel/sched_rt_runtime_us": "500000", "proc/sys/kernel/sched_rt_period_us": "1000000"})
    answer = json.loads(rtcp("doctor", "--json").out)
    assert answer["severity"] == "warning"
    assert answer["findings"][0] == {
        "key": "rt-throttling",
        "severity": "warning",
        "found": "real-time threads may have 500 of every 1000 ms of a CPU",
        "why": "a real-time thread that has used its share waits until the period is over",
        "remedy": [
            "sysctl -w kernel.sched_rt_runtime_us=950000",
            "echo 'kernel.sched_rt_runtime_us=950000' >> /etc/sysctl.d/90-rtcp.conf   # kept after a restart",
        ],
    }


def test_bus_and_cpu_are_the_configurations(
    rtcp: Callable[..., Any], host: Callable[..., None], on_cpu_0: Path
) -> None:
    answer = json.loads(rtcp("doctor", "--config", str(on_cpu_0), "--json").out)
    assert (answer["cpu"], answer["bus"]) == (0, "eth5")


def test_the_bus_of_the_command_line_goes_before_the_configurations(
    rtcp: Callable[..., Any], host: Callable[..., None], on_cpu_0: Path
) -> None:
    answer = json.loads(rtcp("doctor", "--config", str(on_cpu_0), "--bus", "virtual", "--json").out)
    assert answer["bus"] == "virtual"


@pytest.mark.parametrize("name", ["../eth0", "", "..", "an interface", "a-name-of-16-let"])
def test_what_can_be_no_interface_is_a_mistake_on_the_command_line(rtcp: Callable[..., Any], name: str) -> None:
    ended = rtcp("doctor", "--bus", name)
    assert (ended.code, ended.out) == (2, "")
    assert f"{name!r} is not the name of a network interface" in ended.trouble


def test_in_a_pipe_the_table_fits_80_columns(rtcp: Callable[..., Any], host: Callable[..., None]) -> None:
    host({f"{CPUS}/online": "0-1", f"{CPUS}/isolated": ""})
    table = rtcp("doctor").out.split("To fix, as root")[0]
    assert max(map(len, table.splitlines())) == 80


def test_a_command_that_mends_stands_on_one_line_however_long(
    rtcp: Callable[..., Any], host: Callable[..., None], on_cpu_0: Path
) -> None:
    host({f"{CPUS}/online": "0-1", f"{CPUS}/isolated": "", "etc/default/grub": ""})
    ended = rtcp("doctor", "--config", str(on_cpu_0))
    words = "isolcpus=managed_irq,domain,0 nohz_full=0 rcu_nocbs=0 irqaffinity=1"
    assert (
        f"    sed -i 's/^GRUB_CMDLINE_LINUX=\"/&{words} /' /etc/default/grub && update-grub   # then reboot"
        in ended.out.splitlines()
    )


def test_this_machine_is_examined_by_a_process_of_its_own() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "rtcp.cli", "doctor", "--bus", "lo", "--json"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (ended.returncode in (0, 3, 5), ended.stderr) == (True, "")
    assert json.loads(ended.stdout)["bus"] == "lo"


def test_help_shows_the_exit_codes(rtcp: Callable[..., Any]) -> None:
    assert "5 the loop cannot keep its cycle" in " ".join(rtcp("doctor", "--help").out.split())
