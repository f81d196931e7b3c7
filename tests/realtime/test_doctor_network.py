"""What the doctor says of interrupts, of the network card, and of who else uses its cable."""

from __future__ import annotations

import ctypes
import struct
from typing import Any

import pytest

from rtcp.realtime import host
from rtcp.realtime.doctor import Severity
from rtcp.realtime.host import Coalescing, Host, NotKnown

ETH0 = "sys/class/net/eth0"
NETWORK = ("card-interrupt", "interface", "driver", "coalescing", "other-traffic", "ip-address", "network-services")
THREAD = "417 (irq/130-eth0-Tx) S 2" + " 0" * 34 + " 3 {priority} {policy} 0 0"


@pytest.mark.parametrize("key", NETWORK)
def test_on_the_virtual_bus_what_concerns_a_network_card_does_not_apply(laptop: Any, key: str) -> None:
    finding = laptop.finding(key, interface=None)
    assert (finding.severity, finding.found) == (Severity.NOTE, "does not apply: the bus is virtual")


# -- interrupts -----------------------------------------------------------------------------------------------------


def test_a_device_that_interrupts_the_cycles_cpu_is_named(laptop: Any) -> None:
    assert laptop.finding("other-interrupts").found == "CPU 3 takes the interrupts 9 (acpi)"


def test_the_interrupts_are_sent_to_the_other_cpus(laptop: Any) -> None:
    remedy = laptop.finding("other-interrupts").remedy[0]
    assert remedy.startswith("for n in 9; do echo 0-2 > /proc/irq/$n/smp_affinity_list; done")


def test_an_interrupt_that_went_elsewhere_meanwhile_does_not_count(laptop: Any) -> None:
    laptop.put({"proc/irq/9/effective_affinity_list": "1"})
    assert laptop.severity("other-interrupts") is Severity.OK


def test_an_interrupt_that_never_came_does_not_count(good: Any) -> None:
    good.put({"proc/irq/9/effective_affinity_list": "3"})
    assert good.severity("other-interrupts") is Severity.OK


def test_the_cards_own_interrupt_is_no_other_devices(good: Any) -> None:
    assert good.finding("other-interrupts").found == "no device interrupts CPU 3"


def test_irqbalance_is_a_warning(laptop: Any) -> None:
    assert laptop.finding("irqbalance").remedy == ("systemctl disable --now irqbalance",)


def test_irqbalance_leaves_an_isolated_cpu_alone(good: Any) -> None:
    good.put({"proc/800/comm": "irqbalance"})
    assert good.severity("irqbalance") is Severity.OK


@pytest.mark.parametrize(("priority", "severity"), [(81, Severity.OK), (80, Severity.BAD), (50, Severity.BAD)])
def test_the_thread_of_the_cards_interrupt_outranks_the_loop(good: Any, priority: int, severity: Severity) -> None:
    good.put({"proc/417/stat": THREAD.format(priority=priority, policy=1)})
    assert good.severity("card-interrupt") is severity


def test_a_thread_of_the_cards_interrupt_without_real_time_is_outranked(good: Any) -> None:
    good.put({"proc/417/stat": THREAD.format(priority=99, policy=0)})
    assert good.severity("card-interrupt") is Severity.BAD


def test_the_thread_of_the_cards_interrupt_is_raised_by_its_number(laptop: Any) -> None:
    assert laptop.finding("card-interrupt").remedy == ("chrt -f -p 90 417",)


def test_on_another_cpu_the_cards_interrupt_need_not_outrank_the_loop(laptop: Any) -> None:
    laptop.put({"proc/irq/130/effective_affinity_list": "2"})
    assert laptop.severity("card-interrupt") is Severity.OK


def test_an_interrupt_is_the_cards_also_by_the_list_of_its_pci_function(good: Any) -> None:
    table = (good.root / "proc/interrupts").read_text().replace("eth0-TxRx-0", "mystery")
    good.put({"proc/interrupts": table, "sys/devices/pci/0000:01:00.0/msi_irqs/130": "msix"})
    assert "130 on CPU 3" in good.finding("card-interrupt").found


def test_the_interrupt_of_a_longer_name_is_not_the_cards(good: Any) -> None:
    table = (good.root / "proc/interrupts").read_text().replace("eth0-TxRx-0", "eth01")
    good.put({"proc/interrupts": table})
    assert good.finding("card-interrupt").found == "not known: /proc/interrupts names none of eth0"


# -- the card -------------------------------------------------------------------------------------------------------


def test_an_interface_that_is_not_there_is_bad_and_the_others_are_named(good: Any) -> None:
    finding = good.finding("interface", interface="eth7")
    assert (finding.severity, finding.found) == (Severity.BAD, "there is no interface eth7; there are: eth0")


@pytest.mark.parametrize("key", ["driver", "coalescing", "other-traffic", "ip-address", "network-services"])
def test_of_an_interface_that_is_not_there_nothing_else_is_known(good: Any, key: str) -> None:
    assert good.finding(key, interface="eth7").found == "not known: there is no interface eth7"


def test_an_interface_that_is_switched_off_is_switched_on(good: Any) -> None:
    good.put({f"{ETH0}/operstate": "down", f"{ETH0}/flags": "0x1002"})
    assert good.finding("interface").remedy == ("ip link set eth0 up",)


def test_an_interface_without_a_link_is_bad(good: Any) -> None:
    good.put({f"{ETH0}/operstate": "down", f"{ETH0}/carrier": "0"})
    finding = good.finding("interface")
    assert (finding.severity, finding.found[:16]) == (Severity.BAD, "eth0 has no link")


@pytest.mark.parametrize(("speed", "duplex"), [("10", "full"), ("100", "half")])
def test_a_link_that_is_no_ethercat_is_bad(good: Any, speed: str, duplex: str) -> None:
    good.put({f"{ETH0}/speed": speed, f"{ETH0}/duplex": duplex})
    assert good.severity("interface") is Severity.BAD


def test_a_driver_that_tells_no_speed_is_a_note(good: Any) -> None:
    good.put({f"{ETH0}/speed": "-1"})
    assert good.severity("interface") is Severity.NOTE


def test_an_interface_that_is_no_hardware_is_a_note(good: Any) -> None:
    good.put({f"{ETH0}/device": None})
    assert good.severity("driver") is Severity.NOTE


def test_an_adapter_at_a_usb_port_is_bad(laptop: Any) -> None:
    assert laptop.finding("driver").found == "eth0 is an adapter at a USB port (driver r8152)"


def test_a_wireless_interface_is_bad(good: Any) -> None:
    (good.root / ETH0 / "wireless").mkdir()
    assert good.severity("driver") is Severity.BAD


@pytest.mark.parametrize(("chip", "severity"), [("0x15bc", Severity.WARNING), ("0x10d3", Severity.OK)])
def test_the_chipsets_own_port_is_told_from_a_card_of_the_same_driver(good: Any, chip: str, severity: Severity) -> None:
    good.put(
        {
            "sys/devices/pci/0000:01:00.0/driver": "->sys/bus/pci/drivers/e1000e",
            "sys/bus/pci/drivers/e1000e/uevent": "",
            "sys/devices/pci/0000:01:00.0/device": chip,
        }
    )
    assert good.severity("driver") is severity


def test_a_driver_of_which_nothing_is_known_is_a_note(jetson: Any) -> None:
    finding = jetson.finding("driver")
    assert (finding.severity, "nvethernet" in finding.found) == (Severity.NOTE, True)


@pytest.mark.parametrize(
    ("held", "severity"),
    [
        (None, Severity.OK),
        (Coalescing(0, 0, False), Severity.OK),
        (Coalescing(50, 0, False), Severity.WARNING),
        (Coalescing(0, 50, False), Severity.WARNING),
        (Coalescing(0, 0, True), Severity.WARNING),
        (Coalescing(100, 49, False), Severity.WARNING),
        (Coalescing(100, 50, False), Severity.BAD),
    ],
)
def test_a_card_that_holds_frames_back_longer_than_the_loop_waits_is_bad(
    good: Any, held: Coalescing | None, severity: Severity
) -> None:
    good.card.held = held
    assert good.severity("coalescing") is severity


def test_coalescing_is_switched_off_on_this_interface_now_and_for_good(good: Any) -> None:
    good.card.held = Coalescing(3, 0, True)
    now, kept = good.finding("coalescing").remedy
    assert now == "ethtool -C eth0 adaptive-rx off adaptive-tx off rx-usecs 0 tx-usecs 0"
    assert "OriginalName=eth0" in kept


def test_three_us_of_an_intel_card_are_a_rate_that_follows_the_traffic(good: Any) -> None:
    good.card.held = Coalescing(3, 0, False)
    assert "for a time that follows the traffic (rx-usecs 3, tx-usecs 0, igb)" in good.finding("coalescing").found


def test_the_kernel_is_asked_for_the_coalescing_of_an_interface_that_has_none() -> None:
    assert Host().coalescing("lo") is None


def test_the_kernel_is_asked_for_an_address() -> None:
    assert Host().ipv4_address("lo") == "127.0.0.1"


def test_the_kernels_answer_is_read_at_the_places_of_its_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(number: int, request: bytearray) -> None:
        # struct ifreq: a name of 16 bytes, a pointer; struct ethtool_coalesce: rx-usecs is word 1, tx-usecs word 5,
        # use_adaptive_rx_coalesce word 10.
        words = [0x0E, *range(101, 110), 1, *[0] * 12]
        ctypes.memmove(struct.unpack_from("P", request, 16)[0], struct.pack("23I", *words), 92)

    monkeypatch.setattr(host, "_ioctl", answer)
    assert Host().coalescing("eth0") == Coalescing(receive_us=101, send_us=105, adaptive=True)


def test_an_interface_that_the_kernel_does_not_have_is_not_known() -> None:
    with pytest.raises(NotKnown, match="ethtool -c eth77: No such device"):
        Host().coalescing("eth77")


# -- who else uses the cable ----------------------------------------------------------------------------------------


def test_frames_that_come_while_no_master_runs_are_counted(good: Any) -> None:
    good.during = lambda: good.put({f"{ETH0}/statistics/rx_packets": "80", f"{ETH0}/statistics/tx_packets": "13"})
    assert good.finding("other-traffic").found.startswith("3 frames came and 1 went on eth0 within 0.5 s")


def test_frames_are_not_counted_while_a_master_runs(good: Any) -> None:
    good.put({"proc/net/packet": "sk RefCnt Type Proto Iface R Rmem User Inode\nffff 3 3 88a4 2 1 0 0 1234"})
    assert good.finding("other-traffic").found == "not counted: an EtherCAT master is using eth0"


def test_a_master_on_another_interface_does_not_keep_frames_from_being_counted(good: Any) -> None:
    good.put({"proc/net/packet": "sk RefCnt Type Proto Iface R Rmem User Inode\nffff 3 3 88a4 3 1 0 0 1234"})
    assert good.finding("other-traffic").found == "eth0 was silent for 0.5 s"


def test_an_ipv4_address_is_told_and_taken_away(good: Any) -> None:
    good.card.ipv4 = "192.168.1.7"
    finding = good.finding("ip-address")
    assert finding.found == "eth0 has 192.168.1.7: the system sends its own frames there"
    assert finding.remedy == ("ip -4 address flush dev eth0",)


def test_an_ipv6_address_is_switched_off_for_good(laptop: Any) -> None:
    assert laptop.finding("ip-address").remedy[0] == "sysctl -w net.ipv6.conf.eth0.disable_ipv6=1"


def test_a_dot_in_an_interfaces_name_is_written_as_sysctl_wants_it(good: Any) -> None:
    good.put({"sys/class/net/eth0.5/ifindex": "9", "proc/net/if_inet6": "fe80 09 40 20 80 eth0.5"})
    assert "net.ipv6.conf.eth0/5.disable_ipv6=1" in good.finding("ip-address", interface="eth0.5").remedy[0]


def test_the_hosts_way_to_its_own_network_is_not_cut_off(good: Any) -> None:
    good.card.ipv4 = "192.168.1.7"
    good.put({"proc/net/route": "Iface\tDestination\tGateway\neth0\t00000000\t0101A8C0\n"})
    finding = good.finding("ip-address")
    assert (finding.severity, finding.remedy) == (Severity.BAD, ("rtcp doctor --bus NAME",))


def test_an_interface_that_networkmanager_leaves_alone_is_well(good: Any) -> None:
    good.put({"proc/801/comm": "NetworkManager", "run/NetworkManager/devices/2": "[device]\nmanaged=false\n"})
    assert good.severity("network-services") is Severity.OK


def test_networkmanager_is_told_to_leave_this_interface_alone(laptop: Any) -> None:
    assert laptop.finding("network-services").remedy[0] == "nmcli device set eth0 managed no"


def test_avahi_is_named(laptop: Any) -> None:
    assert "avahi-daemon announces" in laptop.finding("network-services").found
