"""`rtcp foe`, `eeprom`, `alias`, `state`, `scan --describe`, `doctor --drives`: a real segment for each command."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from rtcp.cli import doctor, slaves
from rtcp.esi.sii import crc, write_sii
from rtcp.fieldbus.eeprom import is_sound, with_alias
from rtcp.ipc.errors import RtcpError
from rtcp.launch import offline
from rtcp.realtime.doctor import Finding, Severity
from tests.fieldbus.terminals import DEVICES, write_segment
from tests.forked import Forked

Rtcp = Callable[..., Any]
FILES, BITS4 = "slave 1 (Terminal 40, serial 140)", "slave 2 (Terminal 14, serial 114)"


def ask(question: Mapping[str, Any], progress: Callable[[float], None]) -> dict[str, Any]:
    """Ask the bus in a forked process; `tests/cli/test_offline.py` asks it in a process that the command starts."""
    child = Forked("rtcp.launch.offline", given=json.dumps(question))
    try:
        while "progress" in (line := json.loads(child.line())):
            progress(line["progress"])
    finally:
        child.terminate()
        child.output()
        child.end()
    if "error" in line:
        raise RtcpError(line["kind"], line["error"])
    return line


@pytest.fixture
def lasting(arm: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], int]]:
    """Return a function that starts the arm's segment for several commands; it returns a pid."""
    monkeypatch.setattr(offline, "_question", ask)
    with contextlib.ExitStack() as stack:

        def start() -> int:
            segment = Forked("rtcp.virtual", "--config", str(arm.parent / "segment.yaml"))
            stack.callback(segment.end)
            ready = json.loads(segment.line())
            monkeypatch.setattr(offline, "_segment", lambda file: contextlib.nullcontext(ready))
            return int(ready["pid"])

        yield start


@pytest.fixture
def files(arm: Path, lasting: Callable[[], int]) -> tuple[str, ...]:
    """Options for a segment of a slave with files and one without mailbox."""
    write_segment(arm.parent / "segment.yaml", "files", "bits4, alias: 5")
    lasting()
    return ("--config", str(arm), "--bus", "virtual")


def eeprom(rtcp: Rtcp, slave: str, *options: str) -> bytes:
    """Return the EEPROM of a slave."""
    out = Path(options[options.index("--config") + 1]).parent / "eeprom.bin"
    out.unlink(missing_ok=True)
    assert rtcp("eeprom", "read", slave, "--out", str(out), *options).code == 0
    return out.read_bytes()


def test_an_image_goes_into_the_eeprom_only_where_it_is_sound_and_of_this_device(
    rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path
) -> None:
    image = tmp_path / "image.bin"
    ended = rtcp("eeprom", "read", "1", "--out", str(image), *files)
    assert (ended.out, image.read_bytes()) == (f"{FILES}: 512 bytes written to {image}\n", write_sii(DEVICES["files"]))
    changed = bytearray(image.read_bytes())
    changed[26:28] = b"\x2a\x00"  # its revision
    image.write_bytes(changed)
    ended = rtcp("eeprom", "write", "1", str(image), "--yes", *files)
    assert (ended.code, ended.out.splitlines()[-1]) == (
        0, f"{FILES}: 1 words written and read back; switch it off and on to have it load them"
    )  # fmt: skip
    assert eeprom(rtcp, "1", *files) == changed
    foreign = rtcp("eeprom", "write", "2", str(image), "--yes", *files)
    assert foreign.code == 3
    assert "the image is of vendor 0x00000E2A, product 0x00000028, the slave of vendor 0x00000E2A" in foreign.trouble
    image.write_bytes(bytes((changed[0] ^ 1,)) + changed[1:])
    damaged = rtcp("eeprom", "write", "1", str(image), "--yes", *files)
    assert damaged.code == 2
    assert f"the checksum in word 7 of the image is 0x{crc(bytes(changed[:14])):02X}" in damaged.trouble


def test_an_image_of_a_sister_leaves_serial_number_and_alias_as_they_are_unless_asked(
    rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path
) -> None:
    own = eeprom(rtcp, "2", *files)
    sister = bytearray(with_alias(own, 77))
    sister[28:30], sister[26:28] = b"\x2a\x00", b"\x09\x00"
    image = tmp_path / "image.bin"
    image.write_bytes(sister)
    ended = rtcp("eeprom", "write", "2", str(image), "--yes", *files)
    assert "kept: serial number 114 and alias 5; --verbatim writes those of the image" in ended.out
    assert eeprom(rtcp, "2", *files) == own[:26] + sister[26:28] + own[28:]
    rtcp("eeprom", "write", "2", str(image), "--yes", "--verbatim", *files)
    assert eeprom(rtcp, "2", *files) == sister


@pytest.mark.parametrize("content", [b"\x00", b"\xff"])
def test_an_eeprom_that_says_nothing_is_repaired_and_takes_no_alias_before(
    rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path, content: bytes
) -> None:
    sound = eeprom(rtcp, "1", *files)
    bus = offline.OfflineBus("virtual", Path(files[1]))
    bus.eeprom_write(1, sound[:16], 512 * content)
    assert eeprom(rtcp, "1", "--size", "512", *files) == 512 * content
    refused = rtcp("alias", "set", "1", "7", "--yes", *files)
    assert refused.code == 3
    assert "the checksum in word 7 of its EEPROM is wrong" in refused.trouble
    image = tmp_path / "image.bin"
    image.write_bytes(sound)
    ended = rtcp("eeprom", "write", "1", str(image), "--yes", *files)
    assert (ended.code, eeprom(rtcp, "1", *files)) == (0, sound), ended.trouble
    long = tmp_path / "long.bin"
    long.write_bytes(sound + 512 * b"\xff")
    refused = rtcp("eeprom", "write", "1", str(long), "--yes", *files)
    assert (refused.code, "from 128 to 512, which the EEPROM has; --size gives its size" in refused.trouble) == (
        2,
        True,
    )


def test_a_write_that_is_interrupted_says_what_is_half_written_and_another_one_repairs_it(
    rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = eeprom(rtcp, "1", *files)
    image = tmp_path / "image.bin"
    image.write_bytes(sound[:0x80] + bytes(byte ^ 0xFF for byte in sound[0x80:]))

    @contextlib.contextmanager
    def interrupted(*arguments: object, **more: object) -> Iterator[Callable[[float], None]]:
        def progress(done: float) -> None:
            if done > 0.6:
                raise KeyboardInterrupt

        yield progress

    with monkeypatch.context() as ctrl_c:
        ctrl_c.setattr(slaves, "transfer", interrupted)
        ended = rtcp("eeprom", "write", "1", str(image), "--yes", *files)
        assert (ended.code, ended.trouble) == (
            130, f"rtcp: interrupted: the EEPROM of {FILES} may be half written, under a wrong checksum; `rtcp eeprom "
            "write` repairs it",
        )  # fmt: skip
        ended = rtcp("foe", "write", "1", str(image), *files)
        assert "slave 1 may have half of its file image.bin: write it again before it is switched off" in ended.trouble
    half = eeprom(rtcp, "1", *files)
    assert (half not in (sound, image.read_bytes()), is_sound(half)) == (True, False)
    image.write_bytes(sound)
    assert rtcp("eeprom", "write", "1", str(image), "--yes", *files).code == 0
    assert eeprom(rtcp, "1", *files) == sound


def test_a_dump_shows_what_the_eeprom_says(rtcp: Rtcp, files: tuple[str, ...]) -> None:
    ended = rtcp("eeprom", "dump", "2", *files)
    assert ended.code == 0
    for text in ("Terminal 14", "product 0x0000000E", "alias 5", "SM0", "0x0F00", "RxPDO 0x1601", "BIT4", "value 1"):
        assert text in ended.out


def test_an_alias_is_written_under_the_checksum_and_none_twice(rtcp: Rtcp, files: tuple[str, ...]) -> None:
    before = eeprom(rtcp, "1", *files)
    ended = rtcp("alias", "set", "1", "0x1234", "--yes", *files)
    assert ended.out == f"{FILES}: alias 4660 written; switch it off and on to have it load it\n"
    after = eeprom(rtcp, "1", *files)
    assert after[8:10] == b"\x34\x12"
    assert after[14] == crc(after[:14])
    assert after == before[:8] + after[8:10] + before[10:14] + after[14:15] + before[15:]
    twice = rtcp("alias", "set", "1", "5", "--yes", *files)
    assert twice.code == 3
    assert "slave 2 has the station alias 5 already" in twice.trouble
    assert rtcp("alias", "set", "1", "65536", "--yes", *files).code == 2
    # Without --yes it asks, and there is nobody to answer.
    assert f"Write alias 6 in place of 4660 into {FILES}?" in rtcp("alias", "set", "1", "6", *files).out
    assert eeprom(rtcp, "1", *files) == after


def test_a_state_is_left_as_it_was_requested(rtcp: Rtcp, arm: Path, lasting: Callable[[], int]) -> None:
    write_segment(arm.parent / "segment.yaml", "files", "bits4, alias: 5")
    program = (
        "import sys; from rtcp.fieldbus.interface import enter; from rtcp.fieldbus.registers import RegisterPort\n"
        "enter(int(sys.argv[1])); port = RegisterPort('ecat0')\n"
        "print([port.read(station, 0x0130, 1)[0] for station in (0x1001, 0x1002)])"
    )
    query = (sys.executable, "-c", program, str(lasting()))
    options = ("--config", str(arm), "--bus", "virtual")
    for state, (number, name) in {"preop": (2, "PRE-OP"), "boot": (3, "BOOT"), "INIT": (1, "INIT")}.items():
        assert rtcp("state", "1", state, *options).out == f"{FILES}: {name}\n"
        assert json.loads(subprocess.check_output(query)) == [number, 1]
    assert rtcp("state", "2", "PRE-OP", *options).out == f"{BITS4}: PRE-OP\n"
    assert json.loads(subprocess.check_output(query)) == [1, 2]
    refused = rtcp("state", "2", "BOOT", *options)
    assert refused.code == 3
    assert "slave 2 (Terminal 14) did not reach BOOT" in refused.trouble
    assert rtcp("state", "2", "OP", *options).code == 2


def test_a_name_is_the_slave_with_its_alias_and_of_its_device_and_no_other(
    rtcp: Rtcp, arm: Path, lasting: Callable[[], int]
) -> None:
    segment = arm.parent / "segment.yaml"
    slaves = yaml.safe_load(segment.read_text())
    # The wiring of drive1 and drive2 is swapped against the file.
    aliases = {"drive1": 11, "drive2": 12, "drive5": 15, "drive6": 99}
    for position, alias in ((1, 15), (2, 12), (3, 11)):
        slaves["slaves"][position - 1]["alias"] = alias
    segment.write_text(yaml.safe_dump(slaves))
    described = arm.read_text()
    for name, alias in aliases.items():
        assert described.count(f"name: {name},") == 1
        described = described.replace(f"name: {name},", f"name: {name}, alias: {alias},")
    arm.write_text(described)
    lasting()
    options = ("--config", str(arm), "--bus", "virtual")
    assert rtcp("sdo", "read", "drive1", "0x1018:4", *options).out == rtcp("sdo", "read", "3", "0x1018:4", *options).out
    ended = rtcp("state", "drive1", "preop", *options)
    assert ended.out.startswith("slave 3 (Cubemars ORH70, serial "), ended.trouble
    refused = rtcp("state", "drive5", "preop", *options)
    assert refused.code == 5
    assert "slave 1 (DIEWU 16DI16DO) has the station alias 15 of drive5, but is vendor" in refused.trouble
    assert "drive6: no slave has the station alias 99" in rtcp("eeprom", "dump", "drive6", *options).trouble
    # Without an alias the missing slave cannot be told from the others of its kind.
    assert "no slave has the station alias 99" in rtcp("sdo", "read", "drive3", "0x1018:4", *options).trouble


def test_a_name_without_alias_is_refused_on_a_bus_that_is_not_the_arms(
    rtcp: Rtcp, arm: Path, files: tuple[str, ...]
) -> None:
    ended = rtcp("sdo", "read", "drive1", "0x1018:4", *files)
    assert ended.code == 5
    assert "which slave is drive1 is not certain without a station alias: give its position instead" in ended.trouble


def test_files_are_written_and_what_is_refused_is_told(rtcp: Rtcp, files: tuple[str, ...], tmp_path: Path) -> None:
    firmware = tmp_path / "firmware"
    firmware.write_bytes(bytes(range(256)) * 8)
    ended = rtcp("foe", "write", "1", str(firmware), "--boot", *files)
    assert (ended.code, ended.out) == (0, f"{FILES}: 2048 bytes written to its file firmware\n")
    refused = rtcp("foe", "write", "1", str(firmware), *files)
    assert refused.code == 3
    assert "only in BOOT: add --boot" in refused.trouble
    absent = rtcp("foe", "read", "1", "nothing", "--out", str(tmp_path / "x"), *files)
    assert (absent.code, (tmp_path / "x").exists()) == (3, False)
    for password in ("-1", "99999999999"):
        ended = rtcp("foe", "write", "1", str(firmware), f"--password={password}", *files)
        assert (ended.code, f"--password {password} is not allowed: 0 to 4294967295" in ended.trouble) == (2, True)
    ended = rtcp("foe", "write", "1", str(firmware), "--as", os.fsdecode(b"\xff"), *files)
    assert (ended.code, "is not UTF-8" in ended.trouble) == (2, True)


@pytest.mark.parametrize("command", [("foe", "read", "1", "x"), ("eeprom", "read", "1"), ("capture",)])
def test_a_file_that_cannot_be_made_is_refused_before_the_bus_is_asked_and_none_is_left_or_overwritten(
    rtcp: Rtcp, tmp_path: Path, command: tuple[str, ...]
) -> None:
    missing = rtcp(*command, "--bus", "rtcp-none0", "--out", str(tmp_path / "nodir" / "x"))
    assert (missing.code, "nodir/x: No such file or directory" in missing.trouble) == (2, True)
    (tmp_path / "kept").write_text("kept")
    there = rtcp(*command, "--bus", "rtcp-none0", "--out", str(tmp_path / "kept"))
    assert (there.code, "it is not overwritten" in there.trouble) == (2, True)
    assert (tmp_path / "kept").read_text() == "kept"
    refused = rtcp(*command, "--bus", "rtcp-none0", "--out", str(tmp_path / "x"))
    assert "there is no network interface rtcp-none0" in refused.trouble
    assert not (tmp_path / "x").exists()


def test_a_live_slave_describes_itself(rtcp: Rtcp, files: tuple[str, ...]) -> None:
    device = json.loads(rtcp("scan", "--describe", "1", "--json", *files).out)
    wanted = DEVICES["files"]
    assert device["identity"]["product_code"] == wanted.identity.product_code
    assert [(pdo["index"], pdo["sync_manager"]) for pdo in device["rx_pdos"]] == [(0x1601, 2)]
    (entry,) = device["tx_pdos"][0]["entries"]
    assert (entry["index"], entry["bits"], entry["type"], entry["name"]) == (0x6000, 16, "UINT", "value 1")
    assert [sm["start"] for sm in device["sync_managers"]] == [sm.start for sm in wanted.sync_managers]
    assert {0x1000, 0x1018, 0x1C12, 0x1601, 0x6000} <= {item["index"] for item in device["objects"]}
    assert device["mailbox"]["foe"]
    plain = rtcp("scan", "--describe", "2", *files)
    assert "TxPDO 0x1A01" in plain.out
    slaves = json.loads(rtcp("scan", "--json", *files).out)
    assert [(slave["output_bits"], slave["input_bits"]) for slave in slaves] == [(16, 16), (4, 4)]
    assert slaves[0]["outputs"][0]["entries"][0]["name"] == "value 1"


@pytest.mark.parametrize(
    "command",
    [("foe", "read", "1", "x", "--out", "y"), ("eeprom", "dump", "1"), ("alias", "set", "1", "5"),
     ("state", "1", "INIT"), ("scan", "--describe", "1")],
)  # fmt: skip
def test_what_needs_the_bus_for_itself_is_refused_while_a_platform_holds_it(
    platform: Any, rtcp: Rtcp, command: tuple[str, ...]
) -> None:
    ended = rtcp(*command)
    assert ended.code == 3
    assert "holds the bus virtual" in ended.trouble


def test_a_drive_shows_what_it_holds_beside_its_process_data_in_its_own_units_and_in_si_units(
    rtcp: Rtcp, arm: Path, lasting: Callable[[], int]
) -> None:
    lasting()
    options = ("scan", "--describe", "2", "--config", str(arm), "--bus", "virtual")
    (drive,) = json.loads(rtcp(*options, "--json").out)["drives"]
    texts = [setting["text"] for setting in drive["settings"]]
    assert "quick stop option code (0x605A) is 2, slows down by 0x6085, then the torque goes off" in texts
    assert "following error window (0x6065) is 1000, 0.1 rad" in texts
    assert "quick stop deceleration (0x6085) is 100000, 10 rad/s^2" in texts
    assert "1000 following error window: 0.1 rad" in " ".join(rtcp(*options).out.split())


def test_the_drives_hold_what_their_joints_need_or_are_named_with_what_is_to_be_done(
    rtcp: Rtcp, arm: Path, lasting: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    lasting()
    monkeypatch.setattr(doctor, "examine", lambda case: [Finding(Severity.OK, "good", (), "host", "")])
    options = ("doctor", "--drives", "--config", str(arm), "--bus", "virtual")
    ended = rtcp(*options)
    shown = " ".join(ended.out.split())
    assert (ended.code, ended.err) == (0, "")
    assert "drive1 0x605A 6 quick stop option code: slows down by 0x6085, then holds" in shown
    assert "drive6 0x6072 190000 max torque: 19 Nm" in shown
    assert "The drives hold what their joints need." in shown
    drive = arm.parent / "devices" / "cubemars-orh.yaml"
    text = drive.read_text()
    assert text.count("value: 6, ") == text.count("value: 2000, ") == 1
    drive.write_text(text.replace("value: 6, ", "value: 2, ").replace("value: 2000, ", "value: 200, "))
    ended = rtcp(*options, "--json")
    assert (ended.code, ended.err) == (3, "")
    answer = json.loads(ended.out)
    window, stop = answer["drives"][0]["warnings"][::-1]
    assert window.startswith("drive1: following error window (0x6065) is 200, 0.02 rad, and the supervision of joint1")
    assert stop.startswith("drive1: after a quick stop it does not hold: quick stop option code (0x605A) is 2, slows")
