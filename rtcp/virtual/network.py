"""The cable: a veth pair or the loopback in its own network namespace, with or without root.

The kernel removes both with the last process in the namespace, also after SIGKILL.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

MASTER_END = "ecat0"
SEGMENT_END = "ecat0-seg"
"""Names of both ends inside the segment's namespace."""
LOOPBACK = "lo"
LONGEST_NAME = 15
CLONE_NEWUSER = 0x10000000
CLONE_NEWNET = 0x40000000
IFF_UP = 0x01
IFF_NOARP = 0x80
WHAT_TO_ALLOW = (
    "allow user namespaces (sysctl user.max_user_namespaces above 0; kernel.unprivileged_userns_clone=1 and "
    "kernel.apparmor_restrict_unprivileged_userns=0 where they exist), or run as root or with CAP_NET_ADMIN, "
    "CAP_NET_RAW and CAP_SYS_ADMIN"
)


class NetworkError(Exception):
    """The cable cannot be created; the message is a sentence with the remedy."""


def _unshare(flags: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(ctypes.c_int(flags)):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _forbidden(error: OSError) -> NetworkError:
    return NetworkError(
        f"the system refuses a network namespace of this process's own ({error.strerror}): {WHAT_TO_ALLOW}"
    )


def _own_namespace() -> None:
    """Move this process to a new network namespace, with a user namespace if rights are missing.

    Raises:
        NetworkError: the system forbids both.
    """
    try:
        _unshare(CLONE_NEWNET)
        return
    except PermissionError:
        pass
    except OSError as error:
        raise _forbidden(error) from error
    uid, gid = os.getuid(), os.getgid()
    try:
        _unshare(CLONE_NEWUSER | CLONE_NEWNET)
        Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
        Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1", encoding="ascii")
        Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1", encoding="ascii")
    except OSError as error:
        raise _forbidden(error) from error


def _without_ipv6(name: str) -> None:
    """Switch IPv6 off on an interface: only EtherCAT frames travel on it."""
    # Without IPv6 in the kernel, or with a read-only /proc, a stray router solicitation does no harm.
    with suppress(OSError):
        Path(f"/proc/sys/net/ipv6/conf/{name}/disable_ipv6").write_text("1", encoding="ascii")


def _bring_up(links: Any, name: str) -> None:
    """Bring an interface up, without ARP."""
    flags = IFF_UP | IFF_NOARP
    links.link("set", index=links.link_lookup(ifname=name)[0], flags=flags, change=flags)


def _prepare(links: Any, name: str) -> None:
    _without_ipv6(name)
    _bring_up(links, name)


def _refused(error: Exception) -> NetworkError:
    return NetworkError(f"the virtual cable cannot be made ({error}): {WHAT_TO_ALLOW}")


Pair = tuple[str, str, Callable[[], None]]
"""Name of the master's end, name of the segment's end, function that brings the master's end up."""


@contextmanager
def private_pair() -> Iterator[Pair]:
    """Move this process to a new namespace and create a veth pair there.

    A master reaches its end by joining this process's namespaces (/proc/PID/ns/user and /proc/PID/ns/net). Must be
    called while the process has a single thread.

    Raises:
        NetworkError: the system forbids it.
    """
    _own_namespace()
    from pyroute2 import IPRoute, NetlinkError  # slow to load, and only the segment needs it

    with IPRoute() as links:
        try:
            links.link("add", ifname=MASTER_END, kind="veth", peer={"ifname": SEGMENT_END})
            _without_ipv6(MASTER_END)
            _prepare(links, SEGMENT_END)
        except NetlinkError as error:
            raise _refused(error) from error
        yield MASTER_END, SEGMENT_END, partial(_bring_up, links, MASTER_END)


def private_loopback() -> str:
    """Move this process to a new namespace and bring up its loopback; return the loopback's name.

    Another process reaches it as it reaches a private pair. Must be called while the process has a single thread.

    Raises:
        NetworkError: the system forbids it.
    """
    _own_namespace()
    from pyroute2 import IPRoute, NetlinkError  # slow to load

    with IPRoute() as links:
        try:
            links.link("set", index=links.link_lookup(ifname=LOOPBACK)[0], state="up")
        except NetlinkError as error:
            raise _refused(error) from error
    return LOOPBACK


@contextmanager
def public_pair(name: str) -> Iterator[Pair]:
    """Create the master's end as `name` in the caller's network; move this process and the other end out of it.

    The pair is removed at the end. Needs the right to administer the network.

    Raises:
        NetworkError: the name is taken or too long, or the right is missing.
    """
    if not 0 < len(name.encode()) <= LONGEST_NAME or "/" in name or name.split() != [name]:
        raise NetworkError(f"--interface {name!r} is no interface name: 1 to {LONGEST_NAME} bytes without / and spaces")
    from pyroute2 import IPRoute, NetlinkError  # slow to load, and only the segment needs it

    if name in (existing for _, existing in socket.if_nameindex()):
        raise NetworkError(f"--interface {name} exists already: choose another name, or remove it with 'ip link del'")
    temporary = f"seg{os.getpid()}"[:LONGEST_NAME]
    with IPRoute() as outside:
        try:
            outside.link("add", ifname=name, kind="veth", peer={"ifname": temporary})
        except NetlinkError as error:
            if error.code == errno.EEXIST:
                raise NetworkError(f"--interface {name} exists already: choose another name") from error
            raise NetworkError(
                f"--interface {name} needs the right to administer the network ({error}): run as root or with "
                "CAP_NET_ADMIN, CAP_NET_RAW and CAP_SYS_ADMIN"
            ) from error
        # Until the other end is in a namespace that ends with this process, it must be removed here.
        try:
            # Still in the caller's namespace, whose /proc/sys/net is not reachable later.
            _without_ipv6(name)
            index = outside.link_lookup(ifname=temporary)[0]
            _unshare(CLONE_NEWNET)
            with open("/proc/self/ns/net", "rb") as own:
                outside.link("set", index=index, net_ns_fd=own.fileno())
            with IPRoute() as inside:
                inside.link("set", index=inside.link_lookup(ifname=temporary)[0], ifname=SEGMENT_END)
                _prepare(inside, SEGMENT_END)
            yield name, SEGMENT_END, partial(_bring_up, outside, name)
        except (OSError, NetlinkError) as error:
            raise _refused(error) from error
        finally:
            remaining = outside.link_lookup(ifname=name)
            if remaining:
                outside.link("del", index=remaining[0])
