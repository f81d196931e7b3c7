"""Mutated ESI files and SII images: bytes, and elements of a file that stays well-formed.

    python -m tests.esi.mutate FIRST COUNT

reads COUNT mutated files and images from seed FIRST on, and prints the seeds that raised anything but EsiError.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path
from random import Random
from xml.etree import ElementTree

from rtcp.esi.dictionary import complete
from rtcp.esi.model import EsiError
from rtcp.esi.modules import assemble
from rtcp.esi.reader import find_device, read_esi
from rtcp.esi.sii import check_sii, read_sii, write_sii
from rtcp.esi.units import unit

FILES = Path(__file__).parent / "files"
XML = [path.read_bytes() for path in sorted(FILES.glob("*.xml")) if path.stat().st_size < 30_000]
IMAGES = [path.read_bytes() for path in sorted(FILES.glob("*.bin"))]
VALUES = (
    "", "0", "-1", "1", "7", "16", "255", "256", "65535", "65536", "4294967296", "99999999999999999999", "#x", "#xFFFF",
    "#xFFFFFFFFFFFFFFFF", "0x10", "nan", "inf", "1e999", "true", "no", "ü", "\u0661", "UINT", "BIT3", "STRING(9)",
    "REAL",
    "STRING(999999)", "ARRAY [0..3] OF BYTE", "ARRAY [0..999999] OF UDINT", "DT607D", "DT607DARR", "DT2000", "Mode",
    "FF", "zz", "Inputs", "MBoxOut", "x" * 300,
)  # fmt: skip
FRAGMENTS = [
    b"<", b">", b"</", b"/>", b"&", b"&#0;", b"&#xD800;", b"]]>", b"<![CDATA[", b"<!--", b"<?", b"<!DOCTYPE a>", b"\0",
    b"\xff", b"\xef\xbb\xbf", b"\xff\xfe", b'"', b"<Device>", b"</Device>", b"encoding='utf-16'",
]  # fmt: skip


def mutated_bytes(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4, 16))):
        place = random.randrange(len(changed) + 1)
        match random.randrange(5):
            case 0:
                changed[place : place + 1] = bytes([random.randrange(256)])
            case 1:
                changed[place:place] = random.choice(FRAGMENTS)
            case 2:
                del changed[place : place + random.randrange(1, 64)]
            case 3:
                other = random.randrange(len(changed) + 1)
                changed[place:place] = changed[other : other + random.randrange(1, 400)]
            case 4 if random.random() < 0.2:
                del changed[place:]
    return bytes(changed)


def mutated_elements(data: bytes, random: Random) -> bytes:
    root = ElementTree.fromstring(data)
    nodes = list(root.iter())
    growing, copies = 4, random.choice((1, 1, 3, 300))
    for _ in range(random.choice((1, 1, 2, 4, 16, 64))):
        node, other = random.choice(nodes), random.choice(nodes)
        kind = random.randrange(8)
        growing -= kind >= 6
        match kind if growing >= 0 else 0:
            case 0 | 1 | 2:
                node.text = random.choice(VALUES)
            case 3:
                if node.attrib:
                    node.attrib[random.choice(sorted(node.attrib))] = random.choice(VALUES)
            case 4:
                node.tag, other.tag = other.tag, node.tag
            case 5:
                if len(node):
                    node.remove(random.choice(list(node)))
            case 6:
                if len(node):
                    child = random.choice(list(node))
                    node.extend([child] * copies)
                    copies = 1
            case 7:
                if other not in node.iter() and node not in other.iter():
                    node.append(other)
    return bytes(ElementTree.tostring(root))[: 1 << 21]


def read_file(path: Path) -> None:
    """Use a file as the platform does; refusals are EsiError."""
    file = read_esi(path)
    try:
        find_device(file, product=0x402)
    except EsiError:
        pass
    for device in file.devices:
        made = [device]
        try:
            made.append(assemble(device, file.modules))
        except EsiError:
            pass
        for form in made:
            whole = complete(form)
            for entry in (entry for item in whole.objects for entry in item.entries):
                unit(entry.unit or 0, form.unit_symbols)
            try:
                read_image(write_sii(whole))
            except EsiError:
                pass


def read_image(image: bytes) -> None:
    """Use an image as the platform does."""
    check_sii(image)
    device = read_sii(image)
    complete(device)
    write_sii(device)


def failing(first: int, count: int, directory: Path) -> list[str]:
    """Return the exceptions other than EsiError of mutated files and images, with their seeds."""
    places = []
    path = directory / "mutated.xml"
    for seed in range(first, first + count):
        random = Random(seed)
        try:
            if seed % 4 == 3:
                read_image(mutated_bytes(random.choice(IMAGES), random))
            else:
                data = random.choice(XML)
                path.write_bytes((mutated_bytes if seed % 4 == 2 else mutated_elements)(data, random))
                read_file(path)
        except EsiError as error:
            if len(str(error)) > 100_000:
                places.append(f"seed {seed}: a message of {len(str(error))} characters")
        except Exception as error:
            places.append(f"seed {seed}: {type(error).__name__}: {error}")
    return places


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print("\n".join(failing(int(sys.argv[1]), int(sys.argv[2]), Path(folder))))
    print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10} MiB at most", file=sys.stderr)
