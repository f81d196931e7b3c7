"""Hosts as folders of files, as the kernels of a Jetson, a PC and a laptop have them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from kinematics.compiled import Build
from rtcp.ipc.blackboard import Blackboard
from rtcp.realtime.doctor import Case, Finding, Severity, examine
from rtcp.realtime.host import Coalescing, Host
from tests.records import numbers

CPUS = "sys/devices/system/cpu"
ETH0 = "sys/class/net/eth0"

STATUS = "Name:\tpython\nCapEff:\t{capabilities}\nCpus_allowed_list:\t{cpus}\n"
LIMITS = """Limit                     Soft Limit           Hard Limit           Units
Max locked memory         {memory}              {memory}              bytes
Max realtime priority     {priority}                    {priority}
"""
INTERRUPTS = """           CPU0       CPU1       CPU2       CPU3
  9:          4          0          0          {acpi}   IO-APIC    9-fasteoi   acpi
130:         10          0          0      90000   PCI-MSI 1048576-edge      eth0-TxRx-0
NMI:          1          1          1          1   Non-maskable interrupts
"""

GOOD_PC = {
    "proc/version": "Linux version 6.12.48-rt (gcc 14) #1 SMP PREEMPT_RT Debian 6.12.48-1",
    "sys/kernel/realtime": "1",
    "etc/os-release": 'NAME="Debian"\nID=debian\n',
    "etc/default/grub": 'GRUB_CMDLINE_LINUX=""\n',
    "proc/sys/kernel/sched_rt_runtime_us": "-1",
    "proc/sys/kernel/sched_rt_period_us": "1000000",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "tsc",
    "sys/devices/system/clocksource/clocksource0/available_clocksource": "tsc hpet acpi_pm",
    "proc/cpuinfo": "processor : 0\nflags : fpu tsc constant_tsc\n",
    "proc/stat": "cpu  100 0 100 800 0 0 0 0 0 0\ncpu0 100 0 100 800 0 0 0 0 0 0\n",
    f"{CPUS}/online": "0-3",
    f"{CPUS}/isolated": "3",
    f"{CPUS}/nohz_full": "3",
    f"{CPUS}/cpu3/cpufreq/scaling_governor": "performance",
    f"{CPUS}/cpu3/cpufreq/scaling_min_freq": "800000",
    f"{CPUS}/cpu3/cpufreq/scaling_max_freq": "3600000",
    f"{CPUS}/cpu3/cpuidle/state0/name": "POLL",
    f"{CPUS}/cpu3/cpuidle/state0/latency": "0",
    f"{CPUS}/cpu3/cpuidle/state1/name": "C6",
    f"{CPUS}/cpu3/cpuidle/state1/latency": "133",
    f"{CPUS}/cpu3/topology/thread_siblings_list": "3",
    "dev/cpu_dma_latency": "",
    "proc/interrupts": INTERRUPTS.format(acpi=0),
    "proc/irq/9/smp_affinity_list": "0-3",
    "proc/irq/9/effective_affinity_list": "0",
    "proc/irq/130/smp_affinity_list": "3",
    "proc/irq/130/effective_affinity_list": "3",
    "proc/417/comm": "irq/130-eth0-Tx",
    "proc/417/stat": "417 (irq/130-eth0-Tx) S 2" + " 0" * 34 + " 3 90 1 0 0",
    f"{ETH0}/operstate": "up",
    f"{ETH0}/flags": "0x1003",
    f"{ETH0}/carrier": "1",
    f"{ETH0}/speed": "100",
    f"{ETH0}/duplex": "full",
    f"{ETH0}/ifindex": "2",
    f"{ETH0}/statistics/rx_packets": "77",
    f"{ETH0}/statistics/tx_packets": "12",
    f"{ETH0}/device": "->sys/devices/pci/0000:01:00.0",
    "sys/devices/pci/0000:01:00.0/driver": "->sys/bus/pci/drivers/igb",
    "sys/devices/pci/0000:01:00.0/subsystem": "->sys/bus/pci",
    "sys/devices/pci/0000:01:00.0/device": "0x1533",
    "sys/bus/pci/drivers/igb/uevent": "",
    "proc/net/packet": "sk RefCnt Type Proto  Iface R Rmem   User   Inode",
    "proc/net/route": "Iface\tDestination\tGateway\nwlan0\t00000000\t0102A8C0\n",
    "proc/net/if_inet6": "00000000000000000000000000000001 01 80 10 80 lo",
    "proc/self/status": STATUS.format(capabilities="0000000000807000", cpus="0-3"),
    "proc/self/limits": LIMITS.format(memory=8388608, priority=0),
    "proc/self/uid_map": "0 0 4294967295",
    "proc/swaps": "Filename Type Size Used Priority",
    "sys/kernel/mm/transparent_hugepage/enabled": "always [madvise] never",
    "sys/class/thermal/thermal_zone0/type": "x86_pkg_temp",
    "sys/class/thermal/thermal_zone0/temp": "45000",
    "sys/class/thermal/thermal_zone0/trip_point_0_type": "passive",
    "sys/class/thermal/thermal_zone0/trip_point_0_temp": "95000",
}  # fmt: skip
"""A path -> its text; "->" begins the target of a symbolic link."""

JETSON = GOOD_PC | {
    "proc/version": "Linux version 5.15.148-tegra (gcc 11) #1 SMP PREEMPT Tue Jan 7",
    "sys/kernel/realtime": None,
    "etc/default/grub": None,
    "etc/nv_tegra_release": "# R36 (release), REVISION: 4.3, GCID: 38968081",
    "boot/extlinux/extlinux.conf": "LABEL primary\n      APPEND ${cbootargs} quiet\n",
    "proc/device-tree/model": "NVIDIA Jetson AGX Orin Developer Kit\0",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "arch_sys_counter",
    f"{CPUS}/isolated": "",
    f"{CPUS}/nohz_full": "(null)",
    f"{CPUS}/cpu3/cpufreq/scaling_governor": "schedutil",
    "sys/devices/pci/0000:01:00.0/driver": "->sys/bus/platform/drivers/nvethernet",
    "sys/bus/platform/drivers/nvethernet/uevent": "",
    "var/lib/nvpmodel/status": "pmode:0002",
    "etc/nvpmodel.conf": "< POWER_MODEL ID=2 NAME=MODE_30W >\n",
    "sys/class/thermal/thermal_zone0/type": "cpu-thermal",
    "sys/class/thermal/thermal_zone0/temp": "91500",
    "sys/class/thermal/thermal_zone1/temp": "not a number: its block is off",
}

LAPTOP = GOOD_PC | {
    "proc/version": "Linux version 6.8.0-45-generic (gcc 13) #45-Ubuntu SMP PREEMPT_DYNAMIC",
    "sys/kernel/realtime": None,
    "etc/os-release": 'ID=ubuntu\nVERSION_ID="24.04"\n',
    "proc/sys/kernel/sched_rt_runtime_us": "950000",
    "sys/devices/system/clocksource/clocksource0/current_clocksource": "hpet",
    f"{CPUS}/isolated": "",
    f"{CPUS}/nohz_full": None,
    f"{CPUS}/cpu3/cpufreq/scaling_governor": "powersave",
    f"{CPUS}/cpu3/topology/thread_siblings_list": "1,3",
    "dev/cpu_dma_latency": None,
    "proc/interrupts": INTERRUPTS.format(acpi=55),
    "proc/irq/9/effective_affinity_list": "3",
    "proc/417/stat": "417 (irq/130-eth0-Tx) S 2" + " 0" * 34 + " 3 50 1 0 0",
    "proc/800/comm": "irqbalance",
    "proc/801/comm": "NetworkManager",
    "proc/802/comm": "avahi-daemon",
    "sys/devices/pci/0000:01:00.0/driver": "->sys/bus/usb/drivers/r8152",
    "sys/devices/pci/0000:01:00.0/subsystem": "->sys/bus/usb",
    "sys/bus/usb/drivers/r8152/uevent": "",
    "proc/net/if_inet6": "fe800000000000000000000000000001 02 40 20 80 eth0",
    "proc/self/status": STATUS.format(capabilities="0000000000000000", cpus="0-2"),
    "proc/self/uid_map": "0 1000 1",
    "proc/swaps": "Filename Type Size Used Priority\n/swap.img file 2097148 0 -2",
    "sys/kernel/mm/transparent_hugepage/enabled": "[always] madvise never",
}

HOSTS = {"good": GOOD_PC, "jetson": JETSON, "laptop": LAPTOP}


@dataclass
class Card:
    """Answers of the card's driver and the kernel to ioctl."""

    coalescing: Coalescing | None = field(default_factory=lambda: Coalescing(0, 0, False))
    ipv4: str | None = None


@dataclass(frozen=True)
class FakeHost(Host):
    """Files in a folder and a card with the test's answers."""

    card: Card = field(default_factory=Card)

    def coalescing(self, interface: str) -> Coalescing | None:
        return self.card.coalescing

    def ipv4_address(self, interface: str) -> str | None:
        return self.card.ipv4


class Patient:
    """A host in a folder, and the doctor's findings on it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.card = Card()
        self.during: Callable[[], None] = lambda: None
        """Called while the doctor counts frames."""
        self.case = Case(
            FakeHost(root, lambda seconds: self.during(), self.card),
            cpu=3,
            priority=80,
            interface="eth0",
            wait_us=150.0,
            build=Build(True, ""),
        )

    def put(self, files: dict[str, str | None]) -> None:
        """Write files; None removes one."""
        for name, text in files.items():
            path = self.root / name
            if path.is_symlink() or path.exists():
                path.unlink()
            if text is None:
                continue
            path.parent.mkdir(parents=True, exist_ok=True)
            if text.startswith("->"):
                path.symlink_to(os.path.relpath(self.root / text[2:], path.parent))
            else:
                path.write_text(text)

    def findings(self, **changes: object) -> dict[str, Finding]:
        return {finding.key: finding for finding in examine(replace(self.case, **changes))}  # type: ignore[arg-type]

    def finding(self, key: str, **changes: object) -> Finding:
        return self.findings(**changes)[key]

    def severity(self, key: str, **changes: object) -> Severity:
        return self.finding(key, **changes).severity


@pytest.fixture
def patient(tmp_path: Path) -> Callable[[str], Patient]:
    """Build one of the hosts."""

    def build(kind: str) -> Patient:
        built = Patient(tmp_path / kind)
        built.put(HOSTS[kind])
        return built

    return build


@pytest.fixture
def good(patient: Callable[[str], Patient]) -> Patient:
    return patient("good")


@pytest.fixture
def jetson(patient: Callable[[str], Patient]) -> Patient:
    return patient("jetson")


@pytest.fixture
def laptop(patient: Callable[[str], Patient]) -> Patient:
    return patient("laptop")


@pytest.fixture
def publish() -> Callable[..., None]:
    """Publish a cycle record with these scalars; the others are 0."""

    def publish(board: Blackboard, **scalars: int) -> None:
        board.publish(numbers(board.schema, **scalars))

    return publish
