"""`rtcp device`: ESI files listed, device files made and compared with a bus that answers."""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rtcp.config import default_config
from rtcp.config.device_file import file_text, kind_of
from rtcp.config.loader import load_device
from rtcp.config.model import PdoEntry
from rtcp.config.segment import SegmentSlave
from rtcp.esi.model import Pdo, Source
from rtcp.esi.modules import assemble
from rtcp.esi.reader import find_device, read_esi
from rtcp.fieldbus.clocks import sync_cycles
from rtcp.launch import offline
from rtcp.virtual.descriptions import Descriptions
from tests.drive_esi import write_esi
from tests.fieldbus.terminals import write_segment
from tests.required import filled

FILES = Path(__file__).parents[1] / "esi" / "files"
MAKERS = Path(__file__).parents[1] / "makers"
DRIVE, AXES, TERMINALS, ANALOG, SAMPLING = (
    FILES / f"{name}.xml" for name in ("drive", "axes", "terminals", "analog", "sampling")
)


def fill(file: Path) -> None:
    """Fill in what a device's file asks for."""
    file.write_text(filled(file.read_text()))


def test_a_file_is_listed_with_its_devices_modules_and_what_is_hidden(rtcp: Callable[..., Any]) -> None:
    listed = rtcp("device", "list", str(AXES))
    assert "0x00000100   Cyclic position" in listed.out
    assert "Sample Drives, vendor 0x00000E51" in listed.out
    hidden = json.loads(rtcp("device", "list", str(DRIVE), "--all", "--json").out)["devices"]
    devices = json.loads(rtcp("device", "list", str(DRIVE), "--json").out)["devices"]
    assert len(hidden) == len(devices) + 1
    assert {device["kind"] for device in devices} == {"cia402"}


def test_a_drive_becomes_a_file_that_the_platform_reads(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    out = tmp_path / "drive.yaml"
    done = rtcp("device", "new", "--esi", str(DRIVE), "--out", str(out))
    assert done.code == 0
    assert "CHECK" in done.out
    fill(out)
    device, described = load_device(out), find_device(read_esi(DRIVE))
    assert (device.kind, device.vendor_id) == ("cia402", described.identity.vendor_id)
    assert device.product_id == described.identity.product_code
    assert {"controlword", "target_position"} <= {entry.name for entry in device.outputs}
    assert {"statusword", "position"} <= {entry.name for entry in device.inputs}
    assert device.assign_activate in {mode.assign_activate for mode in described.dc_modes}
    assert device.scaling
    again = rtcp("device", "new", "--esi", str(DRIVE), "--out", str(out))
    assert (again.code, "it is not overwritten" in again.trouble) == (2, True)


def test_modules_are_put_into_slots_and_a_wrong_one_is_named_with_those_allowed(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "axes.yaml"
    chosen = ("--module", "0=0x100", "--module", "1=0x100")
    assert rtcp("device", "new", "--esi", str(AXES), *chosen, "--out", str(out)).code == 0
    indices = {entry.index for entry in load_device(out).outputs}
    assert {0x6040, 0x607A, 0x6840, 0x687A} <= indices
    wrong = rtcp("device", "new", "--esi", str(AXES), "--module", "0=0x999", "--out", str(tmp_path / "x.yaml"))
    assert wrong.code == 2
    assert "0x100" in wrong.trouble


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((), "give one of --esi, --sii, --from-bus"),
        (("--esi", str(DRIVE), "--sii", "x.bin"), "found --esi and --sii"),
        (("--from-bus", "virtual"), "--from-bus and --slave belong together"),
        (("--from-bus", "virtual", "--slave", "-1"), "--slave -1 is not allowed: a position on the cable, from 1"),
        (("--esi", str(TERMINALS)), "3 devices fit without a choice"),
        (("--esi", str(TERMINALS), "--product", "0x99"), "no devices fit product 0x00000099"),
        (("--esi", str(TERMINALS), "--product", "x"), "'x' is not a whole number (--product)"),
        (
            ("--esi", str(ANALOG), "--mode", "DC"),
            "no clock mode 'DC'; there are: FreeRun, DcTimed, DcOversampling, DcOwnObjects",
        ),
        (("--esi", str(SAMPLING), "--samples", "4"), "--samples needs --mode"),
        (("--esi", str(SAMPLING), "--mode", "DcSync", "--samples", "65"), "allowed are 1 to 64 (OSMin, OSMax)"),
        (("--esi", str(ANALOG), "--mode", "DcTimed", "--samples", "4"), "assigns no PDO of several values a cycle"),
        (("--esi", str(AXES), "--module", "0"), "allowed is SLOT=IDENT"),
        (("--esi", "there-is-none.xml"), "there-is-none.xml: cannot be read"),
        (("--sii", str(DRIVE)), "it is no EEPROM image"),
    ],
)
def test_what_cannot_be_made_is_refused_in_a_sentence_and_nothing_is_written(
    rtcp: Callable[..., Any], tmp_path: Path, arguments: tuple[str, ...], sentence: str
) -> None:
    done = rtcp("device", "new", *arguments, "--out", str(tmp_path / "x.yaml"))
    assert (done.code, sentence in done.trouble) == (2, True), done.trouble
    assert not (tmp_path / "x.yaml").exists()


def test_the_figures_that_nothing_states_are_listed_at_once_and_the_file_is_refused_until_they_are_there(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "drive.yaml"
    made = rtcp("device", "new", "--esi", str(MAKERS / "copley_bel.xml"), "--out", str(out))
    keys = (
        "encoder_increments", "gear_ratio", "external_gear_ratio", "feed_constant", "velocity_unit", "velocity_at",
        "rated_torque", "torque_at",
    )  # fmt: skip
    assert (made.code, "refused until these 8 values are filled in" in made.out + made.trouble) == (0, True)
    refused = rtcp("device", "check", str(out))
    assert refused.code == 2
    for key in keys:
        assert f"scaling[0].{key}: this key has no value yet; it must be " in refused.trouble
    assert "see 0x608F of the drive (subindex 1 by 2), or the encoder's data sheet" in refused.trouble
    assert refused.trouble.count("this key has no value yet") == len(keys)
    fill(out)
    assert rtcp("device", "check", str(out)).code == 0


def test_the_pdos_that_can_be_assigned_are_listed_with_their_entries_and_chosen(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    esi, out = ("--esi", str(MAKERS / "inovance_is620n.xml")), tmp_path / "drive.yaml"
    listed = rtcp("device", "new", *esi, "--pdo", "list")
    assert listed.code == 0
    assert "rpdo 0x1701 Outputs 1701, 96 bits; default; fixed; excludes 0x1600 0x1702" in listed.out
    assert "    0x6060:0 Mode, 8 bits SINT" in listed.out
    assert rtcp("device", "new", *esi, "--pdo", "0x1702", "--pdo", "0x1B02", "--out", str(out)).code == 0
    fill(out)
    device = load_device(out)
    assert [pdo.index for pdo in (*device.rpdo, *device.tpdo)] == [0x1702, 0x1B02]
    assert {"modes_of_operation", "target_velocity"} <= {entry.name for entry in device.outputs}
    for chosen, sentence in (
        (("0x1702", "0x1701"), "PDO 0x1702 excludes 0x1701: choose one of them"),
        (("0x1777",), "it has no PDO 0x1777; there are: 0x1600, 0x1701, 0x1702, 0x1A00, 0x1B01, 0x1B02"),
    ):
        options = [text for index in chosen for text in ("--pdo", index)]
        refused = rtcp("device", "new", *esi, *options, "--out", str(tmp_path / "x.yaml"))
        assert (refused.code, sentence in refused.trouble) == (2, True), refused.trouble
        assert not (tmp_path / "x.yaml").exists()


def test_a_clock_mode_that_an_eeprom_lacks_is_asked_for_and_a_terminal_without_one_has_none() -> None:
    drive = replace(find_device(read_esi(DRIVE), product=0x402), dc_modes=())
    assert "\nassign_activate:     # REQUIRED\n" in file_text(replace(drive, source=Source.SII))
    assert "\nassign_activate: 0x0000 " in file_text(drive)
    terminal = find_device(read_esi(TERMINALS), product=0x7D43052)
    assert "\nassign_activate: 0x0000 " in file_text(replace(terminal, source=Source.SII))


@pytest.mark.parametrize(
    ("sizes", "kind"),
    [
        ({0x6060: 16}, "cia402"),  # a mode of two bytes is sent as a constant
        ({0x6061: 16}, "cia402"),
        ({0x6040: 32}, "generic"),
        ({0x607A: 8}, "generic"),
    ],
)
def test_a_drive_whose_objects_have_unusual_lengths_gives_a_file_that_is_accepted(
    tmp_path: Path, sizes: dict[int, int], kind: str
) -> None:
    drive = find_device(read_esi(MAKERS / "synapticon_somanet.xml"))

    def resized(pdos: tuple[Pdo, ...]) -> tuple[Pdo, ...]:
        entries = [
            replace(entry, bits=sizes.get(entry.index, entry.bits), type="") for pdo in pdos for entry in pdo.entries
        ]
        return (replace(pdos[0], entries=tuple(entries)),)

    drive = replace(drive, rx_pdos=resized(drive.rx_pdos), tx_pdos=resized(drive.tx_pdos), objects=())
    file = tmp_path / "drive.yaml"
    file.write_text(filled(file_text(drive)))
    device = load_device(file)
    assert device.kind == kind
    if kind == "cia402":
        assert device.startup(0x6060) == 8


def test_only_the_objects_of_the_standard_have_the_names_that_the_driver_reads(tmp_path: Path) -> None:
    text = (MAKERS / "inovance_is620n.xml").read_text().replace("<Name>Error code</Name>", "<Name>Position</Name>")
    (tmp_path / "drive.xml").write_text(text)
    file = tmp_path / "drive.yaml"
    file.write_text(filled(file_text(find_device(read_esi(tmp_path / "drive.xml")))))
    assert {entry.name: entry.index for entry in load_device(file).inputs if "position" in entry.name} == {
        "position_603f": 0x603F, "position": 0x6064, "probe_position_1": 0x60BA, "probe_position_2": 0x60BC,
    }  # fmt: skip


def test_of_several_devices_of_one_identity_one_is_chosen_and_without_a_choice_all_are_listed(
    rtcp: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (MAKERS / "elmo_gold.xml").read_text()
    begin, end = text.index("    <Device "), text.index("</Device>") + len("</Device>")
    other = text[begin:end].replace(">Gold drive<", ">Gold drive in boot<").replace("#x160C", "#x160D")
    twice, out = tmp_path / "twice.xml", tmp_path / "drive.yaml"
    twice.write_text(text[:end] + "\n" + other + text[end:])
    new = ("device", "new", "--esi", str(twice), "--out", str(out))
    refused = rtcp(*new)
    assert refused.code == 2
    assert (
        "2 devices fit without a choice; there are: 1: Gold drive (Gold drive), product 0x00030924" in refused.trouble
    )
    assert "2: Gold drive in boot" in refused.trouble
    assert "give one by --product, --revision or --choice" in refused.trouble
    assert not out.exists()
    assert "no devices" not in rtcp(*new, "--choice", "3").trouble
    assert rtcp(*new, "--choice", "2").code == 0
    assert "name: Gold drive in boot" in out.read_text()
    out.unlink()
    virtual = Descriptions(tmp_path).make(SegmentSlave(esi="twice.xml", choice=2))
    assert virtual.identity.name == "Gold drive in boot"
    # At a terminal it asks.
    monkeypatch.setattr("sys.stdin", Terminal("1\n"))
    asked = rtcp(*new)
    assert (asked.code, "Which of these devices" in asked.out) == (0, True), asked.trouble
    assert "name: Gold drive\n" in out.read_text()


class Terminal(io.StringIO):
    """An input at which somebody answers."""

    def isatty(self) -> bool:
        return True


def test_every_sample_becomes_a_file_that_can_be_read(tmp_path: Path) -> None:
    for path in sorted(FILES.glob("*.xml")):
        content = read_esi(path)
        for number, device in enumerate(content.devices):
            whole = assemble(device, content.modules) if device.slots else device
            out = tmp_path / f"{path.stem}-{number}.yaml"
            out.write_text(filled(file_text(whole)))
            load_device(out)


def test_an_input_of_an_outputs_name_gets_a_name_of_its_own_and_a_file_without_is_refused(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "analog.yaml"
    assert rtcp("device", "new", "--esi", str(ANALOG), "--out", str(out)).code == 0
    device = load_device(out)
    assert [entry.name for entry in (*device.outputs, *device.inputs)] == ["enable", "value", "enable_in", "value_in"]
    out.write_text(out.read_text().replace("name: value_in", "name: value"))
    refused = rtcp("device", "check", str(out))
    text = 'tpdo[0].channels[2].name: found the text "value", an output\'s name too; each channel of the device needs'
    assert (refused.code, text in refused.trouble) == (2, True), refused.trouble


def test_a_clock_mode_is_chosen_by_name_with_the_pdos_that_it_assigns(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    out = tmp_path / "analog.yaml"
    assert rtcp("device", "new", "--esi", str(ANALOG), "--mode", "DcTimed", "--out", str(out)).code == 0
    device = load_device(out)
    assert (device.assign_activate, [pdo.index for pdo in device.tpdo]) == (0x0300, [0x1A01])
    assert [pdo.index for pdo in device.rpdo] == [0x1600]


def test_a_clock_mode_of_several_values_a_cycle_gives_the_number_of_samples(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    out = tmp_path / "analog.yaml"
    assert rtcp("device", "new", "--esi", str(ANALOG), "--mode", "DcOversampling", "--out", str(out)).code == 0
    device = load_device(out)
    assert [(pdo.index, pdo.samples) for pdo in device.tpdo] == [(0x1A00, 10)]
    assert [(pdo.index, pdo.samples) for pdo in device.rpdo] == [(0x1600, 1)]


@pytest.mark.parametrize(
    ("arguments", "samples", "sync0_factor", "after_ns"),
    [
        (("DcSync",), [(0x1B00, 1), (0x1A00, 1), (0x1B01, 1), (0x1A80, 1)], -1, 0),
        (("DcSync8",), [(0x1B00, 1), (0x1A00, 8), (0x1B01, 1), (0x1A80, 8)], -8, 875_000),
        (("DcSync5-1",), [(0x1B00, 1), (0x1A00, 5), (0x1B01, 1)], -5, 800_000),
        (("DcSync", "--samples", "20"), [(0x1B00, 1), (0x1A00, 20), (0x1B01, 1), (0x1A80, 20)], -20, 950_000),
        (("DcSync5-1", "--samples", "16"), [(0x1B00, 1), (0x1A00, 16), (0x1B01, 1)], -16, 937_500),
    ],
)
def test_values_with_pdos_of_their_own_are_taken_from_the_mode_or_as_many_as_are_wanted(
    rtcp: Callable[..., Any],
    tmp_path: Path,
    arguments: tuple[str, ...],
    samples: list[tuple[int, int]],
    sync0_factor: int,
    after_ns: int,
) -> None:
    out = tmp_path / "sampling.yaml"
    assert rtcp("device", "new", "--esi", str(SAMPLING), "--mode", *arguments, "--out", str(out)).code == 0
    device = load_device(out)
    assert [(pdo.index, pdo.samples) for pdo in device.tpdo] == samples
    assert {pdo.sample_increment for pdo in device.tpdo if pdo.samples > 1} in ({16}, set())
    assert device.sync0_factor == sync0_factor
    assert sync_cycles(device, 1_000_000) == (1_000_000 // -sync0_factor, after_ns)
    assert rtcp("device", "check", str(out)).code == 0


def test_the_kind_follows_from_the_default_process_data() -> None:
    kinds = {device.name: kind_of(device) for device in read_esi(TERMINALS).devices}
    assert kinds["2 digital outputs"] == "generic"
    assert kinds["End cover"] == "coupler"


def test_a_drive_that_bounds_itself_by_process_data_is_not_sent_0_and_holds_after_a_quick_stop(tmp_path: Path) -> None:
    sample = load_device(default_config().parent / "devices" / "two-axis-drive.yaml")
    bounds = (PdoEntry(0x6872, 0, "uint16", "max torque"), PdoEntry(0x6880, 0, "uint32", "max motor speed"))
    first, second = sample.rpdo
    bounding = replace(sample, rpdo=(first, replace(second, channels=(*second.channels, *bounds))))
    write_esi(tmp_path / "drive.xml", bounding, {0x6872: ("UINT", 800)})
    out = tmp_path / "drive.yaml"
    out.write_text(text := file_text(find_device(read_esi(tmp_path / "drive.xml"))))
    assert text.count("always sent: the drive's own value") == 2
    fill(out)
    device = load_device(out)
    assert {entry.index: entry.safe for entry in device.outputs[-2:]} == {0x6872: None, 0x6880: None}
    assert [device.startup(0x605A, axis) for axis in (1, 2)] == [6, 6]


def test_names_that_mean_something_to_others_are_names_here(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    text, file, out = TERMINALS.read_text(), tmp_path / "named.xml", tmp_path / "named.yaml"
    for pair in (("1", "null"), ("1e5", "padding"), ("true", "No")):
        renamed = text
        for name in pair:
            renamed = renamed.replace("<Name>Output</Name>", f"<Name>{name}</Name>", 1)
        file.write_text(renamed.replace("2 digital outputs", "[/bold]"))
        out.write_text(file_text(read_esi(file).devices[0]))
        assert len(load_device(out).outputs) == 2
    listed = rtcp("device", "list", str(file))
    assert (listed.code, "[/bold]" in listed.out) == (0, True), listed.trouble
    refused = rtcp("device", "new", "--esi", str(DRIVE), "--kind", "nosuch", "--out", str(tmp_path / "x.yaml"))
    assert (refused.code, (tmp_path / "x.yaml").exists()) == (2, False)


def test_a_watchdog_that_the_eeprom_leaves_off_is_named_in_the_file_and_by_its_comparison_with_the_bus(
    rtcp: Callable[..., Any], tmp_path: Path
) -> None:
    config, out = tmp_path / "config", tmp_path / "areas.yaml"
    shutil.copytree(default_config().parent, config)
    write_segment(config / "segment.yaml", "areas", "bits4")
    image = config / "areas.bin"
    rtcp("device", "new", "--sii", str(image), "--out", str(out))
    for number in (2, 3, 4):
        sentence = f"# Sync manager {number} leaves the watchdog off (control byte 0x24): switched on at the start."
        assert sentence in out.read_text()
    rtcp("device", "new", "--sii", str(config / "bits4.bin"), "--out", str(tmp_path / "bits4.yaml"))
    assert "leaves the watchdog off" not in (tmp_path / "bits4.yaml").read_text()
    arm = str(config / default_config().name)
    done = rtcp("device", "check", str(out), "--bus", "virtual", "--config", arm)
    assert "slave 1 (Terminal 30): " in done.out
    text = "watchdog: its EEPROM leaves the process-data watchdog of sync manager 2 and 3 and 4 off; it is switched on"
    assert text in " ".join(done.out.split())


def test_a_device_file_is_checked_alone(rtcp: Callable[..., Any], tmp_path: Path) -> None:
    sound = default_config().parent / "devices" / "cubemars-orh.yaml"
    assert "no mistake in it" in rtcp("device", "check", str(sound)).out
    broken = tmp_path / "broken.yaml"
    broken.write_text(sound.read_text().replace("name: statusword", "name: statusw0rd"))
    assert rtcp("device", "check", str(broken)).code == 2


def test_a_slave_that_is_there_becomes_a_file_and_each_difference_from_it_is_named(
    rtcp: Callable[..., Any], arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(offline, "SEGMENT_TIMEOUT_S", 120.0)  # for a host that is busy
    segment = arm.parent / "segment.yaml"
    segment.write_text("slaves:\n- model: diewu-io\n- model: cubemars-orh70\n")
    out, config = arm.parent / "devices" / "drive.yaml", ("--config", str(arm))
    done = rtcp("device", "new", "--from-bus", "virtual", "--slave", "2", "--out", str(out), *config)
    assert done.code == 0, done.trouble
    # What the drive holds itself is read, and no guess stands for the rest.
    text = out.read_text()
    assert re.search(r"encoder_increments: (\d+) +# increments per motor revolution; 0x608F, read from the drive", text)
    assert re.search(r"torque_at: +# REQUIRED", text)
    fill(out)
    shipped, written = load_device(arm.parent / "devices" / "cubemars-orh.yaml"), load_device(out)
    assert (written.kind, written.vendor_id, written.product_id, written.coe) == (
        "cia402",
        shipped.vendor_id,
        shipped.product_id,
        True,
    )
    for direction in ("outputs", "inputs"):
        assert [(entry.index, entry.sub_index, entry.length) for entry in getattr(written, direction)] == [
            (entry.index, entry.sub_index, entry.length) for entry in getattr(shipped, direction)
        ]
    same = rtcp("device", "check", str(out), "--bus", "virtual", *config)
    assert (same.code, "slave 2 (Cubemars ORH70): as the file says" in same.out) == (0, True), same.out + same.trouble
    text = out.read_text()
    other = arm.parent / "devices" / "other.yaml"
    (line,) = [line for line in text.splitlines() if "0x60ff" in line.lower()]
    other.write_text(text.replace(line + "\n", ""))
    differs = rtcp("device", "check", str(other), "--bus", "virtual", *config)
    assert (differs.code, differs.trouble) == (5, "rtcp: 1 differences")
    assert "rpdo: the file has 0x6040:0/16, 0x607A:0/32, 0x6071:0/32, 0x6060:0/8" in " ".join(differs.out.split())
    assert "the slave has 0x6040:0/16, 0x607A:0/32, 0x60FF:0/32" in " ".join(differs.out.split())
    segment.write_text("slaves:\n- model: diewu-io\n")
    absent = rtcp("device", "check", str(out), "--bus", "virtual", *config)
    assert (absent.code, "virtual: no slave has vendor" in absent.trouble) == (5, True)
