"""The kernel: its preemption, its throttle on real-time threads, its clock."""

from __future__ import annotations

import re

from rtcp.realtime.doctor.case import Case
from rtcp.realtime.doctor.finding import Check, Verdict, bad, note, ok, warning
from rtcp.realtime.doctor.host import NotKnown, whole
from rtcp.realtime.doctor.mending import kernel_arguments, sysctl

_JETSON_RELEASE = "/etc/nv_tegra_release"
_JETSON_SOURCES = "/etc/apt/sources.list.d/nvidia-l4t-apt-source.list"
"""Jetson Linux Developer Guide, "Installing Real-Time Kernel"."""
_GOOD_CLOCKS = ("tsc", "arch_sys_counter")
"""Read from a register without leaving user space, on x86 and on ARM."""
_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies")


def preempt_rt(case: Case) -> Verdict:
    """Ask whether the kernel can be interrupted nearly everywhere."""
    host = case.host
    version = host.word("/proc/version")
    release = version.split(" ")[2] if version.count(" ") >= 2 else version
    if host.exists("/sys/kernel/realtime") and host.text("/sys/kernel/realtime") == "1":
        return ok(f"PREEMPT_RT, Linux {release}")
    if re.search("PREEMPT[_ ]RT", version):
        return ok(f"PREEMPT_RT, Linux {release}")
    kind = next((word for word in version.split() if word.startswith("PREEMPT")), "no preemption named")
    return warning(f"Linux {release} is not a PREEMPT_RT kernel ({kind})", *_rt_kernel(case))


def _rt_kernel(case: Case) -> tuple[str, ...]:
    host = case.host
    if host.exists(_JETSON_RELEASE):
        # "# R36 (release), REVISION: 4.3, ...": the repository is called r36.4.
        named = re.search(r"R(\d+) \(release\), REVISION: (\d+)", host.text(_JETSON_RELEASE))
        repository = f"r{named[1]}.{named[2]}" if named else "RELEASE"
        return (
            f"echo 'deb https://repo.download.nvidia.com/jetson/rt-kernel {repository} main' >> {_JETSON_SOURCES}",
            "apt update && apt install nvidia-l4t-rt-kernel nvidia-l4t-rt-kernel-headers "
            "nvidia-l4t-rt-kernel-oot-modules nvidia-l4t-display-rt-kernel   # then reboot",
        )
    try:
        release = host.text("/etc/os-release")
    except NotKnown:
        release = ""
    if "ID=ubuntu" in release.splitlines():
        return ("pro attach && pro enable realtime-kernel   # then reboot",)
    if "ID=debian" in release.splitlines():
        machine = "arm64" if host.exists("/proc/device-tree/model") else "amd64"
        return (f"apt install linux-image-rt-{machine}   # then reboot",)
    return ("# install the distribution's kernel with PREEMPT_RT; Linux 6.12 and newer have it: CONFIG_PREEMPT_RT=y",)


def throttling(case: Case) -> Verdict:
    """Ask how much of a second real-time threads may have."""
    runtime = case.host.integer("/proc/sys/kernel/sched_rt_runtime_us")
    period = case.host.integer("/proc/sys/kernel/sched_rt_period_us")
    if runtime < 0:
        return ok("real-time threads are not throttled")
    share = f"real-time threads may have {runtime / 1000:g} of every {period / 1000:g} ms of a CPU"
    mend = sysctl(f"kernel.sched_rt_runtime_us={period * 95 // 100}")
    if runtime == 0:
        return bad(share, *mend)
    if runtime < 0.9 * period:
        return warning(share, *mend)
    return ok(f"{share}: more than a cycle takes, and a loop that runs away does not hang the CPU")


def clock_source(case: Case) -> Verdict:
    """Ask which counter the kernel's clock is read from."""
    folder = "/sys/devices/system/clocksource/clocksource0"
    current = case.host.word(f"{folder}/current_clocksource")
    if current in _GOOD_CLOCKS:
        return ok(f"the clock is read from {current}")
    available = case.host.text(f"{folder}/available_clocksource").split()
    better = next((name for name in _GOOD_CLOCKS if name in available), None)
    if better is not None:
        return warning(
            f"the clock is read from {current} though {better} is there",
            f"echo {better} > {folder}/current_clocksource",
            *kernel_arguments(case.host, f"clocksource={better}"),
        )
    if current in _SLOW_CLOCKS:
        found = f"the clock is read from {current}, and the kernel offers no faster one"
        if "tsc" in (case.host.text("/proc/cpuinfo") if case.host.exists("/proc/cpuinfo") else "").split():
            return warning(
                f"{found}: it found the CPU's own counter (tsc) unstable (dmesg | grep -i tsc)",
                *kernel_arguments(case.host, "tsc=reliable"),
            )
        return warning(found)
    return note(f"the clock is read from {current}")


def stolen(case: Case) -> Verdict:
    """Ask whether a hypervisor takes the CPU away."""
    host = case.host
    line = host.word("/proc/stat").splitlines()[0].split()
    if line[0] != "cpu" or len(line) < 9:
        raise NotKnown("/proc/stat does not begin with the times of all CPUs")
    times = [whole(word, "/proc/stat") for word in line[1:9]]
    total, steal = sum(times), times[7]
    share = f"it took {100 * steal / total:.2g} % of all CPU time since boot" if total else "no time has passed"
    flags = host.text("/proc/cpuinfo").split() if host.exists("/proc/cpuinfo") else []
    if "hypervisor" in flags or host.exists("/sys/hypervisor/type") or steal:
        return warning(
            f"this is a virtual machine: the host below takes its CPUs away when it likes ({share})",
            "# run the loop on hardware; else, on the host below, pin each virtual CPU to a CPU of its own",
        )
    return ok("no hypervisor is seen")


CHECKS = (
    Check(
        "preempt-rt",
        "without it a driver or a system call of another program holds the cycle up for hundreds of us, at times ms",
        preempt_rt,
    ),
    Check(
        "rt-throttling",
        "a real-time thread that has used its share waits until the period is over",
        throttling,
    ),
    Check(
        "clock-source",
        "every cycle reads the clock several times; a slow source costs a us or more at each reading",
        clock_source,
    ),
    Check(
        "hypervisor",
        "while the host below runs something else no cycle runs, and nothing in here can prevent it",
        stolen,
    ),
)
