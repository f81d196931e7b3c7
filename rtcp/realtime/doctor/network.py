"""The bus' network card: that it is there, carries frames, and brings each one at once."""

from __future__ import annotations

from collections.abc import Callable

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Verdict, bad, note, ok, warning
from rtcp.realtime.doctor.host import NotKnown

_NET = "/sys/class/net"
_DYNAMIC = {"igb": range(1, 4), "igc": range(1, 4), "e1000": range(1, 5), "e1000e": range(1, 5)}
"""Small numbers are not us in Intel's drivers but kinds of a rate that follows the traffic (kernel documentation,
e1000e, InterruptThrottleRate)."""
_PLAIN_E1000E = ("0x10d3", "0x10f6")
"""82574L, a card of its own; other chips of this driver are the chipset's own port (I217, I218, I219)."""


def asked_of_a_card(look: Callable[[Case, str], Verdict]) -> Callable[[Case], Verdict]:
    """Let a check say that it does not apply to the virtual bus, and that it knows nothing of a missing interface."""

    def asked(case: Case) -> Verdict:
        if case.interface is None:
            return note("does not apply: the bus is virtual")
        if not case.host.exists(f"{_NET}/{case.interface}"):
            raise NotKnown(f"there is no interface {case.interface}")
        return look(case, case.interface)

    return asked


def present(case: Case) -> Verdict:
    """Ask whether the interface is there, up, and has a link of 100 Mbit/s or more, both ways at once."""
    name = case.interface
    if name is None:
        return note("does not apply: the bus is virtual")
    host, folder = case.host, f"{_NET}/{name}"
    if not host.exists(folder):
        there = ", ".join(each for each in host.names(_NET) if each != "lo") or "none"
        return bad(f"there is no interface {name}; there are: {there}", "rtcp doctor --bus NAME")
    if host.text(f"{folder}/operstate") == "down" and not _administratively_up(case, folder):
        return bad(f"{name} is switched off", f"ip link set {name} up")
    if host.integer(f"{folder}/carrier") != 1:
        return bad(f"{name} has no link: no cable, or no slave with power at its other end")
    speed, duplex = host.integer(f"{folder}/speed"), host.text(f"{folder}/duplex")
    if speed <= 0:
        return note(f"{name} is up and has a link; its driver tells no speed")
    found = f"{name} is up and has a link of {speed} Mbit/s, {duplex} duplex"
    if duplex == "half" or speed < 100:
        return bad(found, f"ethtool -s {name} speed 100 duplex full autoneg on")
    return ok(found)


def _administratively_up(case: Case, folder: str) -> bool:
    flags = case.host.text(f"{folder}/flags")
    try:
        return bool(int(flags, 16) & 1)  # IFF_UP
    except ValueError as error:
        raise NotKnown(f"{folder}/flags holds {flags[:40]!r}, not a number") from error


def driver(case: Case, name: str) -> Verdict:
    """Ask what kind of card it is."""
    host, folder = case.host, f"{_NET}/{name}"
    if host.exists(f"{folder}/wireless") or host.exists(f"{folder}/phy80211"):
        return bad(f"{name} is a wireless interface: EtherCAT needs a cable", "rtcp doctor --bus NAME")
    if not host.exists(f"{folder}/device"):
        return note(f"{name} is no hardware (a bridge, one end of a veth pair, or the like)")
    kind = host.target(f"{folder}/device/driver")
    if host.target(f"{folder}/device/subsystem") == "usb":
        return bad(
            f"{name} is an adapter at a USB port (driver {kind})",
            "# use a port of the board or a PCIe card, an Intel i210 best of all",
        )
    if kind == "igb":
        return ok(f"{name} is driven by igb (Intel i210 and its kin)")
    if kind == "e1000e":
        chip = host.text(f"{folder}/device/device")
        if chip in _PLAIN_E1000E:
            return ok(f"{name} is an Intel 82574L (driver e1000e)")
        return warning(
            f"{name} is driven by e1000e and is chip {chip}: most are an I219 or its kin, part of the chipset",
            "# use a PCIe card, an Intel i210 best of all",
        )
    return note(f"{name} is driven by {kind}, of which nothing is known here: the times in `rtcp status` tell")


def coalescing(case: Case, name: str) -> Verdict:
    """Ask how long the card holds frames back."""
    found = case.card.coalescing(name)
    if found is None:
        return ok(f"the driver of {name} has no coalescing to set")
    times = f"rx-usecs {found.receive_us}, tx-usecs {found.send_us}{', adaptive' if found.adaptive else ''}"
    if not (found.receive_us or found.send_us or found.adaptive):
        return ok(f"{name} reports every frame at once ({times})")
    adaptive = " adaptive-rx off adaptive-tx off" if found.adaptive else ""
    command = f"ethtool -C {name}{adaptive} rx-usecs 0 tx-usecs 0"
    match = f"/etc/systemd/network/50-{name}.link"
    mend = (
        command,
        f"printf '[Match]\\nOriginalName={name}\\n[Link]\\nRxCoalesceSec=0\\nTxCoalesceSec=0\\n' > {match}"
        "   # kept after a restart",
    )
    kind = _driver_or_none(case, name)
    if kind in _DYNAMIC and found.receive_us in _DYNAMIC[kind]:
        return warning(f"{name} holds frames back for a time that follows the traffic ({times}, {kind})", *mend)
    if found.receive_us + found.send_us >= case.wait_us:
        return bad(
            f"{name} holds frames back for up to {found.receive_us + found.send_us} us ({times}), and the loop waits "
            f"{case.wait_us:g} us for its frame",
            *mend,
        )
    return warning(f"{name} holds frames back ({times})", *mend)


def _driver_or_none(case: Case, name: str) -> str | None:
    try:
        return case.host.target(f"{_NET}/{name}/device/driver")
    except NotKnown:
        return None


CHECKS = (
    Check("interface", "no frame reaches a slave without a link; EtherCAT is 100 Mbit/s, full duplex", present),
    Check(
        "driver",
        "others keep 250 us cycles within 5 us on an i210, and find the I219 late (SOEM#330); USB asks every 125 us",
        asked_of_a_card(driver),
    ),
    Check(
        "coalescing",
        "a frame that the card keeps back is one that the loop takes for late or lost",
        asked_of_a_card(coalescing),
    ),
)
