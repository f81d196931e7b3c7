"""Values in the wrong unit: refused with file, line, key, value and the likely mistake, unless they are marked."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import load, load_device, load_kinematics
from rtcp.config.model import ConfigError
from tests.e2e.arms import replace_drives

ARM, DRIVE = "assistive_arm.yaml", "devices/two-axis-drive.yaml"


def change(file: Path, old: str, new: str) -> int:
    """Replace the first place of a text; return the line where it begins."""
    text = file.read_text()
    at = text.index(old)
    file.write_text(text.replace(old, new, 1))
    return text.count("\n", 0, at) + 1


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("position: {min: -3.1, max: 3.1}", "position: {min: -180, max: 3.1}",
         "joints[0].position.min: found -180 rad, plausible is at most 12.57 rad: if this is in degrees, "
         "write -3.14159; if it is right, write {value: -180, unusual: true}"),
        ("position: {min: -3.1, max: 3.1}", "position: {min: -3.1, max: 180}", "joints[0].position.max: found 180"),
        ("velocity: 0.5", "velocity: 30", "joints[0].velocity: found 30 rad/s, "),
        ("acceleration: 2.0", "acceleration: 400", "joints[0].acceleration: found 400 rad/s^2, "),
        ("torque: 49.0", "torque: 49000", "joints[0].torque: found 49000 Nm, plausible is at most 3000 Nm: if this is "
         "in mNm, write 49;"),
        ("a: 0.440", "a: 44", "kinematics.dh[2].a: found 44 m, plausible is at most 5 m: if this is in millimetres, "
         "write 0.044"),
        ("{shoulder: 0.03,", "{shoulder: 30,", "cartesian.singularity.shoulder: found 30 m, "),
        ("elbow: 0.08,", "elbow: 5,", "cartesian.singularity.elbow: found 5 rad, "),
    ],
)  # fmt: skip
def test_a_value_that_is_plausible_only_in_another_unit_is_refused(
    directory: Path, old: str, new: str, sentence: str
) -> None:
    line = change(directory / ARM, old, new)
    with pytest.raises(ConfigError) as refused:
        load(Path(ARM))
    assert str(refused.value.findings[0]).startswith(f"{ARM}:{line}: {sentence}")


def test_several_values_in_degrees_are_a_mistake_each(directory: Path) -> None:
    file = directory / ARM
    file.write_text(file.read_text().replace("{min: -3.1, max: 3.1}", "{min: -180, max: 180}"))
    with pytest.raises(ConfigError) as refused:
        load(Path(ARM))
    assert [finding.code for finding in refused.value.findings] == ["implausible"] * 6


def test_a_value_that_is_marked_as_unusual_is_accepted_and_a_mark_elsewhere_is_refused(directory: Path) -> None:
    change(directory / ARM, "acceleration: 2.0", "acceleration: {value: 400, unusual: true}")
    assert load(Path(ARM)).joints[0].acceleration == 400
    change(directory / ARM, "jerk: 20.0", "jerk: {value: 20.0, unusual: true}")
    with pytest.raises(ConfigError, match=r"joints\[0\]\.jerk: this value is marked as unusual, but the key has no"):
        load(Path(ARM))
    change(directory / ARM, "{value: 20.0, unusual: true}", "{value: 20.0, unusual: false}")
    with pytest.raises(ConfigError, match=r"joints\[0\]\.jerk: found a mapping, allowed is a number"):
        load(Path(ARM))


def test_a_rated_torque_in_millinewton_metres_is_refused_unless_it_is_marked(directory: Path) -> None:
    change(directory / DRIVE, "rated_torque: 40 ", "rated_torque: 40000 ")
    with pytest.raises(ConfigError, match=r"scaling\[0\]\.rated_torque: found 40000 Nm, .* in mNm, write 40;"):
        load_device(directory / DRIVE)
    change(directory / DRIVE, "rated_torque: 40000 ", "rated_torque: {value: 40000, unusual: true} ")
    assert load_device(directory / DRIVE).scaling[0].rated_torque == 40000


def test_a_file_of_kinematics_alone_is_held_to_the_same(directory: Path) -> None:
    file = directory / "geometry.yaml"
    length = load_kinematics(file).rows[2].a
    change(file, f"a: {length:.3f}", "a: 44")
    with pytest.raises(ConfigError, match=r"kinematics\.dh\[2\]\.a: found 44 m, plausible is at most 5 m"):
        load_kinematics(file)
    change(file, "a: 44", "a: {value: 44, unusual: true}")
    assert load_kinematics(file).rows[2].a == 44


def test_a_speed_that_the_motor_cannot_reach_is_refused_unless_it_is_marked(directory: Path) -> None:
    replace_drives(directory, "two-axis")
    load(Path(ARM))
    change(directory / DRIVE, "    rated_torque: 40", "    max_motor_speed: 200\n    rated_torque: 40")
    sentence = r"joints\[0\]\.velocity: found 0\.5 rad/s, but the drive turns the joint with at most 0\.4189 rad/s"
    with pytest.raises(ConfigError, match=sentence):
        load(Path(ARM))
    (directory / ARM).write_text(
        (directory / ARM).read_text().replace("velocity: 0.5", "velocity: {value: 0.5, unusual: true}")
    )
    load(Path(ARM))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("max: 0.8}", "max: 800}", "external_axes[0].position.max: found 800 m, plausible is at most 20 m: if this is "
         "in millimetres, write 0.8;"),
        ("acceleration: 0.5 ", "acceleration: 500 ", "external_axes[0].acceleration: found 500 m/s^2, "),
        ("velocity: 0.2\n", "velocity: 200\n", "external_axes[1].velocity: found 200 m/s, "),
        ("velocity: 0.2\n", "velocity: 30\n    position: {min: -180, max: 3.1}\n    unit: rad\n",
         "external_axes[1].position.min: found -180 rad, plausible is at most 12.57 rad: if this is in degrees"),
    ],
)  # fmt: skip
def test_an_external_axis_in_another_unit_is_refused(directory: Path, old: str, new: str, sentence: str) -> None:
    file = directory / "linear_axis.yaml"
    change(file, old, new)
    if "unit: rad" in new:
        before, belt = file.read_text().split("- name: belt")
        file.write_text(f"{before}- name: belt{belt.replace('    unit: m ', '    # ', 1)}")
    with pytest.raises(ConfigError) as refused:
        load(file)
    assert any(sentence in str(finding) for finding in refused.value.findings), refused.value.findings


def test_a_speed_of_a_rotary_axis_that_its_motor_cannot_reach_is_refused(directory: Path) -> None:
    change(directory / DRIVE, "    rated_torque: 40", "    max_motor_speed: 200\n    rated_torque: 40")
    file = directory / "linear_axis.yaml"
    change(file, "drive2, device: cubemars-orh-linear", "drive2, device: two-axis-drive")
    change(file, "unit: m                 # no position", "unit: rad    # no position")
    change(file, "velocity: 0.2\n", "velocity: 0.5\n")
    sentence = (
        r"external_axes\[1\]\.velocity: found 0\.5 rad/s, but the drive turns the joint with at most 0\.4189 rad/s"
    )
    with pytest.raises(ConfigError, match=sentence):
        load(file)
    change(file, "velocity: 0.5\n", "velocity: {value: 0.5, unusual: true}\n")
    load(file)
