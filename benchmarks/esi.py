"""Reads all ESI files and SII images below a folder, and counts by vendor.

    python benchmarks/esi.py DIR

First table: files, devices, devices read; of those read, whether an SII image can be written and gives the device
back; objects of the files and objects made of PDOs. Second table, by repository: pairs of a description and an image
of the same identity; images without faults; which parts of the image that is written of the description equal the
other's. Reasons of failures and the differences go to standard error.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path

from rtcp.esi.dictionary import complete
from rtcp.esi.model import Device, DeviceFile, EsiError, Pdo
from rtcp.esi.reader import describe, read_esi
from rtcp.esi.sii import check_sii, crc, read_sii, write_sii

ESI_SUFFIXES = {".xml", ".esi"}
IMAGE_SUFFIXES = {".bin", ".sii", ".hex", ".eeprom"}
PARTS = ("identity", "config", "fixed part", "texts", "sync managers", "fmmus", "pdos", "dc", "bytes")
COLUMNS = ("files", "devices", "read", "modules", "image", "given back", "size kept", "objects", "made", "warnings")


def vendor(file: DeviceFile) -> str:
    name = file.vendor_name.split(",")[0].split(" GmbH")[0].strip() or "(no name)"
    return f"{name} 0x{file.vendor_id:X}"


def read_files(folder: Path) -> tuple[list[DeviceFile], list[str]]:
    """Return the ESI files, and why each other file was refused; copies count once."""
    files, refused = [], []
    seen = set()
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in ESI_SUFFIXES or not path.is_file():
            continue
        content = path.read_bytes()
        if hash(content) in seen or b"<EtherCATDict" in content[:4096]:
            continue
        seen.add(hash(content))
        try:
            files.append(read_esi(path))
        except EsiError as error:
            refused.append(str(error))
    return files, refused


def mapping(pdos: tuple[Pdo, ...]) -> list[tuple[object, ...]]:
    return [
        (pdo.index, pdo.sync_manager, tuple((entry.index, entry.sub_index, entry.bits) for entry in pdo.entries))
        for pdo in pdos
    ]


def used_fmmus(device: Device) -> list[int]:
    """FMMUs without those that pad the category."""
    uses = [int(use) for use in device.fmmus]
    while uses and not uses[-1]:
        uses.pop()
    return uses


def modes(device: Device) -> list[object]:
    return [replace(mode, name="", description="", sync1_cycle=0) for mode in device.dc_modes]


def equal_parts(ours: bytes, theirs: bytes) -> dict[str, bool]:
    """Return which parts of two images are equal."""
    one, other = read_sii(ours), read_sii(theirs)
    end = max(len(ours.rstrip(b"\xff")), len(theirs.rstrip(b"\xff")))
    return {
        "identity": one.identity == replace(other.identity, serial=0),
        "config": ours[:15] == theirs[:15],
        "fixed part": ours[:128] == theirs[:128],
        "texts": (one.name, one.type, one.group) == (other.name, other.type, other.group),
        "sync managers": one.sync_managers == other.sync_managers,
        "fmmus": used_fmmus(one) == used_fmmus(other),
        "pdos": mapping(one.rx_pdos) + mapping(one.tx_pdos) == mapping(other.rx_pdos) + mapping(other.tx_pdos),
        "dc": modes(one) == modes(other),
        "bytes": ours[:end] == theirs[:end],
    }


def lost(device: Device) -> list[str]:
    """Return what an image of a device does not give back, of what an image can hold."""
    found = read_sii(write_sii(device))
    left_out = not (found.rx_pdos or found.tx_pdos) and device.mailbox is not None and device.mailbox.coe is not None
    differences = {
        "identity": found.identity != device.identity,
        "sync managers": tuple(replace(sync, minimum=None, maximum=None) for sync in device.sync_managers)
        != found.sync_managers,
        "pdos": not left_out and mapping(device.rx_pdos + device.tx_pdos) != mapping(found.rx_pdos + found.tx_pdos),
        "dc": modes(device) != modes(found),
    }
    return [name for name, different in differences.items() if different]


def images(folder: Path) -> list[tuple[Path, bytes]]:
    """Return the SII images below a folder: files of such a name with the right CRC."""
    found = []
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
            data = path.read_bytes()
            if len(data) >= 128 and data[14] == crc(data[:14]) and data[126] <= 1 and any(data[16:24]):
                found.append((path, data))
    return found


def described(path: Path, image: bytes, by_folder: dict[Path, list[tuple[str, Device]]]) -> Device | None:
    """Return the device of the same product and revision in an image's folder or one beside it, its namesake first."""
    identity = read_sii(image).identity
    beside = [folder for folder in by_folder if folder.parent == path.parent.parent and folder != path.parent]
    for folder in [path.parent, *beside]:
        for _, device in sorted(by_folder.get(folder, []), key=lambda item: item[0] != path.stem):
            own = device.identity
            if (own.product_code, own.revision) == (identity.product_code, identity.revision):
                return device
    return None


def print_table(head: tuple[str, ...], rows: dict[str, Counter[str]]) -> None:
    total: Counter[str] = sum(rows.values(), Counter())
    print(" ".join(f"{column:>{max(len(column), 7)}}" for column in head))
    for name, row in [*sorted(rows.items(), key=lambda item: (-item[1][head[0]], item[0])), ("all", total)]:
        print(" ".join(f"{row[column]:>{max(len(column), 7)}}" for column in head), "", name)


def count_devices(files: list[DeviceFile], reasons: list[str]) -> dict[str, Counter[str]]:
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    for file in files:
        row = rows[vendor(file)]
        row["files"] += 1
        row["devices"] += len(file.devices) + len(file.failures)
        row["read"] += len(file.devices)
        row["modules"] += len(file.modules)
        row["warnings"] += len(file.warnings)
        reasons += file.failures
        for device in file.devices:
            row["objects"] += len(device.objects)
            row["made"] += len(complete(device).objects) - len(device.objects)
            try:
                differences = lost(device)
            except EsiError as error:
                reasons.append(str(error))
                continue
            row["image"] += 1
            row["given back"] += not differences
            row["size kept"] += not device.eeprom_bytes or len(write_sii(device)) == device.eeprom_bytes
            if differences:
                reasons.append(f"{device.origin}: {describe(device)}: the image loses {', '.join(differences)}")
    return rows


def count_pairs(folder: Path, files: list[DeviceFile], reasons: list[str]) -> tuple[dict[str, Counter[str]], int]:
    """Return the counts of pairs by repository, and the number of images without a description."""
    by_folder: dict[Path, list[tuple[str, Device]]] = defaultdict(list)
    for file in files:
        path = Path(file.path)
        by_folder[path.parent] += [(path.stem, device) for device in file.devices]
    rows: dict[str, Counter[str]] = defaultdict(Counter)
    alone = 0
    for path, image in images(folder):
        device = described(path, image, by_folder)
        if device is None:
            alone += 1
            continue
        equal = equal_parts(write_sii(device), image)
        name = path.relative_to(folder)
        row = rows[name.parts[0]]
        row["pairs"] += 1
        row["faultless"] += not check_sii(image)
        row.update(equal)
        different = ", ".join(part for part in PARTS if part not in ("fixed part", "bytes") and not equal[part])
        if different:
            reasons.append(f"{name}: another {different} than its description")
    return rows, alone


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    start = time.process_time()
    files, reasons = read_files(folder)
    seconds = time.process_time() - start
    print_table(COLUMNS, count_devices(files, reasons))
    size = sum(Path(file.path).stat().st_size for file in files)
    print(f"\n{size / 1e6:.1f} MB read in {seconds:.1f} s of CPU; {len(reasons)} files or devices with a reason\n")
    pairs, alone = count_pairs(folder, files, reasons)
    print_table(("pairs", "faultless", *PARTS), pairs)
    print(f"\n{alone} images without a description")
    print("\n".join(reasons), file=sys.stderr)


if __name__ == "__main__":
    main()
