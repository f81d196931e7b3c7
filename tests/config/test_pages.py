"""The pages in docs/ against the code that their generated parts are made of."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.generate import FOLDER, generated, keys_of
from rtcp.config.model import ArmFile, DeviceDescription, MotionFile
from rtcp.config.segment import SegmentFile

PAGES = sorted(FOLDER.glob("*.md"))
OWN = [
    "configuration.md",
    "operation.md",
    "terminals.md",
    "recording.md",
    "simple_message.md",
    "devices.md",
    "descriptions.md",
    "channels.md",
    "drives.md",
    "segment.md",
    "behaviours.md",
    "guiding.md",
    "conformance.md",
    "your_own_arm.md",
    "stops.md",
    "recovery.md",
    "machine.md",
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
    arm_pages = (*OWN[:5], "guiding.md", "kinematics.md", "processes.md", "stops.md")
    arm = "".join((FOLDER / name).read_text() for name in arm_pages)
    device = "".join((FOLDER / name).read_text() for name in ("devices.md", "channels.md", "drives.md"))
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


def test_every_test_that_the_conformance_page_names_exists() -> None:
    tests = "".join(file.read_text() for file in (FOLDER.parent / "tests").rglob("test_*.py"))
    named = re.findall(r"`(test_\w+)`", (FOLDER / "conformance.md").read_text())
    assert len(named) > 40
    assert [name for name in named if f"def {name}(" not in tests] == []
