"""Three hosts as folders of files, and the findings of each check of the doctor."""

from __future__ import annotations

import ctypes
import fcntl
import os
import re
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kinematics.compiled import Build
from rtcp.ipc.blackboard import Blackboard
from rtcp.ipc.schema import arm_schema
from rtcp.realtime.doctor import CHECKS, Case, Severity, examine
from rtcp.realtime.host import Coalescing, Host, NotKnown, format_cpus, parse_cpus
from tests.realtime.conftest import LIMITS, STATUS

OK, NOTE, WARNING, BAD = Severity
CPUS = "sys/devices/system/cpu"
CPU3 = f"{CPUS}/cpu3"
CLOCK = "sys/devices/system/clocksource/clocksource0"
ETH0 = "sys/class/net/eth0"
DEVICE = "sys/devices/pci/0000:01:00.0"
ZONE, ZONE1 = "sys/class/thermal/thermal_zone0", "sys/class/thermal/thermal_zone1"
RUNTIME = "proc/sys/kernel/sched_rt_runtime_us"
GOVERNOR = f"{CPU3}/cpufreq/scaling_governor"
GRUB = "etc/default/grub"
THREAD = "417 (irq/130-eth0-Tx) S 2" + " 0" * 34 + " 3 {} 0 0"
"""proc/417/stat with its priority and policy."""
PACKET = "sk RefCnt Type Proto Iface R Rmem User Inode\nffff 3 3 88a4 {} 1 0 0 1234"
WORDS = "isolcpus=managed_irq,domain,3 nohz_full=3 rcu_nocbs=3 irqaffinity=0-2"
R38 = "# R38 (release), REVISION: 4.0"
BUILD = "# build a kernel with PREEMPT_RT from its sources: docs/realtime_kernel.md"
VIRTUAL: dict[str, object] = {"interface": None}

Files = dict[str, str | None]

# check, host, files written before (None: removed), severity, part of the finding, part of the remedy
ROWS: list[tuple[str, str, Files, Severity, str, str]] = [
    ("preempt-rt", "good", {"proc/version": None}, NOTE, "not known: /proc/version: No such file or directory", ""),
    ("preempt-rt", "good", {"sys/kernel/realtime": None, "proc/version": "Linux version 5 (gcc) #1 SMP PREEMPT RT Tue"},
     OK, "PREEMPT_RT, Linux 5", ""),
    ("preempt-rt", "laptop", {}, WARNING, "Linux 6.8.0-45-generic is not a PREEMPT_RT kernel (PREEMPT_DYNAMIC)",
     "pro enable"),
    ("preempt-rt", "laptop", {"etc/os-release": "ID=debian"}, WARNING, "",
     "linux-image-rt-$(dpkg --print-architecture)"),
    ("preempt-rt", "laptop", {"etc/os-release": None}, WARNING, "", "install the distribution's kernel"),
    *(("preempt-rt", "laptop", {"etc/os-release": f'ID=ubuntu\nVERSION_ID="{version}"'}, WARNING, "", remedy)
      for version, remedy in (("18.04", BUILD), ("20.04", BUILD), ("22.04", "pro enable realtime-kernel"),
                              ("25.04", BUILD), ("26.04", "apt install linux-realtime "))),
    ("preempt-rt", "jetson", {}, WARNING, "", "jetson/rt-kernel r36.4 main"),
    ("preempt-rt", "jetson", {"etc/nv_tegra_release": R38}, WARNING, "", "nvidia-l4t-rt-kernel-nvgpu"),
    ("preempt-rt", "jetson", {"etc/nv_tegra_release": R38, "proc/device-tree/model": "NVIDIA Jetson AGX Thor\0"},
     WARNING, "", "nvidia-l4t-rt-kernel-openrm"),
    ("preempt-rt", "jetson", {"etc/nv_tegra_release": "# unknown"}, WARNING, "", BUILD),
    ("rt-throttling", "good", {RUNTIME: "-1"}, OK, "not throttled", ""),
    ("rt-throttling", "good", {RUNTIME: "950000"}, OK, "950 of every 1000 ms", ""),
    ("rt-throttling", "good", {RUNTIME: "500000"}, WARNING, "500 of every 1000 ms",
     "sysctl -w kernel.sched_rt_runtime_us=950000\n"
     "echo 'kernel.sched_rt_runtime_us=950000' >> /etc/sysctl.d/90-rtcp.conf   # kept after a restart"),
    ("rt-throttling", "good", {RUNTIME: "0"}, BAD, "", "sysctl"),
    ("rt-throttling", "good", {RUNTIME: "95o000"}, NOTE,
     f"not known: /{RUNTIME} holds '95o000', not a number", ""),
    ("clock-source", "laptop", {}, WARNING, "from hpet although tsc", f"echo tsc > /{CLOCK}/current_clocksource"),
    ("clock-source", "laptop", {f"{CLOCK}/available_clocksource": "hpet"}, WARNING, "unstable", "tsc=reliable"),
    ("clock-source", "laptop", {f"{CLOCK}/available_clocksource": "hpet", "proc/cpuinfo": None}, WARNING,
     "offers no faster one", ""),
    ("clock-source", "laptop", {f"{CLOCK}/current_clocksource": "kvm-clock", f"{CLOCK}/available_clocksource": "x"},
     NOTE, "kvm-clock", ""),
    ("hypervisor", "good", {"proc/cpuinfo": "flags : fpu tsc hypervisor"}, WARNING, "virtual machine", "pin each"),
    ("hypervisor", "good", {"proc/stat": "cpu 100 0 100 700 0 0 0 100 0 0"}, WARNING, "10 % of all CPU time", "pin"),
    ("hypervisor", "good", {"proc/stat": "cpu 1"}, NOTE, "does not begin with the times of all CPUs", ""),
    ("isolated-cpu", "good", {f"{CPUS}/online": "0-2"}, BAD, "CPU 3, and this host has CPUs 0-2", "cpu: 2"),
    ("isolated-cpu", "good", {f"{CPUS}/isolated": "1"}, WARNING, "isolated is CPU 1, and the cycle is to run on CPU 3",
     "# in the arm's file: cycle: {cpu: 1}"),
    ("isolated-cpu", "good", {f"{CPUS}/online": "3", f"{CPUS}/isolated": ""}, WARNING, "this host has one CPU", ""),
    ("isolated-cpu", "good", {f"{CPUS}/isolated": ""}, WARNING, "no CPU is isolated",
     f"sed -i 's/^GRUB_CMDLINE_LINUX=\"/&{WORDS} /' /{GRUB} && update-grub   # then reboot"),
    ("isolated-cpu", "good", {f"{CPUS}/isolated": "", GRUB: None, "boot/firmware/cmdline.txt": ""}, WARNING, "",
     f"sed -i '1s/$/ {WORDS}/' /boot/firmware/cmdline.txt   # then reboot"),
    ("isolated-cpu", "jetson", {}, WARNING, "", f"sed -i '/^ *APPEND /s/$/ {WORDS}/' /boot/extlinux/extlinux.conf"),
    ("isolated-cpu", "good", {f"{CPUS}/isolated": "", GRUB: None}, WARNING, "", f"command line: {WORDS}"),
    ("cpu-permitted", "laptop", {}, WARNING, "may use CPUs 0-2, not CPU 3", "taskset -c 0-3 rtcp start"),
    ("cpu-permitted", "laptop", {"proc/self/status": STATUS.format(capabilities=0, cpus="x")}, NOTE, "no list", ""),
    ("cpu-permitted", "laptop", {"proc/self/status": "CapEff: 0"}, NOTE, "names no CPU", ""),
    ("cpu-permitted", "laptop", {"proc/self/status": STATUS.format(capabilities=0, cpus="3")}, OK, "may use CPU 3", ""),
    ("tick", "good", {f"{CPUS}/nohz_full": "1-2"}, NOTE, "the scheduler's tick; without it is CPUs 1-2", "nohz_full=3"),
    ("tick", "jetson", {}, NOTE, "without it is no CPU", ""),
    ("tick", "laptop", {}, NOTE, "built without CONFIG_NO_HZ_FULL", ""),
    ("governor", "laptop", {}, WARNING, "CPU 3 is governed by powersave, 800 to 3600 MHz",
     f"echo performance > /{GOVERNOR}\necho 'w /{GOVERNOR} - - - - performance' >> /etc/tmpfiles.d/rtcp-host.conf"),
    ("governor", "laptop", {f"{CPU3}/cpufreq/scaling_max_freq": None}, WARNING, "is governed by powersave", "echo"),
    ("idle-states", "good", {}, OK, "C6 133 us", ""),
    ("idle-states", "laptop", {}, WARNING, "cannot forbid it: /dev/cpu_dma_latency: No such file",
     "'z /dev/cpu_dma_latency 0660 root rtcp -'"),
    ("idle-states", "laptop", {f"{CPU3}/cpuidle/state1/disable": "1"}, OK, "from every idle state within 10 us", ""),
    ("smt", "laptop", {}, WARNING, "CPU 3 shares its core with CPU 1 (SMT)", "nosmt"),
    ("other-interrupts", "laptop", {}, WARNING, "CPU 3 takes the interrupts 9 (acpi)",
     "for n in 9; do echo 0-2 > /proc/irq/$n/smp_affinity_list; done"),
    ("other-interrupts", "laptop", {f"{CPUS}/isolated": "3"}, WARNING, "", "irqaffinity=0-2"),
    ("other-interrupts", "laptop", {"proc/irq/9/effective_affinity_list": "1"}, OK, "", ""),
    ("other-interrupts", "laptop", {"proc/irq/9/effective_affinity_list": None, "proc/irq/9/smp_affinity_list": "3"},
     WARNING, "9 (acpi)", "for n in 9"),
    ("other-interrupts", "good", {"proc/irq/9/effective_affinity_list": "3"}, OK, "no device interrupts CPU 3", ""),
    ("other-interrupts", "good", {f"{CPUS}/online": "3"}, NOTE, "this host has one CPU", ""),
    ("other-interrupts", "good", {"proc/interrupts": "CPU0 CPU1\n"}, NOTE, "has no column of CPU 3", ""),
    ("irqbalance", "laptop", {}, WARNING, "", "systemctl disable --now irqbalance"),
    ("irqbalance", "good", {"proc/800/comm": "irqbalance"}, OK, "leaves isolated CPUs alone", ""),
    ("card-interrupt", "good", {"proc/417/stat": THREAD.format("81 1")}, OK, "by threads that outrank the loop", ""),
    ("card-interrupt", "good", {"proc/417/stat": THREAD.format("80 1")}, BAD, "priority 80 and the loop 80", ""),
    ("card-interrupt", "good", {"proc/417/stat": THREAD.format("99 0")}, BAD, "", "chrt -f -p 90 417"),
    ("card-interrupt", "good", {"proc/417/stat": "417 (irq) S 2"}, NOTE, "has no scheduling policy", ""),
    ("card-interrupt", "good", {"proc/417/comm": None}, OK, "handled at once", ""),
    ("card-interrupt", "laptop", {"proc/irq/130/effective_affinity_list": "2"}, OK, "not on CPU 3 of the cycle", ""),
    ("interface", "good", {f"{ETH0}/operstate": "down", f"{ETH0}/flags": "0x1002"}, BAD, "", "ip link set eth0 up"),
    ("interface", "good", {f"{ETH0}/operstate": "down", f"{ETH0}/carrier": "0"}, BAD, "eth0 has no link", ""),
    ("interface", "good", {f"{ETH0}/speed": "10"}, BAD, "", "ethtool -s eth0 speed 100"),
    ("interface", "good", {f"{ETH0}/duplex": "half"}, BAD, "", "ethtool"),
    ("interface", "good", {f"{ETH0}/speed": "-1"}, NOTE, "tells no speed", ""),
    ("driver", "good", {f"{ETH0}/device": None}, NOTE, "no hardware", ""),
    ("driver", "good", {f"{ETH0}/wireless/x": ""}, BAD, "wireless", "rtcp doctor --bus NAME"),
    ("driver", "laptop", {}, BAD, "eth0 is an adapter at a USB port (driver r8152)", "i210"),
    ("driver", "jetson", {}, NOTE, "nvethernet", ""),
    *(("driver", "good", {f"{DEVICE}/driver": "->sys/bus/pci/drivers/e1000e", "sys/bus/pci/drivers/e1000e/uevent": "",
       f"{DEVICE}/device": chip}, severity, "e1000e", remedy)
      for chip, severity, remedy in (("0x15bc", WARNING, "i210"), ("0x10d3", OK, ""))),
    ("other-traffic", "good", {"proc/net/packet": PACKET.format(2)}, NOTE, "an EtherCAT master is using eth0", ""),
    ("other-traffic", "good", {"proc/net/packet": PACKET.format(3)}, OK, "eth0 was silent for 0.5 s", ""),
    ("ip-address", "laptop", {}, WARNING, "an IPv6 address", "sysctl -w net.ipv6.conf.eth0.disable_ipv6=1"),
    ("network-services", "laptop", {}, WARNING, "avahi-daemon announces", "nmcli device set eth0 managed no"),
    ("network-services", "good",
     {"proc/801/comm": "NetworkManager", "run/NetworkManager/devices/2": "[device]\nmanaged=false\n"}, OK, "", ""),
    ("raw-frames", "good", {"proc/self/status": STATUS.format(capabilities="806000", cpus="0-3")}, BAD,
     "CAP_NET_ADMIN is not granted: eth0 cannot be opened", "setcap cap_net_admin"),
    ("priority", "good", {"proc/self/uid_map": "0 1000 1"}, BAD, "outside this user namespace", "rtprio 80"),
    ("priority", "good", {"proc/self/uid_map": None}, OK, "CAP_SYS_NICE", ""),
    ("priority", "laptop", {"proc/self/limits": LIMITS.format(memory=0, priority=80)}, OK, "allows SCHED_FIFO 80", ""),
    ("priority", "laptop", {"proc/self/limits": LIMITS.format(memory=0, priority=79)}, BAD, "RLIMIT_RTPRIO is 79", ""),
    ("priority", "laptop", {"proc/self/limits": ""}, NOTE, "has no line 'Max realtime priority'", ""),
    ("memory-lock", "good", {"proc/self/uid_map": "0 1000 1"}, WARNING, "RLIMIT_MEMLOCK is 8192 KiB", "unlimited"),
    ("memory-lock", "good", {}, OK, "CAP_IPC_LOCK", ""),
    ("memory-lock", "laptop", {"proc/self/limits": LIMITS.format(memory="unlimited", priority=0)}, OK, "unlimited", ""),
    ("memory-lock", "laptop", {"proc/self/limits": LIMITS.format(memory=1 << 29, priority=0)}, OK, "512 MiB", ""),
    ("swap", "laptop", {}, NOTE, "/swap.img", "swapoff -a"),
    ("huge-pages", "laptop", {}, NOTE, "always", "madvise"),
    ("huge-pages", "good", {"sys/kernel/mm/transparent_hugepage/enabled": "x"}, NOTE, "no choice in brackets", ""),
    ("heat", "good", {f"{ZONE}/temp": "84000"}, OK, "slowed down at 95 C", ""),
    ("heat", "good", {f"{ZONE}/temp": "86000"}, WARNING, "x86_pkg_temp has 86 C", "fan"),
    ("heat", "good", {f"{ZONE}/temp": "95000"}, BAD, "", "fan"),
    # The zone nearest to its trip point, which is not the hottest.
    ("heat", "good", {f"{ZONE}/temp": "70000", f"{ZONE1}/temp": "60000", f"{ZONE1}/trip_point_0_type": "passive",
                      f"{ZONE1}/trip_point_0_temp": "65000"}, WARNING, "thermal_zone1 has 60 C and is slowed", "fan"),
    ("heat", "good", {f"{ZONE}/trip_point_0_type": "critical", f"{ZONE}/temp": "90000"}, NOTE, "no zone tells", ""),
    ("heat", "good", {f"{ZONE}/temp": "x"}, NOTE, "no zone of /sys/class/thermal tells", ""),
    ("heat", "jetson", {}, WARNING, "", "jetson_clocks --fan"),
    ("power-mode", "jetson", {}, WARNING, "power mode 2 (MODE_30W)", "nvpmodel -m 0"),
    ("power-mode", "jetson", {"var/lib/nvpmodel/status": "pmode:0000", "etc/nvpmodel.conf": None}, OK, "mode 0", ""),
    ("power-mode", "jetson", {"var/lib/nvpmodel/status": "x"}, NOTE, "not pmode:NUMBER", ""),
    ("jetson-clocks", "jetson", {}, WARNING, "800 to 3600 MHz", "jetson_clocks"),
    ("jetson-clocks", "jetson", {f"{CPU3}/cpufreq/scaling_min_freq": "3600000"}, OK, "held at 3600 MHz", ""),
]  # fmt: skip


@pytest.mark.parametrize(("key", "kind", "files", "severity", "text", "remedy"), ROWS)
def test_a_check_finds_what_the_files_say(
    patient: Callable[[str], Any], key: str, kind: str, files: Files, severity: Severity, text: str, remedy: str
) -> None:
    examined = patient(kind)
    examined.put(files)
    finding = examined.finding(key)
    assert finding.severity is severity
    assert text in finding.found
    assert remedy in "\n".join(finding.remedy)


def test_every_check_that_can_stand_in_the_way_is_in_the_table() -> None:
    tested = {row[0] for row in ROWS if row[3] is not OK} | {"coalescing", "compiled", "skipped-ticks"}
    assert {check.key for check in CHECKS} == tested


@pytest.mark.parametrize(("is_stale", "severity"), [(True, WARNING), (False, NOTE)])
def test_a_cycle_that_runs_as_source_is_reported_with_the_reason(good: Any, is_stale: bool, severity: Severity) -> None:
    good.case = replace(good.case, build=Build(False, "rtcp/control/arm.py changed since it was compiled", is_stale))
    finding = good.finding("compiled")
    assert finding.severity is severity
    assert finding.found == "the cycle runs as source: rtcp/control/arm.py changed since it was compiled"
    assert "make fast" in "\n".join(finding.remedy)


def test_the_page_lists_the_checks_in_their_order() -> None:
    page = (Path(__file__).parents[2] / "docs/realtime.md").read_text()
    rows = re.findall(r"^\| ([a-z][a-z-]+(?:, [a-z-]+)*) \|", page.split("| check |")[1].split("\n\n")[0], re.MULTILINE)
    assert [key for row in rows for key in row.split(", ")] == [check.key for check in CHECKS]


@pytest.mark.parametrize(
    ("kind", "warning", "bad"),
    [
        ("good", "", ""),
        ("jetson", "preempt-rt isolated-cpu governor heat power-mode jetson-clocks", ""),
        ("laptop", "preempt-rt clock-source isolated-cpu cpu-permitted governor idle-states smt other-interrupts "
         "irqbalance ip-address network-services memory-lock", "card-interrupt driver raw-frames priority"),
    ],
)  # fmt: skip
def test_a_whole_host_has_these_findings_and_each_comes_with_a_remedy(
    patient: Callable[[str], Any], kind: str, warning: str, bad: str
) -> None:
    findings = patient(kind).findings().values()
    assert [f.key for f in findings if f.severity is WARNING] == warning.split()
    assert {f.key for f in findings if f.severity is BAD} == set(bad.split())
    assert [
        f.key for f in findings if (f.severity is OK and f.remedy) or (f.severity >= WARNING and not f.remedy)
    ] == []


def test_a_jetson_nano_is_not_sent_to_a_repository_and_its_pages_exist(patient: Callable[[str], Any]) -> None:
    nano = patient("jetson")
    nano.put({
        "proc/version": "Linux version 4.9.337-tegra (gcc 7) #1 SMP PREEMPT Thu Jun 8",
        "etc/nv_tegra_release": "# R32 (release), REVISION: 7.6, GCID: 38171779, BOARD: t210ref",
        "proc/device-tree/model": "NVIDIA Jetson Nano Developer Kit\0",
    })  # fmt: skip
    remedy = "\n".join(nano.finding("preempt-rt").remedy)
    assert remedy == f"{BUILD}, and docs/jetson.md for this board"
    pages = re.findall(r"docs/\w+\.md", remedy)
    assert [page for page in pages if not (Path(__file__).parents[2] / page).exists()] == []


def test_a_host_that_says_nothing_is_not_known_and_not_bad(tmp_path: Path) -> None:
    case = Case(Host(tmp_path), cpu=3, priority=80, interface=None, wait_us=150.0)
    assert max(finding.severity for finding in examine(case)) is NOTE


@pytest.mark.parametrize("key", ["governor", "idle-states"])
def test_a_cpu_that_the_system_neither_clocks_down_nor_puts_to_sleep_is_a_note(good: Any, key: str) -> None:
    for folder in ("cpufreq", "cpuidle"):
        shutil.rmtree(good.root / CPU3 / folder)
    assert good.severity(key) is NOTE


def test_what_a_host_does_not_have_is_not_checked(good: Any) -> None:
    good.put({"sys/kernel/mm/transparent_hugepage/enabled": None})
    shutil.rmtree(good.root / ZONE)
    absent = {"huge-pages", "heat", "power-mode", "jetson-clocks", "skipped-ticks"}
    assert good.findings().keys().isdisjoint(absent)


# -- the network card -----------------------------------------------------------------------------------------------

NETWORK = ("interface", "driver", "coalescing", "other-traffic", "ip-address", "network-services")


@pytest.mark.parametrize("key", [*NETWORK, "card-interrupt"])
def test_on_the_virtual_bus_a_check_of_the_card_does_not_apply(laptop: Any, key: str) -> None:
    finding = laptop.finding(key, **VIRTUAL)
    assert (finding.severity, finding.found) == (NOTE, "does not apply: the bus is virtual")


def test_the_virtual_bus_does_without_raw_frames(laptop: Any) -> None:
    assert laptop.severity("raw-frames", **VIRTUAL) is OK


def test_an_interface_that_is_missing_is_bad_and_nothing_else_is_known_of_it(good: Any) -> None:
    findings = good.findings(interface="eth7")
    assert findings["interface"].severity is BAD
    assert findings["interface"].found == "there is no interface eth7; there are: eth0"
    assert {findings[key].found for key in NETWORK[1:]} == {"not known: there is no interface eth7"}


def test_an_interrupt_is_the_cards_also_by_the_list_of_its_pci_function(good: Any) -> None:
    table = (good.root / "proc/interrupts").read_text().replace("eth0-TxRx-0", "mystery")
    good.put({"proc/interrupts": table, f"{DEVICE}/msi_irqs/130": "msix"})
    assert "130 on CPU 3" in good.finding("card-interrupt").found


def test_the_interrupt_of_a_longer_name_is_not_the_cards(good: Any) -> None:
    table = (good.root / "proc/interrupts").read_text().replace("eth0-TxRx-0", "eth01")
    good.put({"proc/interrupts": table})
    assert good.finding("card-interrupt").found == "not known: /proc/interrupts names none of eth0"


@pytest.mark.parametrize(
    ("settings", "severity", "text"),
    [
        (None, OK, "has no coalescing to set"),
        (Coalescing(0, 0, False), OK, "every frame at once"),
        (Coalescing(50, 0, False), WARNING, "holds frames back (rx-usecs 50, tx-usecs 0)"),
        (Coalescing(0, 50, False), WARNING, "holds frames back"),
        (Coalescing(0, 0, True), WARNING, "adaptive"),
        (Coalescing(3, 0, False), WARNING, "for a time that follows the traffic (rx-usecs 3, tx-usecs 0, igb)"),
        (Coalescing(100, 49, False), WARNING, "holds frames back"),
        (Coalescing(100, 50, False), BAD, "for up to 150 us"),
    ],
)
def test_a_card_that_holds_frames_back_longer_than_the_loop_waits_is_bad(
    good: Any, settings: Coalescing | None, severity: Severity, text: str
) -> None:
    good.card.coalescing = settings
    finding = good.finding("coalescing")
    assert finding.severity is severity
    assert text in finding.found


def test_coalescing_is_switched_off_on_this_interface_now_and_after_a_restart(good: Any) -> None:
    good.card.coalescing = Coalescing(3, 0, True)
    now, kept = good.finding("coalescing").remedy
    assert now == "ethtool -C eth0 adaptive-rx off adaptive-tx off rx-usecs 0 tx-usecs 0"
    assert "OriginalName=eth0" in kept


def test_the_kernel_of_this_machine_answers_for_its_interfaces() -> None:
    assert Host().coalescing("lo") is None
    assert Host().ipv4_address("lo") == "127.0.0.1"
    with pytest.raises(NotKnown, match="ethtool -c eth77: No such device"):
        Host().coalescing("eth77")


def test_the_kernels_answer_is_read_at_the_places_of_its_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(descriptor: object, number: int, request: bytearray, mutate: bool) -> None:
        # struct ifreq: a name of 16 bytes, a pointer; struct ethtool_coalesce: rx-usecs is word 1, tx-usecs word 5,
        # use_adaptive_rx_coalesce word 10.
        words = [0x0E, *range(101, 110), 1, *[0] * 12]
        ctypes.memmove(struct.unpack_from("P", request, 16)[0], struct.pack("23I", *words), 92)

    monkeypatch.setattr(fcntl, "ioctl", answer)
    assert Host().coalescing("eth0") == Coalescing(receive_us=101, send_us=105, adaptive=True)


def test_frames_that_come_while_no_master_runs_are_counted(good: Any) -> None:
    good.during = lambda: good.put({f"{ETH0}/statistics/rx_packets": "80", f"{ETH0}/statistics/tx_packets": "13"})
    assert good.finding("other-traffic").found.startswith("3 frames came and 1 went on eth0 within 0.5 s")


def test_an_ipv4_address_that_the_kernel_does_not_tell_is_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused() -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("psutil.net_if_addrs", refused)
    with pytest.raises(NotKnown, match="the address of lo: Operation not permitted"):
        Host().ipv4_address("lo")


def test_an_ipv4_address_is_removed_unless_it_is_the_hosts_way_to_its_network(good: Any) -> None:
    good.card.ipv4 = "192.168.1.7"
    finding = good.finding("ip-address")
    assert finding.found == "eth0 has 192.168.1.7: the system sends its own frames there"
    assert finding.remedy == ("ip -4 address flush dev eth0",)
    good.put({"proc/net/route": "Iface\tDestination\tGateway\neth0\t00000000\t0101A8C0\n"})
    finding = good.finding("ip-address")
    assert (finding.severity, finding.remedy) == (BAD, ("rtcp doctor --bus NAME",))


def test_a_dot_in_an_interfaces_name_is_written_as_sysctl_wants_it(good: Any) -> None:
    good.put({"sys/class/net/eth0.5/ifindex": "9", "proc/net/if_inet6": "fe80 09 40 20 80 eth0.5"})
    assert "net.ipv6.conf.eth0/5.disable_ipv6=1" in good.finding("ip-address", interface="eth0.5").remedy[0]


# -- the running platform -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("missed", "severity"), [(0, OK), (3, WARNING), (30, BAD)])
def test_a_running_platform_that_skips_ticks_is_told_apart(
    good: Any, missed: int, severity: Severity, publish: Callable[..., None]
) -> None:
    path = Path(f"/dev/shm/rtcp-test-doctor-{os.getpid()}")
    board = Blackboard(path, arm_schema(6), 500_000)
    try:
        assert good.finding("skipped-ticks", blackboard=path).severity is OK  # no cycle yet
        for number in range(300):
            publish(board, missed=missed * (number >= 150), wakeup_ns=5000, exchange_ns=60_000, compute_ns=700_000)
        finding = good.finding("skipped-ticks", blackboard=path)
    finally:
        board.close()
        path.unlink()
    assert finding.severity is severity
    assert severity is OK or ("compute takes 700 of 500 us" in finding.found and "cycle.period_us" in finding.remedy[0])


def test_a_blackboard_of_another_version_is_not_known(good: Any, tmp_path: Path) -> None:
    (tmp_path / "board").write_bytes(b"x")
    assert "cut short" in good.finding("skipped-ticks", blackboard=tmp_path / "board").found


# -- whatever the files hold ----------------------------------------------------------------------------------------

GARBAGE: dict[str, Callable[[bytes], bytes]] = {
    "nothing": lambda text: b"",
    "white-space": lambda text: b" \n\t\n ",
    "no-text": lambda text: bytes(range(256)),
    "a-list-without-end": lambda text: b"0-99999999999",
    "colons": lambda text: b":\n::\n1:\n: 2\n",
    "a-negative-number": lambda text: b"-7",
    "cut-in-the-middle": lambda text: text[: len(text) // 2],
    "numbers-without-end": lambda text: re.sub(rb"[0-9]+", b"9" * 5000, text),
    "letters-for-numbers": lambda text: re.sub(rb"[0-9]+", b"x", text),
    "foreign-digits": lambda text: re.sub(rb"[0-9]+", "\u00b2\u0663".encode(), text),
    "one-word-a-line": lambda text: b"\n".join(text.split()),
}


def files_of(root: Path) -> list[Path]:
    return [path for path in sorted(root.rglob("*")) if path.is_file() and not path.is_symlink()]


@pytest.mark.parametrize("garbage", GARBAGE.values(), ids=GARBAGE.keys())
@pytest.mark.parametrize("kind", ["jetson", "laptop"])
def test_a_malformed_file_raises_no_exception(
    patient: Callable[[str], Any], kind: str, garbage: Callable[[bytes], bytes]
) -> None:
    broken = patient(kind)
    asked = len(broken.findings())
    for path in files_of(broken.root):
        kept = path.read_bytes()
        path.write_bytes(garbage(kept))
        assert len(broken.findings()) >= asked - 3, path  # a Jetson without its model has two checks less
        path.write_bytes(kept)


@pytest.mark.parametrize("kind", ["jetson", "laptop"])
def test_a_folder_in_a_files_place_raises_no_exception(patient: Callable[[str], Any], kind: str) -> None:
    broken = patient(kind)
    for path in files_of(broken.root):
        kept = path.read_bytes()
        path.unlink()
        path.mkdir()
        broken.findings()
        path.rmdir()
        path.write_bytes(kept)


def test_a_pipe_that_nobody_writes_to_does_not_block_the_doctor(good: Any) -> None:
    good.put({"proc/swaps": None})
    os.mkfifo(good.root / "proc/swaps")
    assert good.finding("swap").found == "not known: /proc/swaps is empty"


@given(st.sets(st.integers(0, 300)))
def test_a_list_of_cpus_is_read_as_it_is_written(cpus: set[int]) -> None:
    assert parse_cpus(format_cpus(cpus)) == cpus


@pytest.mark.parametrize("text", ["x", "1-", "-1", "1,,2", "0-99999999999", "1 2", "²"])
def test_what_is_no_list_of_cpus_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is no list of CPUs"):
        parse_cpus(text)
