"""Three hosts as folders of files, and what the doctor says of them: kernel, CPUs, memory, rights, heat."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rtcp.realtime.doctor import Case, Severity, examine
from rtcp.realtime.host import Host

CPUS = "sys/devices/system/cpu"
CLOCK = "sys/devices/system/clocksource/clocksource0"
ZONE = "sys/class/thermal/thermal_zone0"


def test_nothing_stands_in_the_way_on_a_pc_that_was_set_up(good: Any) -> None:
    assert {f.key: f.found for f in good.findings().values() if f.severity is not Severity.OK} == {}


def test_what_stands_in_the_way_on_a_jetson_as_it_is_delivered(jetson: Any) -> None:
    found = {f.key for f in jetson.findings().values() if f.severity >= Severity.WARNING}
    assert found == {"preempt-rt", "isolated-cpu", "governor", "heat", "power-mode", "jetson-clocks"}


def test_what_keeps_the_loop_from_its_cycle_on_a_laptop(laptop: Any) -> None:
    found = {f.key for f in laptop.findings().values() if f.severity is Severity.BAD}
    assert found == {"card-interrupt", "driver", "raw-frames", "priority"}


def test_what_makes_cycles_late_on_a_laptop(laptop: Any) -> None:
    found = {f.key for f in laptop.findings().values() if f.severity is Severity.WARNING}
    assert found == {
        "preempt-rt", "clock-source", "isolated-cpu", "cpu-permitted", "governor", "idle-states", "smt",
        "other-interrupts", "irqbalance", "ip-address", "network-services", "memory-lock",
    }  # fmt: skip


@pytest.mark.parametrize("kind", ["jetson", "laptop"])
def test_every_finding_that_stands_in_the_way_comes_with_what_mends_it(
    patient: Callable[[str], Any], kind: str
) -> None:
    bare = [f.key for f in patient(kind).findings().values() if f.severity >= Severity.WARNING and not f.remedy]
    assert bare == []


@pytest.mark.parametrize("kind", ["good", "jetson", "laptop"])
def test_no_finding_that_is_well_comes_with_something_to_mend(patient: Callable[[str], Any], kind: str) -> None:
    assert [f.key for f in patient(kind).findings().values() if f.severity is Severity.OK and f.remedy] == []


def test_this_machine_is_examined_without_an_exception() -> None:
    assert len(examine(Case(Host(), cpu=0, priority=80, interface=None, wait_us=150.0))) > 20


def test_a_host_that_tells_nothing_is_not_known_and_not_bad(tmp_path: Path) -> None:
    case = Case(Host(tmp_path), cpu=3, priority=80, interface=None, wait_us=150.0)
    assert max(finding.severity for finding in examine(case)) is Severity.NOTE


def test_a_missing_file_is_not_known_with_its_name_and_the_reason(good: Any) -> None:
    good.put({"proc/version": None})
    assert good.finding("preempt-rt").found == "not known: /proc/version: No such file or directory"


def test_a_malformed_file_is_not_known_with_what_it_holds(good: Any) -> None:
    good.put({"proc/sys/kernel/sched_rt_runtime_us": "95o000"})
    assert good.finding("rt-throttling").found == (
        "not known: /proc/sys/kernel/sched_rt_runtime_us holds '95o000', not a number"
    )


def test_a_file_that_cannot_be_read_is_not_known(good: Any) -> None:
    good.put({"proc/swaps": None})
    (good.root / "proc/swaps").mkdir()
    assert good.finding("swap").found == "not known: /proc/swaps: Is a directory"


# -- the kernel -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", ["PREEMPT_RT", "PREEMPT RT"])
def test_a_real_time_kernel_is_known_by_its_version_alone(good: Any, build: str) -> None:
    good.put({"sys/kernel/realtime": None, "proc/version": f"Linux version 5.15.1-rt (gcc) #1 SMP {build} Tue"})
    assert good.severity("preempt-rt") is Severity.OK


def test_a_kernel_that_is_merely_preemptible_is_told_from_a_real_time_kernel(laptop: Any) -> None:
    found = laptop.finding("preempt-rt").found
    assert found == "Linux 6.8.0-45-generic is not a PREEMPT_RT kernel (PREEMPT_DYNAMIC)"


def test_a_jetson_gets_the_repository_of_its_own_release(jetson: Any) -> None:
    assert "jetson/rt-kernel r36.4 main" in jetson.finding("preempt-rt").remedy[0]


@pytest.mark.parametrize(("identity", "command"), [("ubuntu", "pro enable"), ("debian", "linux-image-rt-amd64")])
def test_a_distribution_gets_the_name_of_its_own_real_time_kernel(good: Any, identity: str, command: str) -> None:
    good.put(
        {
            "sys/kernel/realtime": "0",
            "proc/version": "Linux version 6.8 (gcc) #1 SMP PREEMPT",
            "etc/os-release": f"ID={identity}",
        }
    )
    assert command in good.finding("preempt-rt").remedy[0]


@pytest.mark.parametrize(
    ("runtime", "severity"),
    [("-1", Severity.OK), ("950000", Severity.OK), ("500000", Severity.WARNING), ("0", Severity.BAD)],
)
def test_the_less_time_real_time_threads_have_the_worse(good: Any, runtime: str, severity: Severity) -> None:
    good.put({"proc/sys/kernel/sched_rt_runtime_us": runtime})
    assert good.severity("rt-throttling") is severity


def test_the_throttle_is_told_in_milliseconds(laptop: Any) -> None:
    assert "950 of every 1000 ms" in laptop.finding("rt-throttling").found


def test_a_setting_is_made_now_and_for_good(laptop: Any) -> None:
    laptop.put({"proc/sys/kernel/sched_rt_runtime_us": "500000"})
    assert laptop.finding("rt-throttling").remedy == (
        "sysctl -w kernel.sched_rt_runtime_us=950000",
        "echo 'kernel.sched_rt_runtime_us=950000' >> /etc/sysctl.d/90-rtcp.conf   # kept after a restart",
    )


def test_a_slow_clock_beside_a_fast_one_is_exchanged(laptop: Any) -> None:
    assert laptop.finding("clock-source").remedy[0] == f"echo tsc > /{CLOCK}/current_clocksource"


def test_a_slow_clock_is_a_warning_also_where_there_is_no_other(good: Any) -> None:
    good.put({f"{CLOCK}/current_clocksource": "hpet", f"{CLOCK}/available_clocksource": "hpet acpi_pm"})
    assert "tsc=reliable" in " ".join(good.finding("clock-source").remedy)


def test_a_virtual_machine_is_known_by_its_cpus_flag(good: Any) -> None:
    good.put({"proc/cpuinfo": "flags : fpu tsc hypervisor"})
    assert good.severity("hypervisor") is Severity.WARNING


def test_stolen_time_is_told_as_a_share_of_all(good: Any) -> None:
    good.put({"proc/stat": "cpu 100 0 100 700 0 0 0 100 0 0"})
    assert "it took 10 % of all CPU time since boot" in good.finding("hypervisor").found


# -- the cycle's CPU ------------------------------------------------------------------------------------------------


def test_a_cpu_that_the_host_does_not_have_is_bad(good: Any) -> None:
    finding = good.finding("isolated-cpu", cpu=7)
    assert (finding.severity, finding.found) == (
        Severity.BAD,
        "the cycle is to run on CPU 7, and this host has CPUs 0-3",
    )


def test_an_isolated_cpu_that_the_cycle_does_not_use_is_named(good: Any) -> None:
    finding = good.finding("isolated-cpu", cpu=1)
    assert finding.found == "isolated is CPU 3, and the cycle is to run on CPU 1"
    assert finding.remedy == ("# in the arm's file: cycle: {cpu: 3}",)


@pytest.mark.parametrize(
    ("file", "command"),
    [
        (
            "boot/extlinux/extlinux.conf",
            "sed -i '/^ *APPEND /s/$/ {words}/' /boot/extlinux/extlinux.conf   # then reboot",
        ),
        ("boot/firmware/cmdline.txt", "sed -i '1s/$/ {words}/' /boot/firmware/cmdline.txt   # then reboot"),
        (
            "etc/default/grub",
            "sed -i 's/^GRUB_CMDLINE_LINUX=\"/&{words} /' /etc/default/grub && update-grub   # then reboot",
        ),
    ],
)
def test_the_kernels_command_line_is_changed_where_this_host_keeps_it(good: Any, file: str, command: str) -> None:
    good.put({"etc/default/grub": None, f"{CPUS}/isolated": ""})
    good.put({file: ""})
    words = "isolcpus=managed_irq,domain,3 nohz_full=3 rcu_nocbs=3 irqaffinity=0-2"
    assert good.finding("isolated-cpu").remedy[0] == command.format(words=words)


def test_where_the_boot_loader_is_not_known_the_words_are_told(good: Any) -> None:
    good.put({"etc/default/grub": None, f"{CPUS}/isolated": ""})
    assert good.finding("isolated-cpu").remedy[0].startswith("# in the boot loader's settings")


def test_a_host_with_one_cpu_cannot_isolate_it(good: Any) -> None:
    good.put({f"{CPUS}/online": "0", f"{CPUS}/isolated": ""})
    assert (
        good.finding("isolated-cpu", cpu=0).found
        == "this host has one CPU, which the cycle shares with everything else"
    )


def test_a_process_that_may_not_use_the_cycles_cpu_is_told_how_it_may(laptop: Any) -> None:
    finding = laptop.finding("cpu-permitted")
    assert finding.found == "this process may use CPUs 0-2, not CPU 3: the loop would not be pinned"
    assert finding.remedy[0].startswith("taskset -c 0-3 rtcp start")


def test_the_ticks_cpus_are_compared_with_the_cycles(good: Any) -> None:
    good.put({f"{CPUS}/nohz_full": "1-2"})
    assert good.finding("tick").found == "CPU 3 has the scheduler's tick; without it is CPUs 1-2"


def test_a_governor_is_told_with_its_frequencies(laptop: Any) -> None:
    assert laptop.finding("governor").found == "CPU 3 is governed by powersave, 800 to 3600 MHz"


def test_the_governor_is_set_for_the_cycles_cpu_and_kept(laptop: Any) -> None:
    path = f"/{CPUS}/cpu3/cpufreq/scaling_governor"
    assert laptop.finding("governor").remedy[0] == f"echo performance > {path}"
    assert f"'w {path} - - - - performance'" in laptop.finding("governor").remedy[1]


def test_deep_sleep_is_no_harm_where_the_loop_can_forbid_it(good: Any) -> None:
    finding = good.finding("idle-states")
    assert (finding.severity, "C6 133 us" in finding.found) == (Severity.OK, True)


def test_deep_sleep_that_the_loop_cannot_forbid_is_a_warning(laptop: Any) -> None:
    assert "cannot forbid it: /dev/cpu_dma_latency: No such file" in laptop.finding("idle-states").found


def test_an_idle_state_that_is_switched_off_does_not_count(laptop: Any) -> None:
    laptop.put({f"{CPUS}/cpu3/cpuidle/state1/disable": "1"})
    assert laptop.severity("idle-states") is Severity.OK


def test_deep_sleep_is_allowed_to_be_forbidden_at_every_boot(laptop: Any) -> None:
    assert "'z /dev/cpu_dma_latency 0660 root rtcp -'" in laptop.finding("idle-states").remedy[1]


@pytest.mark.parametrize("key", ["governor", "idle-states"])
def test_a_cpu_that_the_system_neither_clocks_down_nor_puts_to_sleep_is_a_note(good: Any, key: str) -> None:
    for folder in ("cpufreq", "cpuidle"):
        shutil.rmtree(good.root / CPUS / "cpu3" / folder)
    assert good.severity(key) is Severity.NOTE


def test_the_other_half_of_the_core_is_named(laptop: Any) -> None:
    assert laptop.finding("smt").found == "CPU 3 shares its core with CPU 1 (SMT)"


# -- memory and rights ----------------------------------------------------------------------------------------------


def test_swap_is_a_note_with_its_place(laptop: Any) -> None:
    finding = laptop.finding("swap")
    assert (finding.severity, "/swap.img" in finding.found) == (Severity.NOTE, True)


def test_pages_that_are_always_merged_are_a_note(laptop: Any) -> None:
    assert laptop.severity("huge-pages") is Severity.NOTE


def test_a_kernel_without_huge_pages_is_not_asked_for_them(good: Any) -> None:
    good.put({"sys/kernel/mm/transparent_hugepage/enabled": None})
    assert "huge-pages" not in good.findings()


def test_without_the_right_to_make_the_card_promiscuous_no_frame_is_sent(good: Any) -> None:
    status = (good.root / "proc/self/status").read_text()
    good.put({"proc/self/status": status.replace("807000", "806000")})
    finding = good.finding("raw-frames")
    assert finding.severity is Severity.BAD
    assert "CAP_NET_ADMIN is not granted" in finding.found


def test_the_virtual_bus_does_without_raw_frames(laptop: Any) -> None:
    assert laptop.severity("raw-frames", interface=None) is Severity.OK


def test_a_limit_that_reaches_the_loops_priority_is_as_good_as_the_capability(laptop: Any) -> None:
    limits = (laptop.root / "proc/self/limits").read_text()
    laptop.put({"proc/self/limits": limits.replace("Max realtime priority     0", "Max realtime priority     80")})
    assert laptop.severity("priority") is Severity.OK


def test_a_limit_below_the_loops_priority_is_bad(good: Any) -> None:
    limits = (good.root / "proc/self/limits").read_text().replace("priority     0", "priority     79")
    good.put({"proc/self/status": "CapEff: 0", "proc/self/limits": limits})
    assert good.finding("priority").found.endswith("RLIMIT_RTPRIO is 79")


@pytest.mark.parametrize(("key", "severity"), [("priority", Severity.BAD), ("memory-lock", Severity.WARNING)])
def test_a_capability_of_a_user_namespace_reaches_neither_scheduler_nor_memory(
    good: Any, key: str, severity: Severity
) -> None:
    good.put({"proc/self/uid_map": "0 1000 1"})
    assert good.severity(key) is severity


def test_unlimited_locked_memory_is_as_good_as_the_capability(laptop: Any) -> None:
    limits = (laptop.root / "proc/self/limits").read_text().replace("8388608", "unlimited")
    laptop.put({"proc/self/limits": limits})
    assert laptop.severity("memory-lock") is Severity.OK


def test_locked_memory_is_told_in_kibibytes(laptop: Any) -> None:
    assert "RLIMIT_MEMLOCK is 8192 KiB" in laptop.finding("memory-lock").found


# -- heat and a Jetson's clocks -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("millicelsius", "severity"), [("84000", Severity.OK), ("86000", Severity.WARNING), ("95000", Severity.BAD)]
)
def test_the_nearer_to_being_slowed_down_the_worse(good: Any, millicelsius: str, severity: Severity) -> None:
    good.put({f"{ZONE}/temp": millicelsius})
    assert good.severity("heat") is severity


def test_the_zone_nearest_to_being_slowed_down_is_told_not_the_hottest(good: Any) -> None:
    other = ZONE.replace("0", "1")
    good.put({f"{ZONE}/temp": "70000", f"{other}/type": "soc", f"{other}/temp": "60000"})
    good.put({f"{other}/trip_point_0_type": "passive", f"{other}/trip_point_0_temp": "65000"})
    assert good.finding("heat").found == "soc has 60 C and is slowed down at 65 C"


def test_a_temperature_that_switches_off_is_not_one_that_slows_down(good: Any) -> None:
    good.put({f"{ZONE}/trip_point_0_type": "critical", f"{ZONE}/temp": "90000"})
    assert good.severity("heat") is Severity.NOTE


def test_a_pc_is_not_asked_for_a_jetsons_power_mode(good: Any) -> None:
    assert good.findings().keys().isdisjoint({"power-mode", "jetson-clocks"})


def test_a_power_mode_is_told_by_number_and_name(jetson: Any) -> None:
    assert jetson.finding("power-mode").found.startswith("power mode 2 (MODE_30W)")


def test_the_mode_without_limits_is_well(jetson: Any) -> None:
    jetson.put({"var/lib/nvpmodel/status": "pmode:0000"})
    assert jetson.severity("power-mode") is Severity.OK


def test_clocks_that_are_held_at_their_most_are_well(jetson: Any) -> None:
    jetson.put({f"{CPUS}/cpu3/cpufreq/scaling_min_freq": "3600000"})
    assert jetson.severity("jetson-clocks") is Severity.OK
