"""Who else uses the bus' cable."""

from __future__ import annotations

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Verdict, bad, note, ok, warning
from rtcp.realtime.doctor.host import NotKnown
from rtcp.realtime.doctor.mending import sysctl
from rtcp.realtime.doctor.network import asked_of_a_card

_NET = "/sys/class/net"
_WATCHED_S = 0.5
_ETHERCAT = "88a4"


def packets(case: Case, name: str) -> Verdict:
    """Ask whether frames come or go while no master runs; takes half a second."""
    host = case.host
    if _master_runs(case, name):
        return note(f"not counted: an EtherCAT master is using {name}")
    before = _counted(case, name)
    host.wait(_WATCHED_S)
    received, sent = (now - then for now, then in zip(_counted(case, name), before, strict=True))
    if received == sent == 0:
        return ok(f"{name} was silent for {_WATCHED_S:g} s")
    return warning(
        f"{received} frames came and {sent} went on {name} within {_WATCHED_S:g} s, none of them this platform's",
        f"tcpdump -c 20 -e -i {name}   # shows whose they are",
    )


def _counted(case: Case, name: str) -> tuple[int, int]:
    folder = f"{_NET}/{name}/statistics"
    return case.host.integer(f"{folder}/rx_packets"), case.host.integer(f"{folder}/tx_packets")


def _master_runs(case: Case, name: str) -> bool:
    """Return whether a packet socket for EtherCAT is open on the interface (packet(7), /proc/net/packet)."""
    number = str(case.host.integer(f"{_NET}/{name}/ifindex"))
    try:
        lines = case.host.text("/proc/net/packet").splitlines()[1:]
    except NotKnown:
        return False
    return any(words[3:5] == [_ETHERCAT, number] for words in map(str.split, lines))


def address(case: Case, name: str) -> Verdict:
    """Ask whether the interface takes part in IPv4 or IPv6."""
    found = []
    mend: tuple[str, ...] = ()
    if plain := case.card.address(name):
        found.append(plain)
        mend += (f"ip -4 address flush dev {name}",)
    if case.host.exists("/proc/net/if_inet6"):
        lines = map(str.split, case.host.text("/proc/net/if_inet6").splitlines())
        if any(words[5:6] == [name] for words in lines):
            found.append("an IPv6 address")
            mend += sysctl(f"net.ipv6.conf.{name.replace('.', '/')}.disable_ipv6=1")  # sysctl.d(5): a dot in a name
    if not found:
        return ok(f"{name} has no IP address")
    if _leads_out(case, name):
        return bad(
            f"{name} has {' and '.join(found)} and the default route: it is this host's way to its network, not a bus",
            "rtcp doctor --bus NAME",
        )
    return warning(f"{name} has {' and '.join(found)}: the system sends its own frames there", *mend)


def _leads_out(case: Case, name: str) -> bool:
    """Return whether the default route goes through the interface: its destination is 00000000 there."""
    try:
        lines = case.host.text("/proc/net/route").splitlines()[1:]
    except NotKnown:
        return False
    return any(words[:2] == [name, "00000000"] for words in map(str.split, lines))


def services(case: Case, name: str) -> Verdict:
    """Ask which services look after the interface."""
    host = case.host
    running = host.processes()
    found, mend = [], []
    if "NetworkManager" in running and _managed(case, name):
        found.append("NetworkManager manages it")
        mend += [
            f"nmcli device set {name} managed no",
            f"printf '[keyfile]\\nunmanaged-devices=interface-name:{name}\\n' > /etc/NetworkManager/conf.d/90-rtcp.conf"
            "   # kept after a restart",
        ]
    if "avahi-daemon" in running:
        found.append("avahi-daemon announces services on every interface with an address")
        mend.append(f"sed -i '/^\\[server\\]/a deny-interfaces={name}' /etc/avahi/avahi-daemon.conf")
        mend.append("systemctl restart avahi-daemon")
    if not found:
        return ok(f"neither NetworkManager nor avahi looks after {name}")
    return warning(f"{name}: {', and '.join(found)}", *mend)


def _managed(case: Case, name: str) -> bool:
    """Return whether NetworkManager says that it manages the interface; it may, where it does not say."""
    number = case.host.integer(f"{_NET}/{name}/ifindex")
    try:
        state = case.host.text(f"/run/NetworkManager/devices/{number}")
    except NotKnown:
        return True
    return "managed=false" not in state.splitlines()


CHECKS = (
    Check(
        "other-traffic",
        "a foreign frame delays the cycle's by up to 123 us at 100 Mbit/s; slaves pass on what is not EtherCAT",
        asked_of_a_card(packets),
    ),
    Check("ip-address", "ARP, neighbour discovery and DHCP share the cable with the cycle", asked_of_a_card(address)),
    Check(
        "network-services",
        "they probe the interface, and take it down and up when nobody answers",
        asked_of_a_card(services),
    ),
)
