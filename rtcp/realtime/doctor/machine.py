"""The machine itself: its heat, and a Jetson's power mode and clocks."""

from __future__ import annotations

import re

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Verdict, bad, note, ok, warning
from rtcp.realtime.doctor.host import Host, NotKnown

_ZONES = "/sys/class/thermal"
_MODEL = "/proc/device-tree/model"
_CLOSE_C = 10.0
"""Less than this below a trip point is close."""
_POWER_STATUS = "/var/lib/nvpmodel/status"
_POWER_MODES = "/etc/nvpmodel.conf"


def is_jetson(host: Host) -> bool:
    """Return whether the board is one of NVIDIA's."""
    try:
        return "jetson" in host.text(_MODEL).lower()
    except NotKnown:
        return False


def heat(case: Case) -> Verdict | None:
    """Ask how far the hottest zone is from the temperature at which it is slowed down."""
    host = case.host
    zones = [name for name in host.names(_ZONES) if name.startswith("thermal_zone")]
    measured = [(celsius, name) for name in zones if (celsius := _celsius(host, f"{_ZONES}/{name}/temp")) is not None]
    if not measured:
        if zones:
            raise NotKnown(f"no zone of {_ZONES} tells its temperature")
        return note("this host shows no temperature") if is_jetson(host) else None
    margins = [(trip - celsius, celsius, name) for celsius, name in measured if (trip := _trip(host, name)) is not None]
    if not margins:
        celsius, name = max(measured)
        return note(f"the hottest zone ({_kind(host, name)}) has {celsius:.0f} C; no zone tells when it is slowed down")
    margin, celsius, name = min(margins)
    found = f"{_kind(host, name)} has {celsius:.0f} C and is slowed down at {celsius + margin:.0f} C"
    mend = "# cool it: a fan, a larger heat sink, less load"
    fan = ("jetson_clocks --fan",) if is_jetson(host) else ()
    if margin <= 0:
        return bad(found, *fan, mend)
    if margin < _CLOSE_C:
        return warning(found, *fan, mend)
    return ok(found)


def _celsius(host: Host, path: str) -> float | None:
    """Return a temperature; None for a sensor that is asleep, as a Jetson's are with their block switched off."""
    try:
        return host.integer(path) / 1000
    except NotKnown:
        return None


def _kind(host: Host, name: str) -> str:
    try:
        return host.word(f"{_ZONES}/{name}/type")
    except NotKnown:
        return name


def _trip(host: Host, name: str) -> float | None:
    """Return the lowest temperature at which the kernel slows the zone down."""
    found = []
    for file in host.names(f"{_ZONES}/{name}"):
        point = re.fullmatch(r"trip_point_(\d+)_type", file)
        if point is None or (celsius := _celsius(host, f"{_ZONES}/{name}/trip_point_{point[1]}_temp")) is None:
            continue
        try:
            # A passive trip point slows down; an active one starts a fan; critical and hot switch off.
            if host.text(f"{_ZONES}/{name}/{file}") == "passive" and celsius > 0:
                found.append(celsius)
        except NotKnown:
            continue
    return min(found, default=None)


def power_mode(case: Case) -> Verdict | None:
    """Ask for a Jetson's power mode: mode 0 is the one without limits on most of them."""
    host = case.host
    if not is_jetson(host):
        return None
    status = host.word(_POWER_STATUS)
    mode = re.fullmatch(r"pmode:0*(\d+)", status)
    if mode is None:
        raise NotKnown(f"{_POWER_STATUS} holds {status[:40]!r}, not pmode:NUMBER")
    found = f"power mode {mode[1]}{_mode_name(host, mode[1])}"
    if mode[1] == "0":
        return ok(found)
    return warning(f"{found}: fewer CPUs or lower clocks than the board has", "nvpmodel -m 0   # kept after a restart")


def _mode_name(host: Host, number: str) -> str:
    try:
        named = re.search(rf"< POWER_MODEL ID={number} NAME=(\S+) >", host.text(_POWER_MODES))
    except NotKnown:
        return ""
    return f" ({named[1]})" if named else ""


def clocks(case: Case) -> Verdict | None:
    """Ask whether a Jetson's clocks are held up: jetson_clocks raises the lowest frequency to the highest."""
    if not is_jetson(case.host):
        return None
    folder = f"/sys/devices/system/cpu/cpu{case.cpu}/cpufreq"
    slowest, fastest = (case.host.integer(f"{folder}/scaling_{end}_freq") for end in ("min", "max"))
    if slowest == fastest:
        return ok(f"CPU {case.cpu} is held at {fastest / 1000:.0f} MHz")
    return warning(
        f"CPU {case.cpu} may run at {slowest / 1000:.0f} to {fastest / 1000:.0f} MHz",
        "jetson_clocks",
        "# kept after a restart: a unit of systemd with ExecStart=/usr/bin/jetson_clocks, After=nvpmodel.service",
    )


CHECKS = (
    Check("heat", "a CPU that is too hot is clocked down until it is not, in the middle of a motion", heat),
    Check("power-mode", "a lower mode switches CPUs off and bounds the clocks of the others", power_mode),
    Check("jetson-clocks", "memory and CPU clocks follow the load else, and a short cycle looks like none", clocks),
)
