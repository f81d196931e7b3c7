"""Obstacles to real time on a host: a table of checks, each with its finding and its remedy.

`examine(case)` runs every check in the table `CHECKS` at the end; nothing is changed on the host.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from pathlib import Path

from kinematics.compiled import BUILD, Build
from rtcp.realtime.host import Host, NotKnown, format_cpus, name_cpus, parse_cpus, whole

_CPUS = "/sys/devices/system/cpu"
_NET = "/sys/class/net"


@dataclass(frozen=True)
class Case:
    """The host, and the requirements of the loop."""

    host: Host
    cpu: int
    priority: int
    """SCHED_FIFO priority of the loop."""
    interface: str | None
    """Network interface of the bus; None: the virtual bus."""
    wait_us: float
    """How long the loop waits for its frame."""
    blackboard: Path | None = None
    """Blackboard of a platform that may be running; None: not checked."""
    build: Build = BUILD


class Severity(IntEnum):
    """Severity of a finding; the larger number is the worse."""

    OK = 0
    NOTE = 1
    """Worth knowing, not known, or not applicable to this host."""
    WARNING = 2
    """Cycles are late at times."""
    BAD = 3
    """The loop cannot keep its cycle, or cannot run at all."""


@dataclass(frozen=True)
class Result:
    """Result of a probe; `remedy`: lines for a root shell, in their order, where something is to be changed."""

    severity: Severity
    found: str
    remedy: tuple[str, ...]


@dataclass(frozen=True)
class Finding(Result):
    """A result with the name of its check and why that matters to the cycle."""

    key: str
    why: str


@dataclass(frozen=True)
class Check:
    """A row of the table. The probe returns None where the check does not apply, and raises `NotKnown`."""

    key: str
    probe: Callable[[Case], Result | None]
    why: str


def examine(case: Case) -> list[Finding]:
    """Return the finding of each check that applies to this host; what cannot be read is a note."""
    findings = []
    for check in CHECKS:
        try:
            result = check.probe(case)
        except NotKnown as reason:
            result = _note(f"not known: {reason}")
        if result is not None:
            findings.append(Finding(result.severity, result.found, result.remedy, check.key, check.why))
    return findings


def _result(severity: Severity, text: str, *remedy: str) -> Result:
    return Result(severity, text, remedy)


_ok = partial(_result, Severity.OK)
_note = partial(_result, Severity.NOTE)
_warning = partial(_result, Severity.WARNING)
_bad = partial(_result, Severity.BAD)

# -- remedies that last: the kernel's command line, sysctl, a file written at boot ------------------------------

_SYSCTL_FILE = "/etc/sysctl.d/90-rtcp.conf"
_TMPFILES = "/etc/tmpfiles.d/rtcp-host.conf"
"""Not the service's own file, which stands beside it."""
_BOOT_FILES = (
    # Jetson and other boards of U-Boot's extlinux; Raspberry Pi; GRUB.
    ("/boot/extlinux/extlinux.conf", "sed -i '/^ *APPEND /s/$/ {words}/' {file}"),
    ("/boot/firmware/cmdline.txt", "sed -i '1s/$/ {words}/' {file}"),
    ("/etc/default/grub", "sed -i 's/^GRUB_CMDLINE_LINUX=\"/&{words} /' {file} && update-grub"),
)
_KEPT = "   # kept after a restart"


def _kernel_arguments(host: Host, words: str) -> str:
    for file, command in _BOOT_FILES:
        if host.exists(file):
            return f"{command.format(words=words, file=file)}   # then reboot"
    return f"# in the boot loader's settings, then reboot: add to the kernel's command line: {words}"


def _sysctl(setting: str) -> tuple[str, ...]:
    return (f"sysctl -w {setting}", f"echo '{setting}' >> {_SYSCTL_FILE}{_KEPT}")


def _at_boot(path: str, value: str) -> str:
    return f"echo 'w {path} - - - - {value}' >> {_TMPFILES}{_KEPT}"


# -- the kernel -------------------------------------------------------------------------------------------------

_JETSON_RELEASE = "/etc/nv_tegra_release"
_JETSON_SOURCES = "/etc/apt/sources.list.d/nvidia-l4t-apt-source.list"
_FIRST_PACKAGED_RELEASE = 36
"""First release of Jetson Linux whose guide has the section "Real-Time Kernel Using OTA Update" for every board."""
_JETSON_PACKAGES = (
    "nvidia-l4t-rt-kernel nvidia-l4t-rt-kernel-headers nvidia-l4t-rt-kernel-oot-modules nvidia-l4t-display-rt-kernel"
)
"""Jetson Linux Developer Guide, "Installing Real-Time Kernel"."""
_BUILD_KERNEL = "# build a kernel with PREEMPT_RT from its sources: docs/realtime_kernel.md"
_CLOCK = "/sys/devices/system/clocksource/clocksource0"
_GOOD_CLOCKS = ("tsc", "arch_sys_counter")
"""Read from a register without leaving user space, on x86 and on ARM."""
_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies")


def _preempt_rt(case: Case) -> Result:
    version = case.host.word("/proc/version")
    release = version.split(" ")[2] if version.count(" ") >= 2 else version
    if case.host.text_or("/sys/kernel/realtime", "") == "1" or re.search("PREEMPT[_ ]RT", version):
        return _ok(f"PREEMPT_RT, Linux {release}")
    kind = next((word for word in version.split() if word.startswith("PREEMPT")), "no preemption named")
    return _warning(f"Linux {release} is not a PREEMPT_RT kernel ({kind})", *_rt_kernel(case.host))


def _rt_kernel(host: Host) -> tuple[str, ...]:
    if host.exists(_JETSON_RELEASE):
        return _jetson_kernel(host)
    release = dict(line.partition("=")[::2] for line in host.text_or("/etc/os-release", "").splitlines())
    if release.get("ID") == "ubuntu":
        version = release.get("VERSION_ID", "").strip('"')
        if version in ("22.04", "24.04"):
            return ("pro attach && pro enable realtime-kernel   # then reboot",)
        return ("apt install linux-realtime   # then reboot",) if version >= "25.10" else (_BUILD_KERNEL,)
    if release.get("ID") == "debian":
        return ("apt install linux-image-rt-$(dpkg --print-architecture)   # then reboot",)
    return (
        "# install the distribution's kernel with PREEMPT_RT; Linux 6.12 and newer have it: CONFIG_PREEMPT_RT=y",
        _BUILD_KERNEL,
    )


def _jetson_kernel(host: Host) -> tuple[str, ...]:
    # "# R36 (release), REVISION: 4.3, ...": the repository is called r36.4.
    named = re.search(r"R(\d{1,3}) \(release\), REVISION: (\d{1,3})", host.text(_JETSON_RELEASE))
    if named is None or int(named[1]) < _FIRST_PACKAGED_RELEASE:
        return (f"{_BUILD_KERNEL}, and docs/jetson.md for this board",)
    packages = _JETSON_PACKAGES
    if int(named[1]) >= 38:
        thor = "thor" in host.text_or("/proc/device-tree/model", "").lower()
        packages += " nvidia-l4t-rt-kernel-openrm" if thor else " nvidia-l4t-rt-kernel-nvgpu"
    repository = f"https://repo.download.nvidia.com/jetson/rt-kernel r{named[1]}.{named[2]}"
    return (
        f"echo 'deb {repository} main' >> {_JETSON_SOURCES}",
        f"apt update && apt install {packages}   # then reboot",
    )


def _throttling(case: Case) -> Result:
    runtime = case.host.integer("/proc/sys/kernel/sched_rt_runtime_us")
    period = case.host.integer("/proc/sys/kernel/sched_rt_period_us")
    if runtime < 0:
        return _ok("real-time threads are not throttled")
    share = f"real-time threads may have {runtime / 1000:g} of every {period / 1000:g} ms of a CPU"
    remedy = _sysctl(f"kernel.sched_rt_runtime_us={period * 95 // 100}")
    if runtime == 0:
        return _bad(share, *remedy)
    if runtime < 0.9 * period:
        return _warning(share, *remedy)
    return _ok(f"{share}: more than a cycle takes, and a loop that runs away does not hang the CPU")


def _clock_source(case: Case) -> Result:
    host = case.host
    current = host.word(f"{_CLOCK}/current_clocksource")
    fact = f"the clock is read from {current}"
    if current in _GOOD_CLOCKS:
        return _ok(fact)
    available = host.text(f"{_CLOCK}/available_clocksource").split()
    if better := next((name for name in _GOOD_CLOCKS if name in available), None):
        now = f"echo {better} > {_CLOCK}/current_clocksource"
        return _warning(f"{fact} although {better} is available", now, _kernel_arguments(host, f"clocksource={better}"))
    if current not in _SLOW_CLOCKS:
        return _note(fact)
    fact += ", and the kernel offers no faster one"
    if "tsc" not in host.text_or("/proc/cpuinfo", "").split():
        return _warning(fact)
    fact += ": it found the CPU's own counter (tsc) unstable (dmesg | grep -i tsc)"
    return _warning(fact, _kernel_arguments(host, "tsc=reliable"))


def _hypervisor(case: Case) -> Result:
    host = case.host
    line = host.word("/proc/stat").splitlines()[0].split()
    if line[0] != "cpu" or len(line) < 9:
        raise NotKnown("/proc/stat does not begin with the times of all CPUs")
    times = [whole(word, "/proc/stat") for word in line[1:9]]
    total, steal = sum(times), times[7]
    flags = host.text_or("/proc/cpuinfo", "").split()
    if not ("hypervisor" in flags or host.exists("/sys/hypervisor/type") or steal):
        return _ok("no hypervisor is seen")
    share = f"it took {100 * steal / total:.2g} % of all CPU time since boot" if total else "no time has passed"
    return _warning(
        f"this is a virtual machine: the host below takes its CPUs away at any time ({share})",
        "# run the loop on hardware; else, on the host below, pin each virtual CPU to a CPU of its own",
    )


# -- the cycle's CPU --------------------------------------------------------------------------------------------

_LATENCY = "/dev/cpu_dma_latency"
_SHALLOW_US = 10
"""An idle state with at most this exit latency costs less than the 40 us by which the loop wakes early."""


def _isolated_cpu(case: Case) -> Result:
    host, cpu = case.host, case.cpu
    online, isolated = host.cpus(f"{_CPUS}/online"), host.cpus(f"{_CPUS}/isolated")
    if cpu not in online:
        key = f"# in the arm's file: cycle: {{cpu: {max(online, default=0)}}}"
        return _bad(f"the cycle is to run on CPU {cpu}, and this host has {name_cpus(online)}", key)
    if len(online) == 1:
        return _warning("this host has one CPU, which the cycle shares with everything else")
    if cpu in isolated:
        return _ok(f"CPU {cpu} of the cycle is isolated")
    if isolated:
        key = f"# in the arm's file: cycle: {{cpu: {max(isolated)}}}"
        return _warning(f"isolated is {name_cpus(isolated)}, and the cycle is to run on CPU {cpu}", key)
    remaining = format_cpus(online - {cpu})
    words = f"isolcpus=managed_irq,domain,{cpu} nohz_full={cpu} rcu_nocbs={cpu} irqaffinity={remaining}"
    return _warning(
        f"no CPU is isolated; the cycle is to run on CPU {cpu}",
        _kernel_arguments(host, words),
        f"# and in the arm's file: cycle: {{cpu: {cpu}}}",
    )


def _cpu_permitted(case: Case) -> Result:
    if case.cpu in case.host.cpus(f"{_CPUS}/isolated"):
        return _ok(f"CPU {case.cpu} is isolated, and the loop may ask for it")
    try:
        allowed = parse_cpus(case.host.fields("/proc/self/status").get("Cpus_allowed_list", ""))
    except ValueError as error:
        raise NotKnown(f"/proc/self/status: {error}") from error
    if not allowed:
        raise NotKnown("/proc/self/status names no CPU that this process may use")
    if case.cpu in allowed:
        return _ok(f"this process may use CPU {case.cpu}")
    return _warning(
        f"this process may use {name_cpus(allowed)}, not CPU {case.cpu}: the loop would not be pinned",
        f"taskset -c {format_cpus(allowed | {case.cpu})} rtcp start   # in a unit: CPUAffinity=",
    )


def _tick(case: Case) -> Result:
    path = f"{_CPUS}/nohz_full"
    if not case.host.exists(path):
        return _note("this kernel cannot switch the tick off (it is built without CONFIG_NO_HZ_FULL)")
    tickless = case.host.cpus(path)
    if case.cpu in tickless:
        return _ok(f"CPU {case.cpu} runs without the tick")
    fact = f"CPU {case.cpu} has the scheduler's tick; without it is {name_cpus(tickless)}"
    if case.cpu not in case.host.cpus(f"{_CPUS}/isolated"):
        return _note(fact)  # isolating the CPU removes its tick, too
    return _note(fact, _kernel_arguments(case.host, f"nohz_full={case.cpu} rcu_nocbs={case.cpu}"))


def _frequencies(case: Case) -> tuple[int, int]:
    """Return the lowest and the highest frequency of the cycle's CPU, MHz."""
    folder = f"{_CPUS}/cpu{case.cpu}/cpufreq"
    slowest, fastest = (case.host.integer(f"{folder}/scaling_{end}_freq") for end in ("min", "max"))
    return round(slowest / 1000), round(fastest / 1000)


def _governor(case: Case) -> Result:
    file = f"{_CPUS}/cpu{case.cpu}/cpufreq/scaling_governor"
    if not case.host.exists(f"{_CPUS}/cpu{case.cpu}/cpufreq"):
        return _note(f"nothing in this system sets the frequency of CPU {case.cpu} (the firmware may)")
    fact = f"CPU {case.cpu} is governed by {(chosen := case.host.word(file))}"
    if chosen == "performance":
        return _ok(fact)
    with suppress(NotKnown):  # the governor is what matters
        fact += ", {} to {} MHz".format(*_frequencies(case))
    return _warning(fact, f"echo performance > {file}", _at_boot(file, "performance"))


def _idle_states(case: Case) -> Result:
    host = case.host
    folder = f"{_CPUS}/cpu{case.cpu}/cpuidle"
    states = [f"{folder}/{name}" for name in host.names(folder) if name.startswith("state")]
    if not states:
        return _note(f"nothing in this system puts CPU {case.cpu} to sleep deeper than its halt instruction")
    deep = {}
    for state in states:
        latency_us = host.integer(f"{state}/latency")
        off = host.exists(f"{state}/disable") and host.integer(f"{state}/disable") == 1
        if latency_us > _SHALLOW_US and not off:
            deep[host.word(f"{state}/name")] = latency_us
    if not deep:
        return _ok(f"CPU {case.cpu} wakes from every idle state within {_SHALLOW_US} us")
    named = ", ".join(f"{name} {latency_us} us" for name, latency_us in deep.items())
    try:
        host.check_writable(_LATENCY)
    except NotKnown as reason:
        return _warning(
            f"CPU {case.cpu} may sleep deep (wakes from {named}), and the loop cannot forbid it: {reason}",
            "groupadd -f rtcp && usermod -aG rtcp USER   # USER: who starts the platform",
            f"echo 'z {_LATENCY} 0660 root rtcp -' >> {_TMPFILES}{_KEPT}",
            f"systemd-tmpfiles --create {_TMPFILES}",
        )
    return _ok(f"CPU {case.cpu} may sleep deep ({named}); the loop forbids it while it runs ({_LATENCY} at 0)")


def _smt(case: Case) -> Result:
    siblings = case.host.cpus(f"{_CPUS}/cpu{case.cpu}/topology/thread_siblings_list") - {case.cpu}
    if not siblings:
        return _ok(f"CPU {case.cpu} has its core to itself")
    now = f"echo off > {_CPUS}/smt/control"
    fact = f"CPU {case.cpu} shares its core with {name_cpus(siblings)} (SMT)"
    return _warning(fact, now, _kernel_arguments(case.host, "nosmt"))


# -- interrupts -------------------------------------------------------------------------------------------------

_CARD_PRIORITY = 90
"""Above the loop's 80, as in KickCAT."""
_SCHED_FIFO, _SCHED_RR = 1, 2
_NAMED = 4
"""Interrupts that are listed by name; the others are counted."""


@dataclass(frozen=True)
class _Interrupt:
    """A line of /proc/interrupts: its number, its count on the cycle's CPU, and the device's name."""

    number: int
    count: int
    owner: str


def _interrupts(case: Case) -> list[_Interrupt]:
    lines = case.host.word("/proc/interrupts").splitlines()
    columns = lines[0].split()
    if f"CPU{case.cpu}" not in columns:
        raise NotKnown(f"/proc/interrupts has no column of CPU {case.cpu}")
    interrupts = []
    for line in lines[1:]:
        number, _, entry = line.partition(":")
        words = entry.split()
        counts, owner = words[: len(columns)], " ".join(words[len(columns) :])
        if number.strip().isdecimal() and len(counts) == len(columns) and all(map(str.isdecimal, counts)):
            here = whole(counts[columns.index(f"CPU{case.cpu}")], "/proc/interrupts")
            interrupts.append(_Interrupt(whole(number, "/proc/interrupts"), here, owner))
    return interrupts


def _other_interrupts(case: Case) -> Result:
    online = case.host.cpus(f"{_CPUS}/online")
    if len(online) == 1:
        return _note("this host has one CPU, which takes all interrupts")
    cards = _of_the_card(case)
    busy = [
        interrupt
        for interrupt in _interrupts(case)
        if interrupt not in cards and interrupt.count and case.cpu in _handled_on(case.host, interrupt.number)
    ]
    if not busy:
        return _ok(f"no device interrupts CPU {case.cpu}")
    named = ", ".join(f"{line.number} ({(line.owner.split() or ['unnamed'])[-1]})" for line in busy[:_NAMED])
    more = f" and {len(busy) - _NAMED} others" if len(busy) > _NAMED else ""
    elsewhere = format_cpus(online - {case.cpu})
    isolated = case.cpu in case.host.cpus(f"{_CPUS}/isolated")
    return _warning(
        f"CPU {case.cpu} takes the interrupts {named}{more}",
        f"for n in {' '.join(str(each.number) for each in busy)}; do echo {elsewhere} > "
        "/proc/irq/$n/smp_affinity_list; done   # refused for interrupts that are bound to a CPU",
        # Where the CPU is not isolated yet, the kernel arguments that isolate it include this one.
        *((_kernel_arguments(case.host, f"irqaffinity={elsewhere}"),) if isolated else ()),
    )


def _irqbalance(case: Case) -> Result:
    if "irqbalance" not in case.host.processes():
        return _ok("irqbalance does not run")
    if case.cpu in case.host.cpus(f"{_CPUS}/isolated"):
        return _ok(f"irqbalance runs and leaves isolated CPUs alone, CPU {case.cpu} among them")
    fact = f"irqbalance runs and may put any interrupt on CPU {case.cpu}"
    return _warning(fact, "systemctl disable --now irqbalance")


def _card_interrupt(case: Case) -> Result:
    host, name = case.host, case.interface
    if name is None:
        return _note("does not apply: the bus is virtual")
    places = {interrupt.number: _handled_on(host, interrupt.number) for interrupt in _of_the_card(case)}
    if not places:
        raise NotKnown(f"/proc/interrupts names none of {name}")
    here = [number for number, cpus in places.items() if case.cpu in cpus]
    threads = [thread for number in here if (thread := _thread_of(host, number))]
    fact = f"{name}'s interrupts: " + "; ".join(f"{number} on {name_cpus(cpus)}" for number, cpus in places.items())
    if low := {pid: rank for pid, rank in threads if rank <= case.priority}:
        return _bad(
            f"{fact}; on CPU {case.cpu} its thread has priority {min(low.values())} and the loop {case.priority}",
            *(f"chrt -f -p {_CARD_PRIORITY} {pid}" for pid in low),
        )
    if not here:
        return _ok(f"{fact}, not on CPU {case.cpu} of the cycle")
    return _ok(f"{fact}, handled {'by threads that outrank the loop' if threads else 'at once, not by threads'}")


def _of_the_card(case: Case) -> list[_Interrupt]:
    """Return the interrupts named after the interface or its device, or listed by its PCI function."""
    if case.interface is None:
        return []
    device = f"{_NET}/{case.interface}/device"
    listed, names = set(case.host.names(f"{device}/msi_irqs")), [case.interface]
    with suppress(NotKnown):  # an interface without a device, as of a bridge
        names.append(case.host.target(device))
    # The name, or the name and a queue: eth0, eth0-TxRx-1; not eth01.
    name = re.compile(rf"(?<!\S)(?:{'|'.join(map(re.escape, names))})(?![^\W_])")
    return [line for line in _interrupts(case) if str(line.number) in listed or name.search(line.owner)]


def _handled_on(host: Host, number: int) -> frozenset[int]:
    """Return the CPUs that an interrupt reaches: its effective affinity, else the allowed one."""
    folder = f"/proc/irq/{number}"
    try:
        return host.cpus(f"{folder}/effective_affinity_list") or host.cpus(f"{folder}/smp_affinity_list")
    except NotKnown:
        return host.cpus(f"{folder}/smp_affinity_list")


def _thread_of(host: Host, number: int) -> tuple[int, int] | None:
    """Return process id and real-time priority of an interrupt's thread, None where it has none."""
    for name, pids in host.processes().items():
        if name.startswith(f"irq/{number}-"):
            # proc(5): after the name in brackets, fields 40 and 41 are the priority and the policy.
            where = f"/proc/{pids[0]}/stat"
            words = host.text(where).rpartition(")")[2].split()
            if len(words) < 39:
                raise NotKnown(f"{where} has no scheduling policy")
            rank, policy = whole(words[37], where), whole(words[38], where)
            return pids[0], rank if policy in (_SCHED_FIFO, _SCHED_RR) else 0
    return None


# -- the network card of the bus --------------------------------------------------------------------------------

_DYNAMIC = {"igb": range(1, 4), "igc": range(1, 4), "e1000": range(1, 5), "e1000e": range(1, 5)}
"""Small numbers are not us in Intel's drivers but kinds of a rate that follows the traffic (kernel documentation,
e1000e, InterruptThrottleRate)."""
_PLAIN_E1000E = ("0x10d3", "0x10f6")
"""82574L, a card of its own; other chips of this driver are the chipset's own port (I217, I218, I219)."""
_BETTER_CARD = "# use {} PCIe card, an Intel i210 best of all"
_OTHER_BUS = "rtcp doctor --bus NAME"
_WATCHED_S = 0.5
_ETHERCAT = "88a4"


def _of_interface(probe: Callable[[Case, str], Result]) -> Callable[[Case], Result]:
    """Return the probe for a bus that may be virtual, or whose interface may be missing."""

    def probe_bus(case: Case) -> Result:
        if case.interface is None:
            return _note("does not apply: the bus is virtual")
        if probe is not _interface and not case.host.exists(f"{_NET}/{case.interface}"):
            raise NotKnown(f"there is no interface {case.interface}")
        return probe(case, case.interface)

    return probe_bus


def _interface(case: Case, name: str) -> Result:
    host, folder = case.host, f"{_NET}/{name}"
    if not host.exists(folder):
        there = ", ".join(interface for interface in host.names(_NET) if interface != "lo") or "none"
        return _bad(f"there is no interface {name}; there are: {there}", _OTHER_BUS)
    if host.text(f"{folder}/operstate") == "down":
        flags = f"{folder}/flags"
        if not whole(host.text(flags), flags, 16) & 1:  # IFF_UP
            return _bad(f"{name} is switched off", f"ip link set {name} up")
    if host.integer(f"{folder}/carrier") != 1:
        return _bad(f"{name} has no link: no cable, or no slave with power at its other end")
    speed, duplex = host.integer(f"{folder}/speed"), host.text(f"{folder}/duplex")
    if speed <= 0:
        return _note(f"{name} is up and has a link; its driver tells no speed")
    fact = f"{name} is up and has a link of {speed} Mbit/s, {duplex} duplex"
    if duplex == "half" or speed < 100:
        return _bad(fact, f"ethtool -s {name} speed 100 duplex full autoneg on")
    return _ok(fact)


def _driver(case: Case, name: str) -> Result:
    host, folder = case.host, f"{_NET}/{name}"
    if host.exists(f"{folder}/wireless") or host.exists(f"{folder}/phy80211"):
        return _bad(f"{name} is a wireless interface: EtherCAT needs a cable", _OTHER_BUS)
    if not host.exists(f"{folder}/device"):
        return _note(f"{name} is no hardware (a bridge, one end of a veth pair, or the like)")
    kind = host.target(f"{folder}/device/driver")
    if host.target(f"{folder}/device/subsystem") == "usb":
        remedy = _BETTER_CARD.format("a port of the board or a")
        return _bad(f"{name} is an adapter at a USB port (driver {kind})", remedy)
    if kind == "igb":
        return _ok(f"{name} is driven by igb (Intel i210 and its kin)")
    if kind != "e1000e":
        return _note(f"{name} is driven by {kind}, of which nothing is known here: see the times in `rtcp status`")
    chip = host.text(f"{folder}/device/device")
    if chip in _PLAIN_E1000E:
        return _ok(f"{name} is an Intel 82574L (driver e1000e)")
    fact = f"{name} is driven by e1000e and is chip {chip}: most are an I219 or its kin, part of the chipset"
    return _warning(fact, _BETTER_CARD.format("a"))


def _coalescing(case: Case, name: str) -> Result:
    settings = case.host.coalescing(name)
    if settings is None:
        return _ok(f"the driver of {name} has no coalescing to set")
    times = f"rx-usecs {settings.receive_us}, tx-usecs {settings.send_us}{', adaptive' if settings.adaptive else ''}"
    if not (settings.receive_us or settings.send_us or settings.adaptive):
        return _ok(f"{name} reports every frame at once ({times})")
    adaptive = " adaptive-rx off adaptive-tx off" if settings.adaptive else ""
    link = f"[Match]\\nOriginalName={name}\\n[Link]\\nRxCoalesceSec=0\\nTxCoalesceSec=0\\n"
    remedy = (
        f"ethtool -C {name}{adaptive} rx-usecs 0 tx-usecs 0",
        f"printf '{link}' > /etc/systemd/network/50-{name}.link{_KEPT}",
    )
    kind = ""
    with suppress(NotKnown):
        kind = case.host.target(f"{_NET}/{name}/device/driver")
    if settings.receive_us in _DYNAMIC.get(kind, ()):
        return _warning(f"{name} holds frames back for a time that follows the traffic ({times}, {kind})", *remedy)
    total_us = settings.receive_us + settings.send_us
    if total_us < case.wait_us:
        return _warning(f"{name} holds frames back ({times})", *remedy)
    fact = f"{name} holds frames back for up to {total_us} us ({times})"
    return _bad(f"{fact}, and the loop waits {case.wait_us:g} us for its frame", *remedy)


def _other_traffic(case: Case, name: str) -> Result:
    host = case.host
    number = str(host.integer(f"{_NET}/{name}/ifindex"))
    # A packet socket for EtherCAT is open on the interface: packet(7), /proc/net/packet.
    sockets = map(str.split, host.text_or("/proc/net/packet", "").splitlines()[1:])
    if any(words[3:5] == [_ETHERCAT, number] for words in sockets):
        return _note(f"not counted: an EtherCAT master is using {name}")
    counters = [f"{_NET}/{name}/statistics/{direction}_packets" for direction in ("rx", "tx")]
    before = [host.integer(file) for file in counters]
    host.wait(_WATCHED_S)
    received, sent = (host.integer(file) - then for file, then in zip(counters, before, strict=True))
    if received == sent == 0:
        return _ok(f"{name} was silent for {_WATCHED_S:g} s")
    return _warning(
        f"{received} frames came and {sent} went on {name} within {_WATCHED_S:g} s, none of them this platform's",
        f"tcpdump -c 20 -e -i {name}   # shows whose they are",
    )


def _ip_address(case: Case, name: str) -> Result:
    host, addresses = case.host, []
    remedy: tuple[str, ...] = ()
    if address := host.ipv4_address(name):
        addresses.append(address)
        remedy += (f"ip -4 address flush dev {name}",)
    if any(words[5:6] == [name] for words in map(str.split, host.text_or("/proc/net/if_inet6", "").splitlines())):
        addresses.append("an IPv6 address")
        remedy += _sysctl(f"net.ipv6.conf.{name.replace('.', '/')}.disable_ipv6=1")  # sysctl.d(5): a dot in a name
    if not addresses:
        return _ok(f"{name} has no IP address")
    has = f"{name} has {' and '.join(addresses)}"
    routes = map(str.split, host.text_or("/proc/net/route", "").splitlines()[1:])
    if any(words[:2] == [name, "00000000"] for words in routes):
        return _bad(f"{has} and the default route: it is this host's way to its network, not a bus", _OTHER_BUS)
    return _warning(f"{has}: the system sends its own frames there", *remedy)


def _network_services(case: Case, name: str) -> Result:
    running = case.host.processes()
    services, remedy = [], []
    if "NetworkManager" in running:
        number = case.host.integer(f"{_NET}/{name}/ifindex")
        # Without a file of its state it may manage the interface.
        if "managed=false" not in case.host.text_or(f"/run/NetworkManager/devices/{number}", "").splitlines():
            services.append("NetworkManager manages it")
            unmanaged = f"[keyfile]\\nunmanaged-devices=interface-name:{name}\\n"
            remedy.append(f"nmcli device set {name} managed no")
            remedy.append(f"printf '{unmanaged}' > /etc/NetworkManager/conf.d/90-rtcp.conf{_KEPT}")
    if "avahi-daemon" in running:
        services.append("avahi-daemon announces services on every interface with an address")
        remedy.append(f"sed -i '/^\\[server\\]/a deny-interfaces={name}' /etc/avahi/avahi-daemon.conf")
        remedy.append("systemctl restart avahi-daemon")
    if not services:
        return _ok(f"neither NetworkManager nor avahi manages {name}")
    return _warning(f"{name}: {', and '.join(services)}", *remedy)


# -- permissions of this process --------------------------------------------------------------------------------

_NET_ADMIN, _NET_RAW, _IPC_LOCK, _SYS_NICE = 12, 13, 14, 23
"""linux/capability.h"""
_LIMITS = "/etc/security/limits.d/90-rtcp.conf"
_NEEDED_BYTES = 512 << 20
"""Memory that the loop's process maps, with a margin, bytes: mlockall counts all of it."""
_CAPABLE = (
    "rtcp service install   # as a service it has its rights; else, for an ordinary user:",
    "install -m 755 $(readlink -f $(command -v python3)) /usr/local/bin/rtcp-python",
    "setcap cap_net_admin,cap_net_raw,cap_sys_nice,cap_ipc_lock+ep /usr/local/bin/rtcp-python  # make the venv with it",
)


def _raw_frames(case: Case) -> Result:
    needed = (("CAP_NET_RAW", _NET_RAW), ("CAP_NET_ADMIN", _NET_ADMIN))  # SOEM makes the interface promiscuous
    lacking = [name for name, bit in needed if not _capable(case, bit)]
    if not lacking:
        return _ok("CAP_NET_RAW and CAP_NET_ADMIN are granted")
    fact = f"{' and '.join(lacking)} {'is' if len(lacking) == 1 else 'are'} not granted"
    if case.interface is None:
        return _ok(f"{fact}, which the virtual bus does without")
    return _bad(f"{fact}: {case.interface} cannot be opened", *_CAPABLE)


def _priority(case: Case) -> Result:
    if _capable(case, _SYS_NICE) and _outermost(case):
        return _ok("CAP_SYS_NICE is granted")
    allowed = _limit(case, "Max realtime priority")
    if allowed is None or allowed >= case.priority:
        return _ok(f"RLIMIT_RTPRIO allows SCHED_FIFO {case.priority}")
    within = " outside this user namespace" if not _outermost(case) else ""
    return _bad(
        f"SCHED_FIFO {case.priority} is refused: CAP_SYS_NICE is not granted{within}, and RLIMIT_RTPRIO is {allowed}",
        f"echo '* - rtprio {case.priority}' >> {_LIMITS}   # then log in again; in a unit: LimitRTPRIO={case.priority}",
    )


def _memory_lock(case: Case) -> Result:
    if _capable(case, _IPC_LOCK) and _outermost(case):
        return _ok("CAP_IPC_LOCK is granted")
    allowed = _limit(case, "Max locked memory")
    if allowed is None:
        return _ok("RLIMIT_MEMLOCK is unlimited")
    if allowed >= _NEEDED_BYTES:
        return _ok(f"RLIMIT_MEMLOCK is {allowed >> 20} MiB")
    return _warning(
        f"CAP_IPC_LOCK is not granted and RLIMIT_MEMLOCK is {allowed >> 10} KiB: the loop's memory is not locked",
        f"echo '* - memlock unlimited' >> {_LIMITS}   # then log in again; in a unit: LimitMEMLOCK=infinity",
    )


def _capable(case: Case, number: int) -> bool:
    text = case.host.fields("/proc/self/status").get("CapEff", "")
    return bool(whole(text, "/proc/self/status, CapEff,", 16) >> number & 1)


def _outermost(case: Case) -> bool:
    """Return whether capabilities count outside: those of a user namespace do not reach scheduler and memory."""
    # A kernel without user namespaces has no such file.
    return case.host.text_or("/proc/self/uid_map", "0 0 4294967295").split() == ["0", "0", "4294967295"]


def _limit(case: Case, name: str) -> int | None:
    """Return a soft limit of /proc/self/limits, None for unlimited."""
    match = re.search(rf"^{name} +(\S+)", case.host.text("/proc/self/limits"), re.MULTILINE)
    if match is None:
        raise NotKnown(f"/proc/self/limits has no line {name!r}")
    return None if match[1] == "unlimited" else whole(match[1], f"/proc/self/limits, {name},")


# -- memory -----------------------------------------------------------------------------------------------------

_HUGE = "/sys/kernel/mm/transparent_hugepage/enabled"


def _swap(case: Case) -> Result:
    lines = case.host.word("/proc/swaps").splitlines()[1:]
    areas = [line.split()[0] for line in lines if line.strip()]
    if not areas:
        return _ok("no swap is in use")
    return _note(
        f"swap is on ({', '.join(areas)}): locked memory stays, but the gateway and other programs may be slow",
        "swapoff -a",
        f"sed -i '/\\sswap\\s/s/^[^#]/#&/' /etc/fstab{_KEPT}",
    )


def _huge_pages(case: Case) -> Result | None:
    if not case.host.exists(_HUGE):
        return None
    text = case.host.text(_HUGE)
    chosen = re.search(r"\[(\w+)\]", text)
    if chosen is None:
        raise NotKnown(f"{_HUGE} holds {text[:40]!r}, no choice in brackets")
    if chosen[1] != "always":
        return _ok(f"transparent huge pages: {chosen[1]}")
    return _note("transparent huge pages: always", f"echo madvise > {_HUGE}", _at_boot(_HUGE, "madvise"))


# -- the machine: its heat, and a Jetson's power mode and clocks ------------------------------------------------

_ZONES = "/sys/class/thermal"
_CLOSE_C = 10.0
"""A zone is close to its trip point when it is less than this below it."""
_POWER_STATUS = "/var/lib/nvpmodel/status"


def _is_jetson(host: Host) -> bool:
    return "jetson" in host.text_or("/proc/device-tree/model", "").lower()


def _heat(case: Case) -> Result | None:
    host, jetson = case.host, _is_jetson(case.host)
    zones = [f"{_ZONES}/{name}" for name in host.names(_ZONES) if name.startswith("thermal_zone")]
    measured = [(celsius, zone) for zone in zones if (celsius := _celsius(host, f"{zone}/temp")) is not None]
    if not measured:
        if zones:
            raise NotKnown(f"no zone of {_ZONES} tells its temperature")
        return _note("this host shows no temperature") if jetson else None
    margins = [(trip - celsius, celsius, zone) for celsius, zone in measured if (trip := _trip(host, zone)) is not None]
    if not margins:
        celsius, zone = max(measured)
        return _note(
            f"the hottest zone ({_kind(host, zone)}) has {celsius:.0f} C; no zone tells when it is slowed down"
        )
    margin, celsius, zone = min(margins)
    fact = f"{_kind(host, zone)} has {celsius:.0f} C and is slowed down at {celsius + margin:.0f} C"
    if margin >= _CLOSE_C:
        return _ok(fact)
    remedy = (*(("jetson_clocks --fan",) if jetson else ()), "# cool it: a fan, a larger heat sink, less load")
    return _bad(fact, *remedy) if margin <= 0 else _warning(fact, *remedy)


def _celsius(host: Host, path: str) -> float | None:
    """Return a temperature; None for a sensor that is asleep, as a Jetson's are with their block switched off."""
    try:
        return host.integer(path) / 1000
    except NotKnown:
        return None


def _kind(host: Host, zone: str) -> str:
    return host.text_or(f"{zone}/type", "") or zone.rpartition("/")[2]


def _trip(host: Host, zone: str) -> float | None:
    """Return the lowest temperature at which the kernel slows the zone down."""
    limits = []
    for file in host.names(zone):
        point = re.fullmatch(r"(trip_point_\d+)_type", file)
        # A passive trip point slows down; an active one starts a fan; critical and hot switch off.
        if point is not None and host.text_or(f"{zone}/{file}", "") == "passive":
            limits.append(_celsius(host, f"{zone}/{point[1]}_temp") or 0.0)
    return min((celsius for celsius in limits if celsius > 0), default=None)


def _power_mode(case: Case) -> Result | None:
    if not _is_jetson(case.host):
        return None
    status = case.host.word(_POWER_STATUS)
    mode = re.fullmatch(r"pmode:0*(\d+)", status)
    if mode is None:
        raise NotKnown(f"{_POWER_STATUS} holds {status[:40]!r}, not pmode:NUMBER")
    modes = case.host.text_or("/etc/nvpmodel.conf", "")
    named = re.search(rf"< POWER_MODEL ID={mode[1]} NAME=(\S+) >", modes)
    fact = f"power mode {mode[1]}{f' ({named[1]})' if named else ''}"
    if mode[1] == "0":  # without limits on most boards
        return _ok(fact)
    return _warning(f"{fact}: fewer CPUs or lower clocks than the board has", f"nvpmodel -m 0{_KEPT}")


def _jetson_clocks(case: Case) -> Result | None:
    if not _is_jetson(case.host):
        return None
    slowest, fastest = _frequencies(case)
    if slowest == fastest:
        return _ok(f"CPU {case.cpu} is held at {fastest} MHz")
    return _warning(
        f"CPU {case.cpu} may run at {slowest} to {fastest} MHz",
        "jetson_clocks",
        "# kept after a restart: a unit of systemd with ExecStart=/usr/bin/jetson_clocks, After=nvpmodel.service",
    )


# -- the platform that is running -------------------------------------------------------------------------------


def _compiled(case: Case) -> Result:
    if case.build.is_used:
        return _ok("the cycle runs compiled")
    fact = f"the cycle runs as source: {case.build.reason}"
    return (_warning if case.build.is_stale else _note)(fact, "make fast   # needs a C compiler")


def _skipped_ticks(case: Case) -> Result | None:
    if case.blackboard is None or not case.blackboard.exists():
        return None
    from rtcp.ipc.observer import BlackboardError, Observer  # here: numpy loads slowly
    from rtcp.realtime.statistics import diagnose_records

    try:
        observer = Observer(case.blackboard)
    except BlackboardError as error:
        raise NotKnown(str(error)) from error
    try:
        diagnosis = diagnose_records(observer.since(0)[0], observer.period_ns)
    finally:
        observer.close()
    if diagnosis is None:
        return _ok("the running platform skips less than 0.1 % of its ticks")
    return (_bad if diagnosis.share >= _UNUSABLE_SHARE else _warning)(diagnosis.message, f"# {diagnosis.remedy}")


_UNUSABLE_SHARE = 0.05
"""Share of skipped ticks from which on the loop does not keep its cycle."""

CHECKS = (
    Check("preempt-rt", _preempt_rt,
          "without it a driver or a system call of another program holds the cycle up for hundreds of us, at times ms"),
    Check("rt-throttling", _throttling, "a real-time thread that has used its share waits until the period is over"),
    Check("clock-source", _clock_source,
          "every cycle reads the clock several times; a slow source costs a us or more at each reading"),
    Check("hypervisor", _hypervisor,
          "while the host below runs something else no cycle runs, and nothing in here can prevent it"),
    Check("isolated-cpu", _isolated_cpu,
          "on a CPU of its own a Jetson AGX Orin stays below 20 us in every load; on a shared one it exceeds 100 us"),
    Check("cpu-permitted", _cpu_permitted, "an unpinned loop wanders from CPU to CPU, with cold caches each time"),
    Check("tick", _tick, "each tick interrupts the cycle for a few us, 100 to 1000 times a second"),
    Check("governor", _governor,
          "a cycle sleeps most of its time: the CPU is clocked down, and the next cycle computes slowly"),
    Check("idle-states", _idle_states, "waking up takes as long as the deepest state that the CPU may enter"),
    Check("smt", _smt, "what runs on the other half of the core slows the cycle down, by how much changes with it"),
    Check("other-interrupts", _other_interrupts,
          "each of them holds the cycle up for as long as its handler runs, whatever the loop's priority"),
    Check("irqbalance", _irqbalance, "it moves interrupts every few seconds, also onto the cycle's CPU"),
    Check("card-interrupt", _card_interrupt,
          "a loop that waits for its frame keeps a thread of lower rank off its CPU, which would bring that frame"),
    Check("interface", _of_interface(_interface),
          "no frame reaches a slave without a link; EtherCAT is 100 Mbit/s, full duplex"),
    Check("driver", _of_interface(_driver),
          "others keep 250 us cycles within 5 us on an i210, and find the I219 late (SOEM#330); USB asks every 125 us"),
    Check("coalescing", _of_interface(_coalescing),
          "a frame that the card keeps back is one that the loop takes for late or lost"),
    Check("other-traffic", _of_interface(_other_traffic),
          "a foreign frame delays the cycle's by up to 123 us at 100 Mbit/s; slaves pass on what is not EtherCAT"),
    Check("ip-address", _of_interface(_ip_address), "ARP, neighbour discovery and DHCP share the cable with the cycle"),
    Check("network-services", _of_interface(_network_services),
          "they probe the interface, and take it down and up when nobody answers"),
    Check("raw-frames", _raw_frames, "EtherCAT frames go through a packet socket, which needs CAP_NET_RAW"),
    Check("priority", _priority,
          "an ordinary thread waits for every other program that wants its CPU, for milliseconds"),
    Check("memory-lock", _memory_lock,
          "a page that was taken away is fetched back in the middle of a cycle, from a disk it takes milliseconds"),
    Check("swap", _swap, "what was swapped out comes back from a disk, milliseconds later"),
    Check("huge-pages", _huge_pages, "the kernel stops a program while it copies its pages together into large ones"),
    Check("heat", _heat, "a CPU that is too hot is clocked down until it is not, in the middle of a motion"),
    Check("power-mode", _power_mode, "a lower mode switches CPUs off and bounds the clocks of the others"),
    Check("jetson-clocks", _jetson_clocks,
          "else memory and CPU clocks follow the load, and a short cycle looks like none"),
    Check("compiled", _compiled, "the interpreter takes about twice the time for each cycle"),
    Check("skipped-ticks", _skipped_ticks,
          "a skipped tick delays the motion by a cycle; the drives bridge one, not many"),
)  # fmt: skip
