"""The cycle's CPU: that it is there, alone, fast and awake."""

from __future__ import annotations

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.cpu_list import format_cpus, named, parse_cpus
from rtcp.realtime.doctor.finding import Check, Verdict, bad, note, ok, warning
from rtcp.realtime.doctor.host import NotKnown
from rtcp.realtime.doctor.mending import TMPFILES, at_boot, kernel_arguments

_CPUS = "/sys/devices/system/cpu"
_LATENCY = "/dev/cpu_dma_latency"
_SHALLOW_US = 10
"""An idle state that is left within so long costs less than the 40 us that the loop wakes early."""


def isolation(case: Case) -> Verdict:
    """Ask whether the scheduler leaves the cycle's CPU to the cycle."""
    host, cpu = case.host, case.cpu
    online = host.cpus(f"{_CPUS}/online")
    if cpu not in online:
        return bad(
            f"the cycle is to run on CPU {cpu}, and this host has {named(online)}",
            f"# in the arm's file: cycle: {{cpu: {max(online, default=0)}}}",
        )
    if len(online) == 1:
        return warning("this host has one CPU, which the cycle shares with everything else")
    isolated = host.cpus(f"{_CPUS}/isolated")
    if cpu in isolated:
        return ok(f"CPU {cpu} of the cycle is isolated")
    if isolated:
        return warning(
            f"isolated is {named(isolated)}, and the cycle is to run on CPU {cpu}",
            f"# in the arm's file: cycle: {{cpu: {max(isolated)}}}",
        )
    words = (
        f"isolcpus=managed_irq,domain,{cpu} nohz_full={cpu} rcu_nocbs={cpu} irqaffinity={format_cpus(online - {cpu})}"
    )
    return warning(
        f"no CPU is isolated; the cycle is to run on CPU {cpu}",
        *kernel_arguments(host, words),
        f"# and in the arm's file: cycle: {{cpu: {cpu}}}",
    )


def permitted(case: Case) -> Verdict:
    """Ask whether a process started from here may use the cycle's CPU; an isolated one the loop takes by itself."""
    if case.cpu in case.host.cpus(f"{_CPUS}/isolated"):
        return ok(f"CPU {case.cpu} is isolated, and the loop may ask for it")
    fields = case.host.fields("/proc/self/status")
    allowed = _listed(fields.get("Cpus_allowed_list", ""))
    if case.cpu in allowed:
        return ok(f"this process may use CPU {case.cpu}")
    return warning(
        f"this process may use {named(allowed)}, not CPU {case.cpu}: the loop would not be pinned",
        f"taskset -c {format_cpus(allowed | {case.cpu})} rtcp start   # in a unit: CPUAffinity=",
    )


def _listed(text: str) -> frozenset[int]:
    try:
        cpus = parse_cpus(text)
    except ValueError as error:
        raise NotKnown(f"/proc/self/status: {error}") from error
    if not cpus:
        raise NotKnown("/proc/self/status names no CPU that this process may use")
    return cpus


def tick(case: Case) -> Verdict:
    """Ask whether the scheduler's tick leaves the cycle's CPU alone."""
    path = f"{_CPUS}/nohz_full"
    if not case.host.exists(path):
        return note("this kernel cannot switch the tick off (it is built without CONFIG_NO_HZ_FULL)")
    tickless = case.host.cpus(path)
    if case.cpu in tickless:
        return ok(f"CPU {case.cpu} runs without the tick")
    found = f"CPU {case.cpu} has the scheduler's tick; without it is {named(tickless)}"
    if case.cpu not in case.host.cpus(f"{_CPUS}/isolated"):
        return note(found)  # what isolates the CPU takes the tick from it, too
    return note(found, *kernel_arguments(case.host, f"nohz_full={case.cpu} rcu_nocbs={case.cpu}"))


def governor(case: Case) -> Verdict:
    """Ask whether the CPU keeps its frequency."""
    folder = f"{_CPUS}/cpu{case.cpu}/cpufreq"
    if not case.host.exists(folder):
        return note(f"nothing in this system sets the frequency of CPU {case.cpu} (the firmware may)")
    chosen = case.host.word(f"{folder}/scaling_governor")
    if chosen == "performance":
        return ok(f"CPU {case.cpu} is governed by performance")
    return warning(
        f"CPU {case.cpu} is governed by {chosen}{_range(case, folder)}",
        f"echo performance > {folder}/scaling_governor",
        at_boot(f"{folder}/scaling_governor", "performance"),
    )


def _range(case: Case, folder: str) -> str:
    try:
        slowest, fastest = (case.host.integer(f"{folder}/scaling_{end}_freq") for end in ("min", "max"))
    except NotKnown:
        return ""
    return f", {slowest / 1000:.0f} to {fastest / 1000:.0f} MHz"


def idle(case: Case) -> Verdict:
    """Ask how deep the CPU may sleep, and whether the loop can forbid it."""
    host = case.host
    folder = f"{_CPUS}/cpu{case.cpu}/cpuidle"
    states = [name for name in host.names(folder) if name.startswith("state")]
    if not states:
        return note(f"nothing in this system puts CPU {case.cpu} to sleep deeper than its halt instruction")
    deep = {}
    for state in states:
        latency_us = host.integer(f"{folder}/{state}/latency")
        off = host.exists(f"{folder}/{state}/disable") and host.integer(f"{folder}/{state}/disable") == 1
        if latency_us > _SHALLOW_US and not off:
            deep[host.word(f"{folder}/{state}/name")] = latency_us
    if not deep:
        return ok(f"CPU {case.cpu} wakes from every idle state within {_SHALLOW_US} us")
    told = ", ".join(f"{name} {latency_us} us" for name, latency_us in deep.items())
    try:
        host.may_write(_LATENCY)
    except NotKnown as reason:
        return warning(
            f"CPU {case.cpu} may sleep deep (wakes from {told}), and the loop cannot forbid it: {reason}",
            "groupadd -f rtcp && usermod -aG rtcp USER   # USER: who starts the platform",
            f"echo 'z {_LATENCY} 0660 root rtcp -' >> {TMPFILES}   # kept after a restart",
            f"systemd-tmpfiles --create {TMPFILES}",
        )
    return ok(f"CPU {case.cpu} may sleep deep ({told}); the loop forbids it while it runs ({_LATENCY} at 0)")


def siblings(case: Case) -> Verdict:
    """Ask whether another CPU shares the cycle's core."""
    path = f"{_CPUS}/cpu{case.cpu}/topology/thread_siblings_list"
    others = case.host.cpus(path) - {case.cpu}
    if not others:
        return ok(f"CPU {case.cpu} has its core to itself")
    return warning(
        f"CPU {case.cpu} shares its core with {named(others)} (SMT)",
        f"echo off > {_CPUS}/smt/control",
        *kernel_arguments(case.host, "nosmt"),
    )


CHECKS = (
    Check(
        "isolated-cpu",
        "on a CPU of its own a Jetson AGX Orin stays below 20 us in every load; on a shared one it exceeds 100 us",
        isolation,
    ),
    Check(
        "cpu-permitted",
        "an unpinned loop wanders from CPU to CPU, with cold caches each time",
        permitted,
    ),
    Check("tick", "each tick interrupts the cycle for a few us, 100 to 1000 times a second", tick),
    Check(
        "governor",
        "a cycle sleeps most of its time: the CPU is clocked down, and the next cycle computes slowly",
        governor,
    ),
    Check("idle-states", "waking up takes as long as the deepest state that the CPU may enter", idle),
    Check("smt", "what runs on the other half of the core slows the cycle down, by how much changes with it", siblings),
)
