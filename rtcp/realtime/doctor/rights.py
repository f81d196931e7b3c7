"""What the kernel grants this process: packet sockets, a real-time priority, locked memory."""

from __future__ import annotations

import re

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Verdict, bad, ok, warning
from rtcp.realtime.doctor.host import NotKnown, whole

# linux/capability.h
_NET_ADMIN, _NET_RAW, _IPC_LOCK, _SYS_NICE = 12, 13, 14, 23
_WHOLE = "4294967295"
_LIMITS = "/etc/security/limits.d/90-rtcp.conf"
_NEEDED_BYTES = 512 << 20
"""What the loop's process maps, with room: mlockall counts all of it."""
_CAPABLE = (
    "rtcp service install   # as a service it has its rights; else, for an ordinary user:",
    "install -m 755 $(readlink -f $(command -v python3)) /usr/local/bin/rtcp-python",
    "setcap cap_net_admin,cap_net_raw,cap_sys_nice,cap_ipc_lock+ep /usr/local/bin/rtcp-python  # make the venv with it",
)


def raw_frames(case: Case) -> Verdict:
    """Ask whether a packet socket may be opened, and the interface made promiscuous, as SOEM does."""
    lacking = [
        name for name, bit in (("CAP_NET_RAW", _NET_RAW), ("CAP_NET_ADMIN", _NET_ADMIN)) if not _capable(case, bit)
    ]
    if not lacking:
        return ok("CAP_NET_RAW and CAP_NET_ADMIN are granted")
    found = f"{' and '.join(lacking)} {'is' if len(lacking) == 1 else 'are'} not granted"
    if case.interface is None:
        return ok(f"{found}, which the virtual bus does without")
    return bad(f"{found}: {case.interface} cannot be opened", *_CAPABLE)


def priority(case: Case) -> Verdict:
    """Ask whether the loop may have its priority."""
    if _capable(case, _SYS_NICE) and _outermost(case):
        return ok("CAP_SYS_NICE is granted")
    allowed = _limit(case, "Max realtime priority")
    if allowed is None or allowed >= case.priority:
        return ok(f"RLIMIT_RTPRIO allows SCHED_FIFO {case.priority}")
    within = " outside this user namespace" if not _outermost(case) else ""
    return bad(
        f"SCHED_FIFO {case.priority} is refused: CAP_SYS_NICE is not granted{within}, and RLIMIT_RTPRIO is {allowed}",
        f"echo '* - rtprio {case.priority}' >> {_LIMITS}   # then log in again; in a unit: LimitRTPRIO={case.priority}",
    )


def locked_memory(case: Case) -> Verdict:
    """Ask whether the loop may keep its memory from being swapped out."""
    if _capable(case, _IPC_LOCK) and _outermost(case):
        return ok("CAP_IPC_LOCK is granted")
    allowed = _limit(case, "Max locked memory")
    if allowed is None:
        return ok("RLIMIT_MEMLOCK is unlimited")
    if allowed >= _NEEDED_BYTES:
        return ok(f"RLIMIT_MEMLOCK is {allowed >> 20} MiB")
    return warning(
        f"CAP_IPC_LOCK is not granted and RLIMIT_MEMLOCK is {allowed >> 10} KiB: the loop's memory is not locked",
        f"echo '* - memlock unlimited' >> {_LIMITS}   # then log in again; in a unit: LimitMEMLOCK=infinity",
    )


def _capable(case: Case, number: int) -> bool:
    text = case.host.fields("/proc/self/status").get("CapEff", "")
    try:
        return bool(int(text, 16) >> number & 1)
    except ValueError as error:
        raise NotKnown(f"/proc/self/status has no CapEff in hexadecimal, but {text[:40]!r}") from error


def _outermost(case: Case) -> bool:
    """Return whether capabilities count outside: those of a user namespace do not reach scheduler and memory."""
    try:
        return case.host.text("/proc/self/uid_map").split() == ["0", "0", _WHOLE]
    except NotKnown:
        return True  # a kernel without user namespaces


def _limit(case: Case, name: str) -> int | None:
    """Return a soft limit of /proc/self/limits, None for unlimited."""
    found = re.search(rf"^{name} +(\S+)", case.host.text("/proc/self/limits"), re.MULTILINE)
    if found is None:
        raise NotKnown(f"/proc/self/limits has no line {name!r}")
    return None if found[1] == "unlimited" else whole(found[1], f"/proc/self/limits, {name},")


CHECKS = (
    Check("raw-frames", "EtherCAT frames go through a packet socket, which needs CAP_NET_RAW", raw_frames),
    Check(
        "priority",
        "an ordinary thread waits for every other program that wants its CPU, for milliseconds",
        priority,
    ),
    Check(
        "memory-lock",
        "a page that was taken away is fetched back in the middle of a cycle, from a disk it takes milliseconds",
        locked_memory,
    ),
)
