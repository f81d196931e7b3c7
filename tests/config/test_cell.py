"""The file of a cell: what it holds, and its mistakes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rtcp.config import ConfigError, default_config
from rtcp.config.cell import CellConfig, is_platform_name
from rtcp.config.cell_file import load_cell
from rtcp.config.serialization import from_json, to_json
from tests.findings import assert_finds

CONFIG = default_config().parent
ARM = str(CONFIG / "assistive_arm.yaml")


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("file", ["cell.yaml", "cell_mixed.yaml", "cell_irc5.yaml", "cell_egm.yaml"])
def test_the_shipped_cells_are_read_and_handed_to_the_loops(file: str) -> None:
    cell = load_cell(CONFIG / file)
    assert len(cell.arms) == 2
    assert from_json(CellConfig, to_json(cell)) == cell


def test_a_partner_may_be_silent_for_two_cycles_of_the_slowest_arm(tmp_path: Path) -> None:
    arms = f"arms: [{{name: a, config: {ARM}}}, {{name: b, config: {CONFIG / 'abb_irb120.yaml'}}}]\n"
    cell = load_cell(written(tmp_path, f"name: c\n{arms}"))
    assert cell.longest_silence_s == pytest.approx(2 * 4.032e-3)
    assert load_cell(written(tmp_path, f"name: c\n{arms}silence_s: 0.1\n")).longest_silence_s == 0.1


def test_a_cell_is_told_from_another_by_what_its_files_say_not_by_where_they_are(tmp_path: Path) -> None:
    text = f"name: c\narms: [{{name: a, config: {ARM}}}, {{name: b, config: {ARM}, base: {{position: [0, 1, 0]}}}}]\n"
    cell = load_cell(written(tmp_path, text))
    (tmp_path / "elsewhere").mkdir()
    assert load_cell(written(tmp_path / "elsewhere", text)).digest == cell.digest
    assert load_cell(CONFIG / "../config/cell.yaml").digest == load_cell(CONFIG / "cell.yaml").digest
    assert load_cell(written(tmp_path, text.replace("[0, 1, 0]", "[0, 1.1, 0]"))).digest != cell.digest


A, B = f"{{name: a, config: {ARM}}}", f"{{name: b, config: {ARM}}}"


@pytest.mark.parametrize(
    ("arms", "more", "expected"),
    [
        (A, "", "2 arms: size found=1"),
        (f"{A}, {A}", "", "2 arms[1].name: repeated of=arms[0].name"),
        (f"{A.replace(': a', ': ../a')}, {B}", "", "2 arms[0].name: platform_name"),
        (f"{{name: a, config: none.yaml}}, {B}", "", ": no_file"),
        (f"{A}, {B[:-1]}, at: 1}}", "", "2 arms[1].at: unknown"),
        (f"{A}, {B}", "silence_s: 0", "3 silence_s: range"),
        (f"{A}, {B}", "clearance: .nan", "3 clearance: range"),
        (f"{A[:-1]}, base: {{rpy: [0, 0, 90]}}}}, {B}", "", "2 arms[0].base.rpy[2]: range"),
    ],
)
def test_every_mistake_is_named(tmp_path: Path, arms: str, more: str, expected: str) -> None:
    file = written(tmp_path, f"name: c\narms: [{arms}]\n{more}\n")
    assert_finds(lambda: load_cell(file), expected)


def test_a_mistake_in_the_file_of_an_arm_is_one_of_the_cells_with_the_arm(tmp_path: Path) -> None:
    file = written(tmp_path, f"name: c\narms: [{{name: a, config: none.yaml}}, {B}]\n")
    with pytest.raises(ConfigError, match=rf"^{file}: arm a: {tmp_path}/none.yaml: there is no such file$"):
        load_cell(file)


def test_an_arm_that_is_not_in_the_cell_is_named() -> None:
    with pytest.raises(ConfigError, match="allowed is one of left, right"):
        load_cell(CONFIG / "cell.yaml").member("middle")


@pytest.mark.parametrize("name", ["", "..", "a/b", "1st", "-a", "a" * 33, "a b", "ä"])
def test_a_name_that_could_be_another_path_is_none(name: str) -> None:
    assert not is_platform_name(name)
    assert is_platform_name("left_arm-2")


# -- several arms at one controller ------------------------------------------------------------------------------------

RAPID = "config: abb_irb120_rapid.yaml"
EGM = "config: abb_irb120.yaml"
SHARED = (
    "name: a\narms: [{{name: left, {0}}}, {{name: right, {1}}}]\ncontrollers: [{{arms: [{2}], segment: two.yaml}}]\n"
)


def shared(folder: Path, *parts: str) -> CellConfig:
    """Load a cell whose arms are at one controller; the files are beside the shipped ones."""
    for file in default_config().parent.glob("abb_irb120*.yaml"):
        (folder / file.name).write_text(file.read_text())
    path = folder / "cell.yaml"
    path.write_text(SHARED.format(*parts))
    return load_cell(path)


def test_the_arms_of_a_controller_share_its_virtual_one_and_by_egm_have_a_port_each(tmp_path: Path) -> None:
    cell = shared(tmp_path, EGM, EGM, "right, left")
    ports = {arm.name: (arm.config.bus.port, arm.config.bus.segment) for arm in cell.arms}  # type: ignore[attr-defined]
    assert ports == {"right": (6511, "two.yaml"), "left": (6512, "two.yaml")}
    units = cell.units_of("left")
    assert units is not None
    assert ([member.name for member in units.members], units.index) == (["right", "left"], 1)


def test_an_arm_that_no_controller_names_has_one_of_its_own() -> None:
    assert load_cell(default_config().with_name("cell.yaml")).units_of("left") is None


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ((RAPID, RAPID, "left, other"), 'found the text "other", allowed is one of left, right'),
        ((RAPID, RAPID, "left, left"), "each needs its own"),
        ((RAPID, EGM, "left, right"), "found the bus egm virtual, allowed is the kind and the interface of left"),
    ],
)
def test_arms_that_no_controller_can_have_are_named(tmp_path: Path, parts: tuple[str, str, str], words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        shared(tmp_path, *parts)


def test_the_board_belongs_to_the_first_arm(tmp_path: Path) -> None:
    text = (default_config().parent / "abb_irb120_rapid.yaml").read_text()
    (tmp_path / "with_board.yaml").write_text(text.replace("  kind: rapid", "  kind: rapid\n  board: dsqc652"))
    with pytest.raises(ConfigError, match="left, whose platform holds the connection, has the board"):
        shared(tmp_path, RAPID, "config: with_board.yaml", "left, right")
