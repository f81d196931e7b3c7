"""A configuration as JSON and back: exact, and refused with its key where it is damaged."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from kinematics.model import ArmModel, DhRow, JointLimit, LinkMass
from kinematics.pose import Pose
from rtcp.config import default_config, load
from rtcp.config.model import ArmConfig, GripperConfig, Joint, Range, SlaveConfig
from rtcp.config.serialization import from_json, to_json

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
st.register_type_strategy(
    Path, st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20).map(Path)
)
ANGLES = st.floats(-3, 3)
MODELS = st.builds(
    ArmModel,
    name=st.text(),
    rows=st.lists(st.builds(DhRow, NUMBERS, NUMBERS, NUMBERS, NUMBERS), min_size=6, max_size=6).map(tuple),
    limits=st.lists(
        st.builds(JointLimit, st.floats(-9, 0), st.floats(0.5, 9), st.just(math.inf) | st.floats(0.1, 9)),
        min_size=6, max_size=6,
    ).map(tuple),
    links=st.just(()) | st.lists(
        st.builds(LinkMass, st.floats(0, 9), st.tuples(NUMBERS, NUMBERS, NUMBERS)), min_size=6, max_size=6
    ).map(tuple),
    tool=st.builds(Pose.from_xyzrpy, NUMBERS, NUMBERS, NUMBERS, ANGLES, ANGLES, ANGLES),
)  # fmt: skip
st.register_type_strategy(float, NUMBERS)
CONFIGS = st.builds(
    ArmConfig,
    slaves=st.lists(st.from_type(SlaveConfig), min_size=1, max_size=3).map(tuple),
    joints=st.lists(st.from_type(Joint), min_size=1, max_size=3).map(tuple),
    gripper=st.none() | st.builds(GripperConfig, joint=st.from_type(Joint), open_position=NUMBERS),
    arm=st.none() | MODELS,
)


def through_text(config: ArmConfig) -> ArmConfig:
    return from_json(ArmConfig, json.loads(json.dumps(to_json(config))))


@given(CONFIGS)
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
def test_every_configuration_survives_json_exactly(config: ArmConfig) -> None:
    restored = through_text(config)
    assert restored == config
    assert repr(restored) == repr(config)


def test_the_shipped_configuration_with_infinite_limits_survives_json_exactly() -> None:
    shipped = load(default_config())
    assert shipped.arm is not None
    limits = tuple(replace(limit, velocity=math.inf) for limit in shipped.arm.limits)
    config = replace(shipped, arm=replace(shipped.arm, limits=limits), zero_offsets=(-0.0, 0.1), gripper=None)
    assert repr(through_text(config)) == repr(config)
    assert isinstance(through_text(config).joints[0].position, Range)


DAMAGED: dict[str, tuple[Any, str]] = {
    "no mapping": (lambda data: [], "ArmConfig: found"),
    "a missing key": (lambda data: data["cycle"].pop("period_us"), "ArmConfig.cycle: .* period_us"),
    "an unknown key": (lambda data: data["bus"].update(extra=1), "ArmConfig.bus: .* extra"),
    "a text for a number": (lambda data: data["joints"][1].update(velocity="1"), r"joints\[1\].velocity: found '1'"),
    "true for a number": (lambda data: data.update(lease_s=True), "lease_s: found True"),
    "a number for a list": (lambda data: data.update(slaves=3), "slaves: found 3"),
    "another choice": (lambda data: data["stops"].update(slave_lost="hold"), "stops.slave_lost: found 'hold'"),
    "a corner of two numbers": (lambda data: data["arm"]["links"][0].update(centre=[0.0, 1.0]), r"links\[0\].centre"),
    "a list for a path": (lambda data: data.update(source=[]), "source: found"),
    "nothing for a number": (lambda data: data.update(lease_s=None), "lease_s: found None"),
}


@pytest.mark.parametrize(("damage", "message"), DAMAGED.values(), ids=DAMAGED.keys())
def test_a_damaged_form_is_refused_with_its_key(damage: Any, message: str) -> None:
    data = to_json(load(default_config()))
    damaged = damage(data)
    with pytest.raises(ValueError, match=message):
        from_json(ArmConfig, damaged if damaged == [] else data)


def test_reading_the_form_loads_no_validator() -> None:
    form = json.dumps(to_json(load(default_config())))
    code = (
        "import sys, json; from rtcp.config.model import ArmConfig; "
        "from rtcp.config.serialization import from_json; from_json(ArmConfig, json.load(sys.stdin)); "
        "print({'pydantic', 'yaml', 'ruamel', 'numpy'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], input=form, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
