"""The pages in docs/ against the code that their generated parts are made of."""

from __future__ import annotations

import re
import shlex
import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from docs.generate import FOLDER, generated, keys_of
from rtcp.cli.__main__ import app
from rtcp.config.loader import load_device
from rtcp.config.model import ArmFile, DeviceDescription, MotionFile
from rtcp.config.segment import SegmentFile
from rtcp.virtual.heater_circuit import CircuitData

PAGES = sorted(FOLDER.glob("*.md"))
OWN = [
    "configuration.md",
    "operation.md",
    "limits.md",
    "terminals.md",
    "recording.md",
    "simple_message.md",
    "devices.md",
    "descriptions.md",
    "channels.md",
    "drives.md",
    "drive_behaviours.md",
    "drive_settings.md",
    "homing.md",
    "segment.md",
    "distributed_clocks.md",
    "behaviours.md",
    "guiding.md",
    "external_axes.md",
    "conformance.md",
    "your_own_arm.md",
    "stops.md",
    "recovery.md",
    "machine.md",
    "realtime_kernel.md",
    "jetson.md",
    "wiring.md",
    "shape_setting_hardware.md",
    "commissioning.md",
    "actuators.md",
    *(THESIS := ["thesis.md", "thesis_program.md", "thesis_experiments.md", "thesis_appendices.md"]),
    "thesis_errata.md",
    "experiments.md",
    "user_trials.md",
]
FILES = {"arm": ArmFile, "device": DeviceDescription, "segment": SegmentFile, "motion": MotionFile}
UNITS = r"\b(m|rad)(/s[²³]?)?\b|\bNm\b|\bkg\b|\b1/s\b|, (s|ms|us|ns)\b|parts per million|, A\b|[Rr]evolution"
WITHOUT_UNIT = r"SI value|channel's unit|[Ff]raction|[Mm]ultiple|Factor|per count|Value to write"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_generated_parts_of_a_page_are_up_to_date(page: Path) -> None:
    # `python docs/generate.py` writes them.
    assert generated(page.read_text()) == page.read_text()


@pytest.mark.parametrize("file", FILES)
def test_every_key_of_a_file_is_on_exactly_one_page(file: str) -> None:
    arm_pages = (*OWN[:6], "external_axes.md", "guiding.md", "homing.md", "kinematics.md", "processes.md", "stops.md")
    arm = "".join((FOLDER / name).read_text() for name in arm_pages)
    device_pages = ("devices.md", "channels.md", "drives.md", "drive_settings.md")
    device = "".join((FOLDER / name).read_text() for name in device_pages)
    text = {"arm": arm, "device": device} | {
        kind: (FOLDER / page).read_text() for kind, page in (("segment", "segment.md"), ("motion", "motion.md"))
    }
    paths = [key.path for key in keys_of(FILES[file])]
    written = re.findall(r"^\| `([\w.\[\]]+)` \|.*\|.*\|.*\|$", text[file], re.MULTILINE)
    assert sorted(set(written) & set(paths)) == sorted(paths)
    assert len(set(written)) == len(written)


def test_every_key_has_a_meaning_and_every_number_its_unit() -> None:
    every_key = [key for kind in FILES.values() for key in keys_of(kind)]
    numbers = [key for key in every_key if key.allowed.startswith(("a number", "a list of 3 numbers"))]
    assert [key.path for key in every_key if not key.meaning] == []
    assert [key.path for key in numbers if not re.search(f"{UNITS}|{WITHOUT_UNIT}", key.meaning)] == []


def test_the_readme_leads_to_the_pages_for_programmers_and_no_link_is_dead() -> None:
    readme, pages = FOLDER.parent / "README.md", (FOLDER / name for name in ("first_program.md", "motion.md", "api.md"))
    for page in (readme, *pages):
        links = re.findall(r"\]\(([^)#:]+)[)#]", page.read_text())
        assert [link for link in links if not (page.parent / link).exists()] == []
    wanted = {"first_program", "api", "extending", "segment", "motion"}
    assert wanted <= set(re.findall(r"\]\(docs/(\w+)\.md", readme.read_text()))


@pytest.mark.parametrize("name", OWN)
def test_a_page_is_short_and_its_links_lead_somewhere(name: str) -> None:
    text = (FOLDER / name).read_text()
    assert len(text) <= 8000
    for link, anchor in re.findall(r"\]\(([^)#:]+)(?:#([\w-]+))?\)", text):
        target = FOLDER / link
        assert target.exists(), link
        titles = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE) if anchor else []
        assert not anchor or anchor in [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]


@pytest.mark.parametrize("name", [*THESIS, "specification.md"])
def test_every_test_that_a_page_of_sentences_names_exists_in_its_file(name: str) -> None:
    tests = FOLDER.parent / "tests"
    named = re.findall(r"`(?:tests/)?([\w/.]+)::(\w*)`", (FOLDER / name).read_text())
    assert len(named) >= 5
    gone = [f"{file}::{test}" for file, test in named if f"def {test}(" not in (tests / file).read_text()]
    assert gone == []


def test_every_row_of_the_specification_names_a_test() -> None:
    rows = re.findall(r"^\| \d.*$", (FOLDER / "specification.md").read_text(), re.MULTILINE)
    assert len(rows) >= 35
    cells = [[cell.strip() for cell in row.strip("| ").split(" | ")] for row in rows]
    assert [row[:2] for row in cells if len(row) != 6 or not re.search(r"`[\w/.]+::test_\w+`", row[-1])] == []


def terminals_of(picture: Path) -> dict[str, tuple[float, float, float, float]]:
    """Return the named terminals of a drawing with their rectangles: left, top, right, bottom."""
    shapes = list(ET.parse(picture).getroot())
    found = {}
    for rect, text in pairwise(shapes):
        if rect.get("class") == "terminal" and text.tag.endswith("text"):
            left, top, width, height = (float(rect.get(key, "")) for key in ("x", "y", "width", "height"))
            name = text.text or ""
            assert name not in found, f"{picture.name}: two terminals {name}"
            found[name] = (left, top, left + width, top + height)
    return found


def corners_of(picture: Path) -> list[tuple[float, float]]:
    """Return the corners and ends of all wires of a drawing."""
    corners = []
    for path in ET.parse(picture).getroot():
        x = y = 0.0
        for kind, numbers in re.findall(r"([MLHV])([\d. ]+)", path.get("d", "")):
            values = [float(number) for number in numbers.split()]
            x = values[0] if kind in "MLH" else x
            y = values[-1] if kind in "MLV" else y
            corners.append((x, y))
    return corners


HEATER = [FOLDER / "images" / f"shape-setter-{name}.svg" for name in ("power", "control")]


def test_the_drawings_of_the_heater_have_each_channel_of_its_devices_as_one_terminal() -> None:
    folder = FOLDER.parent / "config" / "devices"
    devices = [load_device(folder / f"shape-setter-{name}.yaml") for name in ("box", "meter")]
    channels = [entry.name for device in devices for pdo in (*device.rpdo, *device.tpdo) for entry in pdo.channels]
    terminals = [name for picture in HEATER for name in terminals_of(picture)]
    assert sorted(terminals) == sorted(name for name in channels if name != "padding")


@pytest.mark.parametrize("picture", [*HEATER, *sorted(FOLDER.glob("images/wiring-*.svg"))], ids=lambda path: path.stem)
def test_a_wire_leads_to_each_terminal_of_a_drawing(picture: Path) -> None:
    corners = corners_of(picture)
    unconnected = [
        name
        for name, (left, top, right, bottom) in terminals_of(picture).items()
        # The counter of the box is no signal from outside.
        if name != "alive" and not any(left <= x <= right and top <= y <= bottom for x, y in corners)
    ]
    assert unconnected == []


def test_the_ratings_of_the_heaters_parts_are_those_of_the_virtual_circuit() -> None:
    page = (FOLDER / "shape_setting_hardware.md").read_text()
    parts = page.partition("## Parts and ratings")[2].partition("\n## ")[0]
    stated = re.findall(r"`(\w+)` ([\d.e-]*\d)", parts)
    assert len(stated) >= 15
    model = CircuitData()
    assert {name: float(value) for name, value in stated} == {name: getattr(model, name) for name, _ in stated}
    assert "3 s at 600 A" in page
    assert model.fuse_melting / (600.0**2 - model.fuse_rating**2) == pytest.approx(3.0, abs=0.1)


def test_the_costs_of_the_heater_add_up() -> None:
    rows = (FOLDER / "shape_setting_hardware.md").read_text().partition("## Cost")[2]
    costs = [int(cost) for cost in re.findall(r"\| (\d+) \|$", rows, re.MULTILINE)]
    assert sum(costs[:-1]) == costs[-1]


SET_UP = ["realtime_kernel.md", "jetson.md", "wiring.md", "commissioning.md"]
USE = ["limits.md", "experiments.md", "user_trials.md"]


@pytest.mark.parametrize("name", [*THESIS, "thesis_errata.md", *SET_UP, *USE])
def test_every_file_of_the_repository_that_a_page_of_the_thesis_or_of_its_use_names_exists(name: str) -> None:
    named = re.findall(r"(?<![\w./-])(?:\.\./)?(\w[\w./-]*/[\w.-]+\.yaml)", (FOLDER / name).read_text())
    assert [file for file in named if not (FOLDER.parent / file).exists()] == []


@pytest.mark.parametrize("name", [*THESIS, *SET_UP, *USE])
def test_every_command_that_a_page_of_the_thesis_or_of_the_set_up_names_exists(name: str) -> None:
    text = (FOLDER / name).read_text()
    blocks = "\n".join(re.findall(r"^    (.*)$", text, re.MULTILINE)) + "\n" + "\n".join(re.findall(r"`([^`]+)`", text))
    lines = re.findall(r"(?:^|&& )(rtcp [^#&\n]+)", blocks, re.MULTILINE)
    assert lines
    root: Any = get_command(app)
    for line in lines:
        command, words = root, shlex.split(line)[1:]
        while words and hasattr(command, "commands"):
            assert words[0] in command.commands, line
            command = command.commands[words.pop(0)]
        options = {option for parameter in command.params for option in parameter.opts}
        assert [word for word in words if word.startswith("--") and word not in options] == [], line


def test_every_test_that_the_conformance_page_names_exists() -> None:
    tests = "".join(file.read_text() for file in (FOLDER.parent / "tests").rglob("test_*.py"))
    named = re.findall(r"`(test_\w+)`", (FOLDER / "conformance.md").read_text())
    assert len(named) > 40
    assert [name for name in named if f"def {name}(" not in tests] == []
