"""ESI files as several vendors write them: what is read, and the messages for mistakes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rtcp.esi import model, object_reader, xml_tree
from rtcp.esi.reader import find_device, find_devices, read_esi

FILES = Path(__file__).parent / "files"
START = "<EtherCATInfo><Vendor><Id>1</Id><Name>V</Name></Vendor><Descriptions><Devices>"
END = "</Devices></Descriptions></EtherCATInfo>"


@pytest.fixture(scope="module")
def drive() -> model.Device:
    return find_device(read_esi(FILES / "drive.xml"), product=0x402)


def read(tmp_path: Path, content: str | bytes) -> model.DeviceFile:
    path = tmp_path / "device.xml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_esi(path)


def device(tmp_path: Path, content: str, kind: str = 'ProductCode="1" RevisionNo="1"') -> model.DeviceFile:
    return read(tmp_path, f"{START}\n<Device><Type {kind}>T</Type>{content}</Device>{END}")


def plain(name: str, product: int = 1) -> str:
    return f"<Device><Type ProductCode='{product}'>T</Type><Name>{name}</Name></Device>"


def test_names_are_in_english_and_the_identity_is_whole(drive: model.Device) -> None:
    assert (drive.name, drive.vendor_name, drive.group_name) == (
        "Servo drive <one axis>",
        "Sample Drives",
        "Servo drives",
    )
    assert (drive.identity.vendor_id, drive.identity.product_code, drive.identity.revision) == (0xE51, 0x402, 0x20001)
    assert (drive.profile, drive.channel_profiles, drive.physics, drive.ebus_current) == (402, (402,), "YY", -120)
    assert (drive.config_data, drive.bootstrap) == (b"\x08\x0c\x00", bytes.fromhex("0010000200120002"))
    assert drive.no_lrw
    assert drive.origin == f"{FILES}/drive.xml:7"


def test_sync_managers_fmmus_and_mailbox_are_read(drive: model.Device) -> None:
    assert [(sync.start, sync.length, sync.control, sync.type) for sync in drive.sync_managers] == [
        (0x1000, 256, 0x26, model.SyncManagerType.MAILBOX_RECEIVE),
        (0x1200, 256, 0x22, model.SyncManagerType.MAILBOX_SEND),
        (0x1400, 7, 0x64, model.SyncManagerType.OUTPUTS),
        (0x1800, 8, 0x20, model.SyncManagerType.INPUTS),
    ]
    assert (drive.sync_managers[0].minimum, drive.sync_managers[0].maximum) == (34, 256)
    assert [sync.op_only for sync in drive.sync_managers] == [False, False, True, False]
    assert drive.fmmus == (model.FmmuUse.OUTPUTS, model.FmmuUse.INPUTS, model.FmmuUse.MAILBOX_STATE)
    assert drive.mailbox is not None
    assert drive.mailbox.foe
    assert drive.mailbox.data_link_layer
    coe = drive.mailbox.coe
    assert coe is not None
    assert (coe.sdo_information, coe.pdo_assignment, coe.pdo_configuration, coe.pdo_upload) == (True, True, True, False)
    assert (coe.complete_access, coe.segmented) == (True, True)


def test_pdos_have_their_entries_of_any_length_padding_exclusions_and_assignment(drive: model.Device) -> None:
    first, second = drive.rx_pdos
    assert (first.index, first.sync_manager, first.mandatory, first.fixed) == (0x1600, 2, True, False)
    assert (first.excludes, second.sync_manager, second.fixed) == (frozenset({0x1601}), None, True)
    (inputs,) = drive.tx_pdos
    assert [(entry.index, entry.sub_index, entry.bits, entry.type) for entry in inputs.entries] == [
        (0x6041, 0, 16, "UINT"),
        (0x6064, 0, 32, "DINT"),
        (0x2010, 1, 24, "INT24"),
        (0x2010, 2, 3, "BIT3"),
        (0, 0, 5, ""),
    ]
    assert inputs.bits == 80


def test_dc_modes_keep_the_whole_word_the_factors_and_the_shifts(drive: model.Device) -> None:
    assert drive.dc_modes == (
        model.DcMode("DC", 0x0730, "SYNC0", sync0_factor=-2, sync0_shift=-20_000, sync1_factor=1),
        model.DcMode("Off", 0, sync0_factor=0),
    )


def test_a_cycle_without_a_factor_is_that_of_the_master(tmp_path: Path) -> None:
    file = device(tmp_path, "<Dc><OpMode><Name>A</Name><CycleTimeSync0>0</CycleTimeSync0></OpMode></Dc>")
    assert file.devices[0].dc_modes == (model.DcMode("A", 0, sync0_factor=1),)


def test_commands_for_a_transition_are_read(drive: model.Device) -> None:
    (command,) = drive.init_commands
    assert (command.transitions, command.index, command.data, command.fixed) == (("PS",), 0x6060, b"\x08", True)


def test_an_array_without_subindexes_has_its_elements_with_types_rights_units_and_values_by_position(
    drive: model.Device,
) -> None:
    limits = next(item for item in drive.objects if item.index == 0x607D)
    assert limits.code is model.ObjectCode.ARRAY
    assert [(entry.sub_index, entry.name, entry.type, entry.bits) for entry in limits.entries] == [
        (0, "SubIndex 000", "USINT", 8),
        (1, "Min", "DINT", 32),
        (2, "Max", "DINT", 32),
    ]
    assert [entry.default for entry in limits.entries] == [b"\x02", b"\0\0\0\x80", b"\xff\xff\xff\x7f"]
    assert [entry.unit for entry in limits.entries] == [None, 0x00B50000, 0x00B50000]
    assert [(entry.writable, entry.write_states, entry.rx_mappable) for entry in limits.entries] == [
        (False, "", False),
        (True, "PS", True),
        (True, "PS", True),
    ]


def test_a_record_keeps_its_names_though_those_of_the_values_differ_and_its_gaps(drive: model.Device) -> None:
    record = next(item for item in drive.objects if item.index == 0x2000)
    assert record.code is model.ObjectCode.RECORD
    assert [(entry.sub_index, entry.name, entry.type, entry.readable) for entry in record.entries] == [
        (0, "SubIndex 000", "USINT", True),
        (1, "Gain", "REAL", True),
        (3, "Mode", "SINT", False),
    ]
    assert [entry.default for entry in record.entries] == [None, b"\x00\x00\xc0\x3f", b"\xfd"]
    assert (record.entries[2].minimum, record.entries[2].maximum) == (b"\xfb", b"\x05")


def test_values_of_some_subindexes_are_found_by_name_and_an_array_shares_its_length(tmp_path: Path) -> None:
    types = (
        "<DataType><Name>R</Name><SubItem><SubIdx>0</SubIdx><Name>n</Name><Type>USINT</Type></SubItem>"
        "<SubItem><SubIdx>1</SubIdx><Name>a</Name><Type>UINT</Type></SubItem>"
        "<SubItem><Name>b</Name><Type>A</Type><BitSize>48</BitSize></SubItem></DataType>"
        "<DataType><Name>A</Name><BaseType>T</BaseType><ArrayInfo><LBound>2</LBound><Elements>2</Elements></ArrayInfo>"
        "</DataType>"
    )
    values = "<SubItem><Name>a</Name><Info><DefaultValue>7</DefaultValue></Info></SubItem>"
    item = f"<Object><Index>#x2000</Index><Type>R</Type><Info>{values}</Info></Object>"
    file = device(
        tmp_path,
        f"<Profile><Dictionary><DataTypes>{types}</DataTypes><Objects>{item}</Objects></Dictionary></Profile>",
    )
    entries = file.devices[0].objects[0].entries
    assert [(entry.sub_index, entry.bits, entry.default) for entry in entries] == [
        (0, 8, None),
        (1, 16, b"\x07\0"),
        (2, 24, None),
        (3, 24, None),
    ]


def test_values_that_are_shorter_than_the_type_are_filled_and_texts_are_not(drive: model.Device) -> None:
    objects = {item.index: item.entries[0] for item in drive.objects}
    assert objects[0x6081].default == b"\x64\0\0\0"
    assert (objects[0x6081].rx_mappable, objects[0x6081].tx_mappable) == (True, True)
    assert (objects[0x1008].type, objects[0x1008].default) == ("STRING(8)", b"SD-402")


def test_a_terminal_without_a_mailbox_has_registers_bits_and_virtual_sync_managers() -> None:
    file = read_esi(FILES / "terminals.xml")
    outputs, inputs, cover = file.devices
    assert (outputs.sync_managers[0].start, outputs.mailbox, outputs.physics) == (0x0F00, None, "KK")
    assert outputs.sync_managers[0].enabled
    assert outputs.sync_managers[0].op_only  # Enable="9", as the EEPROM has it
    assert [pdo.bits for pdo in outputs.rx_pdos] == [1, 1]
    assert [sync.virtual for sync in inputs.sync_managers] == [False, True]
    assert [pdo.virtual for pdo in inputs.tx_pdos] == [False, True, False]
    assert inputs.tx_pdos[2].index == 0x10
    assert inputs.sync_managers[1].control == 0x20  # none is given
    assert (cover.identity.product_code, cover.name) == (0, "End cover")
    assert any("END-CAP: no product code" in warning for warning in file.warnings)


def test_a_real_file_with_two_prefixes_of_numbers_and_sync_managers_of_its_own_names_is_read() -> None:
    (joint,) = read_esi(FILES / "Orbita2d.xml").devices
    assert joint.rx_pdos[0].entries[0] == model.PdoEntry(0x6041, 0, 16, "controlword", "UINT16")
    assert [sync.type for sync in joint.sync_managers] == [
        model.SyncManagerType.MAILBOX_RECEIVE,
        model.SyncManagerType.MAILBOX_SEND,
        model.SyncManagerType.OUTPUTS,
        model.SyncManagerType.INPUTS,
    ]
    assert joint.fmmus == (model.FmmuUse.OUTPUTS, model.FmmuUse.INPUTS, model.FmmuUse.UNUSED)


# Looking up


def test_of_several_revisions_the_one_that_none_hides_is_found() -> None:
    file = read_esi(FILES / "drive.xml")
    assert [device.hidden for device in file.devices] == [False, True]
    assert find_device(file, name="sd-402").identity.revision == 0x20001
    assert find_device(file, product=0x402, revision=0x10000).name == "Servo drive, first revision"
    assert len(find_devices(file, product=0x402)) == 2


def test_a_device_that_is_ambiguous_or_absent_is_refused_with_what_there_is() -> None:
    file = read_esi(FILES / "terminals.xml")
    with pytest.raises(
        model.LookupFailure, match=r"3 devices fit without a choice; there are: 1: 2 digital outputs \(DO-2\)"
    ) as target:
        find_device(file)
    assert len(target.value.candidates) == 3
    with pytest.raises(model.LookupFailure, match="no devices fit product 0x00000009; there are: 2 digital outputs"):
        find_device(file, product=9)


def test_a_device_that_hides_all_of_its_kind_does_not_hide_itself(tmp_path: Path) -> None:
    first = "<Device><Type ProductCode='1' RevisionNo='1'>T</Type></Device>"
    second = "<Device><Type ProductCode='1' RevisionNo='2'>T</Type><HideType/></Device>"
    file = read(tmp_path, f"{START}{first}{second}{END}")
    assert [item.hidden for item in file.devices] == [True, False]


# What is accepted


@pytest.mark.parametrize(
    ("encoding", "declaration", "name", "warned"),
    [
        ("latin-1", "", "Größe", True),
        ("latin-1", "ISO8859-1", "Größe", False),
        ("latin-1", "utf-8", "Größe", True),
        ("utf-8-sig", "", "Größe", False),
        ("gb2312", "gb2312", "驱动器", False),
        ("utf-16", "", "Größe", False),
    ],
)
def test_every_encoding_that_occurs_is_read(
    tmp_path: Path, encoding: str, declaration: str, name: str, warned: bool
) -> None:
    first = f'<?xml version="1.0" encoding="{declaration}"?>' if declaration else ""
    file = read(tmp_path, f"{first}{START}{plain(name)}{END}".encode(encoding))
    assert file.devices[0].name == name
    assert any("read as Latin-1" in warning for warning in file.warnings) == warned


@pytest.mark.parametrize(
    ("content", "warning"),
    [
        ("<RxPdo Sm='2' Ref='5'><Name>R</Name></RxPdo>", "RxPdo without an index is left out"),
        ("<TxPdo><Index>#x1A00</Index><Entry><Index>0</Index><BitLen>0</BitLen></Entry></TxPdo>", "Entry of 0 bits"),
        ("<Sm StartAddress='#x1000' ControlByte='#x20'/>", "Sm: the type '' is not known; taken as INPUTS"),
        ("<Fmmu>Whatever</Fmmu>", "Fmmu: the use 'Whatever' is not known; taken as UNUSED"),
        ("<Sm StartAddress='#x1000' Enable='yes'>Inputs</Sm>", "@Enable is 'yes', not a number; 1 is used"),
        ("<Eeprom><ConfigData>05zz</ConfigData></Eeprom>", "ConfigData is '05zz', not bytes in hexadecimal; it is cut"),
        ("<Novelty/><Novelty/>", "2 elements Novelty of T are not read"),
    ],
)
def test_what_real_files_get_wrong_is_accepted_with_a_warning_at_its_line(
    tmp_path: Path, content: str, warning: str
) -> None:
    file = device(tmp_path, content)
    assert file.failures == ()
    (message,) = file.warnings
    assert warning in message
    assert message.startswith(f"{tmp_path}/device.xml:2: ")


def test_what_follows_the_root_is_left_out_with_a_warning(tmp_path: Path) -> None:
    file = read(tmp_path, f"{START}<Device><Type ProductCode='1'>T</Type></Device>{END}\nbatteries not included")
    assert len(file.devices) == 1
    assert "what follows the end of the root element is left out" in file.warnings[0]


def test_a_device_that_cannot_be_understood_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    broken = "<Device><Type ProductCode='1'>T</Type><RxPdo><Index>sixteen</Index></RxPdo></Device>"
    file = read(tmp_path, f"{START}\n{broken}<Device><Type ProductCode='2'>U</Type></Device>{END}")
    assert [device.type for device in file.devices] == ["U"]
    assert file.failures == (f"{tmp_path}/device.xml:2: RxPdo: Index is 'sixteen', not a number",)
    with pytest.raises(model.LookupFailure, match=r"not readable: .*sixteen"):
        find_device(file, product=1)


def test_a_file_of_modules_alone_is_a_file(tmp_path: Path) -> None:
    module = "<Module><Type ModuleIdent='#x31' ModuleClass='Di'>DI</Type><Name>4 inputs</Name></Module>"
    file = read(tmp_path, f"<EtherCATModule><Vendor><Id>2</Id></Vendor><Modules>{module}</Modules></EtherCATModule>")
    assert [(item.ident, item.module_class, item.name) for item in file.modules] == [(0x31, "Di", "4 inputs")]


# What is refused


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ("", "no XML: no element found"),
        ("no markup at all", "no XML: syntax error"),
        ("<html/>", "the root element is html"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><EtherCATInfo/>", "a DOCTYPE is refused"),
        ("<EtherCATInfo/>", "EtherCATInfo holds no device and no module"),
        ("<EtherCATDict/>", "EtherCATDict holds no device and no module"),
        (START + "<Device>", "no XML: no element found"),
        ("<?xml version='1.0' encoding='rot13'?><EtherCATInfo/>", "the encoding rot13 is not known"),
        (START + "<x>" * 100, "elements are nested more than 64 deep"),
        (START + "<Device>" + "<Info>" * 100, "elements are nested more than 64 deep"),
        (START + f"<Device><Name>{'x' * (xml_tree.TEXT_LIMIT + 1)}</Name>", "Name holds more than 262144 characters"),
        (START + f"<Device a='{'x' * (xml_tree.TOKEN_LIMIT + 200_000)}'>", "a tag or comment of more than"),
        (START + "<Device>" + "<Entry/>" * (xml_tree.NODE_LIMIT + 1), "Device of more than 300000 elements"),
        (START + "<Device/>" * 10_002, "more than 10000 devices and modules"),
    ],
    ids=lambda text: text[:30],
)
def test_what_is_no_description_or_too_large_is_refused_with_its_place(
    tmp_path: Path, content: str, problem: str
) -> None:
    with pytest.raises(model.EsiError, match=problem) as error:
        read(tmp_path, content)
    assert error.value.origin.startswith(f"{tmp_path}/device.xml")


def test_a_file_that_is_not_there_no_file_or_too_long_is_refused(tmp_path: Path) -> None:
    # Opening a pipe would wait for a writer.
    os.mkfifo(tmp_path / "pipe.xml")
    for none in (tmp_path / "pipe.xml", tmp_path):
        with pytest.raises(model.EsiError, match="this is no regular file"):
            read_esi(none)
    with pytest.raises(model.EsiError, match="cannot be read: No such file"):
        read_esi(tmp_path / "none.xml")
    with (tmp_path / "long.xml").open("wb") as file:
        file.truncate(xml_tree.FILE_LIMIT + 1)
    with pytest.raises(model.EsiError, match="more than 65536 KiB"):
        read_esi(tmp_path / "long.xml")


def test_types_that_grow_when_they_are_unfolded_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    array = (
        "<DataType><Name>A</Name><BaseType>USINT</BaseType>"
        "<ArrayInfo><LBound>1</LBound><Elements>255</Elements></ArrayInfo></DataType>"
    )

    def dictionary(parts: int, objects: int) -> str:
        types = f"{array}<DataType><Name>R</Name>{'<SubItem><Type>A</Type></SubItem>' * parts}</DataType>"
        items = "".join(f"<Object><Index>{index}</Index><Type>R</Type></Object>" for index in range(objects))
        return f"<Profile><Dictionary><DataTypes>{types}</DataTypes><Objects>{items}</Objects></Dictionary></Profile>"

    assert len(device(tmp_path, dictionary(40, 1)).devices[0].objects[0].entries) == 255  # subindexes end there
    monkeypatch.setattr(object_reader, "ENTRY_LIMIT", 2000)
    with pytest.raises(model.EsiError, match="dictionaries of more than 2000 subindexes"):
        device(tmp_path, dictionary(1, 8))


def test_a_file_of_megabytes_takes_tens_of_mebibytes(tmp_path: Path) -> None:
    text = (FILES / "drive.xml").read_text()
    start, end = text.index("<Device "), text.index("</Device>") + len("</Device>")
    path = tmp_path / "large.xml"
    path.write_text(text[:start] + text[start:end] * 600 + text[end:])
    assert path.stat().st_size > 4_000_000
    code = (
        "import resource, sys\n"
        "from rtcp.esi.reader import read_esi\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "assert len(read_esi(sys.argv[1]).devices) == 601\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    result = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=True)
    assert int(result.stdout) < 60 * 1024  # KiB, the 601 devices among them
