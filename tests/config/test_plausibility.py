"""Values in the wrong unit: allowed, and each a warning with file, line, key, value and the likely mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from rtcp.config import default_config, load


@pytest.mark.parametrize(
    ("old", "new", "warning"),
    [
        ("position: {min: -3.1, max: 3.1}", "position: {min: -180, max: 3.1}",
         "joints[0].position.min: found -180 rad, plausible is at most 12.57 rad: if this is in degrees, "
         "write -3.14159"),
        ("position: {min: -3.1, max: 3.1}", "position: {min: -3.1, max: 180}", "joints[0].position.max: found 180"),
        ("velocity: 0.5", "velocity: 30", "joints[0].velocity: found 30 rad/s, "),
        ("acceleration: 2.0", "acceleration: 400", "joints[0].acceleration: found 400 rad/s^2, "),
        ("a: 0.440", "a: 44", "kinematics.dh[2].a: found 44 m, plausible is at most 5 m: if this is in millimetres, "
         "write 0.044"),
        ("{shoulder: 0.03,", "{shoulder: 30,", "cartesian.singularity.shoulder: found 30 m, "),
        ("elbow: 0.08,", "elbow: 5,", "cartesian.singularity.elbow: found 5 rad, "),
    ],
)  # fmt: skip
def test_a_value_that_is_plausible_only_in_another_unit_is_a_warning(
    directory: Path, old: str, new: str, warning: str
) -> None:
    file = directory / "assistive_arm.yaml"
    text = file.read_text()
    assert old in text
    at = text.index(new) if new in text else text.index(old)
    file.write_text(text.replace(old, new, 1))
    line = text.count("\n", 0, at) + 1
    assert load(Path("assistive_arm.yaml")).warnings[0].startswith(f"assistive_arm.yaml:{line}: {warning}")


def test_several_values_in_degrees_are_a_warning_each_and_the_shipped_file_has_none(directory: Path) -> None:
    assert load(default_config()).warnings == ()
    file = directory / "assistive_arm.yaml"
    file.write_text(file.read_text().replace("{min: -3.1, max: 3.1}", "{min: -180, max: 180}"))
    assert len(load(Path("assistive_arm.yaml")).warnings) == 6
