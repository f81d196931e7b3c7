"""Who interrupts the cycle's CPU, and whether the network card's interrupt outranks the loop."""

from __future__ import annotations

from dataclasses import dataclass

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.cpu_list import format_cpus, named
from rtcp.realtime.doctor.finding import Check, Verdict, bad, note, ok, warning
from rtcp.realtime.doctor.host import Host, NotKnown, whole
from rtcp.realtime.doctor.mending import kernel_arguments

_ISOLATED = "/sys/devices/system/cpu/isolated"
_ONLINE = "/sys/devices/system/cpu/online"
_CARD_PRIORITY = 90
"""Above the loop's 80, as KickCAT has it."""
_SCHED_FIFO, _SCHED_RR = 1, 2
_NAMED = 4
"""So many interrupts are told by name; the others are counted."""


@dataclass(frozen=True)
class Interrupt:
    """A line of /proc/interrupts: its number, how often it came on the cycle's CPU, and whose it is."""

    number: int
    here: int
    owner: str


def interrupts(host: Host, cpu: int) -> list[Interrupt]:
    """Return the devices' interrupts.

    Raises:
        NotKnown: there is no such table, or it has no column of this CPU.
    """
    lines = host.word("/proc/interrupts").splitlines()
    columns = lines[0].split()
    if f"CPU{cpu}" not in columns:
        raise NotKnown(f"/proc/interrupts has no column of CPU {cpu}")
    found = []
    for line in lines[1:]:
        number, _, rest = line.partition(":")
        words = rest.split()
        counts, owner = words[: len(columns)], " ".join(words[len(columns) :])
        if number.strip().isdecimal() and len(counts) == len(columns) and all(map(str.isdecimal, counts)):
            here = whole(counts[columns.index(f"CPU{cpu}")], "/proc/interrupts")
            found.append(Interrupt(whole(number, "/proc/interrupts"), here, owner))
    return found


def others(case: Case) -> Verdict:
    """Ask which devices other than the bus' card interrupt the cycle's CPU."""
    host = case.host
    online = host.cpus(_ONLINE)
    if len(online) == 1:
        return note("this host has one CPU, which takes all interrupts")
    cards = _of_the_card(case)
    found = [
        each
        for each in interrupts(host, case.cpu)
        if each not in cards and each.here and case.cpu in _handled_on(host, each.number)
    ]
    if not found:
        return ok(f"no device interrupts CPU {case.cpu}")
    told = ", ".join(f"{each.number} ({_short(each.owner)})" for each in found[:_NAMED])
    more = f" and {len(found) - _NAMED} others" if len(found) > _NAMED else ""
    elsewhere = format_cpus(online - {case.cpu})
    return warning(
        f"CPU {case.cpu} takes the interrupts {told}{more}",
        f"for n in {' '.join(str(each.number) for each in found)}; do echo {elsewhere} > "
        "/proc/irq/$n/smp_affinity_list; done   # refused for interrupts that are bound to a CPU",
        # Where the CPU is not isolated yet, the words that isolate it have this one among them.
        *(kernel_arguments(host, f"irqaffinity={elsewhere}") if case.cpu in host.cpus(_ISOLATED) else ()),
    )


def balancer(case: Case) -> Verdict:
    """Ask whether something moves the interrupts about."""
    if "irqbalance" not in case.host.processes():
        return ok("irqbalance does not run")
    isolated = case.host.cpus(_ISOLATED)
    if case.cpu in isolated:
        return ok(f"irqbalance runs and leaves isolated CPUs alone, CPU {case.cpu} among them")
    return warning(f"irqbalance runs and may put any interrupt on CPU {case.cpu}", "systemctl disable --now irqbalance")


def card(case: Case) -> Verdict:
    """Ask where the card's interrupt is handled, and whether its thread outranks a loop on the same CPU."""
    if case.interface is None:
        return note("does not apply: the bus is virtual")
    host = case.host
    mine = _of_the_card(case)
    if not mine:
        raise NotKnown(f"/proc/interrupts names none of {case.interface}")
    places = {each.number: _handled_on(host, each.number) for each in mine}
    here = [number for number, cpus in places.items() if case.cpu in cpus]
    threads = {number: _thread_of(host, number) for number in here}
    told = "; ".join(f"{number} on {named(cpus)}" for number, cpus in places.items())
    low = {pid: rank for pid, rank in filter(None, threads.values()) if rank <= case.priority}
    if low:
        return bad(
            f"{case.interface}'s interrupts: {told}; on CPU {case.cpu} its thread has priority {min(low.values())} and "
            f"the loop {case.priority}",
            *(f"chrt -f -p {_CARD_PRIORITY} {pid}" for pid in low),
        )
    if not here:
        return ok(f"{case.interface}'s interrupts: {told}, not on CPU {case.cpu} of the cycle")
    how = "by threads that outrank the loop" if any(threads.values()) else "at once, not by threads"
    return ok(f"{case.interface}'s interrupts: {told}, handled {how}")


def _of_the_card(case: Case) -> list[Interrupt]:
    """Return the interrupts whose name is the interface's or its device's, or which its PCI function lists."""
    if case.interface is None:
        return []
    folder = f"/sys/class/net/{case.interface}"
    listed = set(case.host.names(f"{folder}/device/msi_irqs"))
    names = [case.interface]
    try:
        names.append(case.host.target(f"{folder}/device"))
    except NotKnown:
        pass  # an interface without a device, as of a bridge
    return [
        each
        for each in interrupts(case.host, case.cpu)
        if str(each.number) in listed or any(_belongs(word, name) for word in each.owner.split() for name in names)
    ]


def _belongs(word: str, name: str) -> bool:
    """Return whether a word of an interrupt's name is the name, or the name and a queue: eth0, eth0-TxRx-1."""
    return word.startswith(name) and not word[len(name) : len(name) + 1].isalnum()


def _handled_on(host: Host, number: int) -> frozenset[int]:
    """Return the CPUs that take an interrupt: where it goes in effect, else where it may go."""
    folder = f"/proc/irq/{number}"
    try:
        return host.cpus(f"{folder}/effective_affinity_list") or host.cpus(f"{folder}/smp_affinity_list")
    except NotKnown:
        return host.cpus(f"{folder}/smp_affinity_list")


def _thread_of(host: Host, number: int) -> tuple[int, int] | None:
    """Return process number and real-time priority of an interrupt's thread, None where it has none."""
    for name, pids in host.processes().items():
        if name.startswith(f"irq/{number}-"):
            # proc(5): after the name in brackets, fields 40 and 41 are the priority and the policy.
            words = host.text(f"/proc/{pids[0]}/stat").rpartition(")")[2].split()
            where = f"/proc/{pids[0]}/stat"
            if len(words) < 39:
                raise NotKnown(f"{where} has no scheduling policy")
            rank, policy = whole(words[37], where), whole(words[38], where)
            return pids[0], rank if policy in (_SCHED_FIFO, _SCHED_RR) else 0
    return None


def _short(owner: str) -> str:
    return owner.rsplit(maxsplit=1)[-1] if owner else "unnamed"


CHECKS = (
    Check(
        "other-interrupts",
        "each of them holds the cycle up for as long as its handler runs, whatever the loop's priority",
        others,
    ),
    Check("irqbalance", "it moves interrupts every few seconds, also onto the cycle's CPU", balancer),
    Check(
        "card-interrupt",
        "a loop that waits for its frame keeps a thread of lower rank off its CPU, which would bring that frame",
        card,
    ),
)
