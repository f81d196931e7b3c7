"""`rtcp arm export-c` and `rtcp arm export-moveit`: the files agree with each other and with the arm."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar

import pytest
import yaml

from kinematics.c_source import to_c
from rtcp.cli.__main__ import main
from rtcp.cli.arm_moveit import moveit_package
from rtcp.config import find_arm, load, load_kinematics
from tests.cli.test_arm import UR5
from tests.moveit.solver import needs_cpp
from tests.moveit.test_plugin import HEADERS

STUBS = {
    "catkin": "set(catkin_FOUND TRUE)\nset(catkin_INCLUDE_DIRS ${STAND_INS})\nset(CATKIN_PACKAGE_LIB_DESTINATION lib)\n"
    "set(CATKIN_PACKAGE_SHARE_DESTINATION share)\nmacro(catkin_package)\nendmacro()\n",
    "ament_cmake": "set(ament_cmake_FOUND TRUE)\nmacro(ament_package)\nendmacro()\n",
    "pluginlib": "set(pluginlib_FOUND TRUE)\ninclude_directories(${STAND_INS})\n"
    "macro(pluginlib_export_plugin_description_file package file)\n"
    "message(STATUS \"exported to ${package}: ${file}\")\nendmacro()\n",
    **{name: f"set({name}_FOUND TRUE)\n" for name in ("geometry_msgs", "moveit_core", "moveit_msgs", "rclcpp")},
}  # fmt: skip
"""Stand-ins of the CMake packages that CMakeLists.txt looks for."""
HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("ws")
    assert main(["arm", "export-moveit", "--arm", "assistive_arm", "--out", str(out)]) == 0
    return out / "assistive_arm_moveit_config"


def read(package: Path, name: str) -> str:
    return (package / name).read_text()


def test_the_solver_in_the_package_is_the_exported_one(package: Path, tmp_path: Path) -> None:
    assert main(["arm", "export-c", "--arm", "assistive_arm", "--out", str(tmp_path / "new")]) == 0
    files = {file.name: file.read_text() for file in (tmp_path / "new").iterdir()}
    assert files == to_c(load_kinematics(find_arm("assistive_arm"))).files
    assert files == {name: read(package, f"src/{name}") for name in files}


def test_the_urdf_is_the_exported_one(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["arm", "urdf", "--arm", "assistive_arm"]) == 0
    assert capsys.readouterr().out == read(package, "config/assistive_arm.urdf")


def test_the_srdf_names_what_is_in_the_urdf(package: Path) -> None:
    urdf, srdf = (ET.fromstring(read(package, f"config/assistive_arm.{kind}")) for kind in ("urdf", "srdf"))
    assert srdf.get("name") == urdf.get("name")
    links = [link.get("name") for link in urdf.findall("link")]
    chain = srdf.find("group/chain")
    assert chain is not None
    assert chain.attrib == {"base_link": links[0], "tip_link": links[-1]}
    neighbours = {
        (joint.find("parent").get("link"), joint.find("child").get("link")) for joint in urdf.findall("joint")
    }
    unchecked = srdf.findall("disable_collisions")
    assert {
        (pair.get("link1"), pair.get("link2")) for pair in unchecked if pair.get("reason") == "Adjacent"
    } == neighbours
    revolute = [joint.get("name") for joint in urdf.findall("joint") if joint.get("type") == "revolute"]
    assert [joint.get("name") for joint in srdf.findall("group_state/joint")] == revolute


@pytest.mark.parametrize(
    ("arm", "wrist"), [("assistive_arm", "Default"), ("abb_irb120", "Always")]
)  # the tool is outside the wrist's cylinder, or inside
def test_links_that_always_overlap_are_not_checked_for_collisions(arm: str, wrist: str) -> None:
    files = moveit_package(find_arm(arm)).files
    [srdf] = [ET.fromstring(text) for name, text in files.items() if name.endswith(".srdf")]
    pairs = {tuple(pair.attrib.values()) for pair in srdf.findall("disable_collisions")}
    assert {pair for pair in pairs if pair[2] != "Adjacent"} == {
        ("base_link", "link2", "Always"),  # the first two axes meet
        ("link3", "link5", "Always"),  # so do those of the wrist
        ("link4", "link6", wrist),
    }


def test_the_limits_are_those_of_the_joints(package: Path) -> None:
    limits = yaml.safe_load(read(package, "config/joint_limits.yaml"))["joint_limits"]
    joints = load(find_arm("assistive_arm")).joints
    assert list(limits) == [joint.name for joint in joints]
    for joint in joints:
        for kind in ("velocity", "acceleration", "jerk"):
            assert limits[joint.name][f"has_{kind}_limits"] is True
            assert limits[joint.name][f"max_{kind}"] == getattr(joint, kind)


def test_what_an_arm_does_not_say_has_no_limit(tmp_path: Path) -> None:
    geometry = tmp_path / "geometry.yaml"
    text = find_arm("abb_irb120").read_text()
    geometry.write_text("name: abb-irb120\n\n" + text[text.index("kinematics:") :])
    files = moveit_package(geometry).files
    limits = yaml.safe_load(files["config/joint_limits.yaml"])["joint_limits"]["joint1"]
    assert [limits[f"has_{kind}_limits"] for kind in ("velocity", "acceleration", "jerk")] == [True, False, False]


def test_the_plugin_has_one_name_everywhere(package: Path) -> None:
    name = "assistive_arm_moveit_config"
    solver = yaml.safe_load(read(package, "config/kinematics.yaml"))["manipulator"]["kinematics_solver"]
    library = ET.fromstring(read(package, "kinematics_plugin.xml"))
    declared = library.find("class")
    assert declared is not None
    assert solver == declared.get("name") == f"{name}/KinematicsPlugin"
    assert declared.get("type") == f"{name}::KinematicsPlugin"
    assert library.get("path") == ET.fromstring(read(package, "package.xml")).findtext("name") == package.name == name
    assert f"PLUGINLIB_EXPORT_CLASS({name}::KinematicsPlugin," in read(package, "src/kinematics_plugin.cpp")


def test_the_controllers_of_both_moveits_have_the_same_action_and_joints(package: Path) -> None:
    new = yaml.safe_load(read(package, "config/moveit_controllers.yaml"))["moveit_simple_controller_manager"]
    [name] = new.pop("controller_names")
    [old] = yaml.safe_load(read(package, "config/simple_moveit_controllers.yaml"))["controller_list"]
    assert old == {"name": name, **new[name]}
    assert old["joints"] == [joint.name for joint in load(find_arm("assistive_arm")).joints]


def test_links_are_padded_and_pilz_has_its_limits_in_the_namespace_where_both_moveits_look(package: Path) -> None:
    arm = load(find_arm("assistive_arm")).cartesian
    assert yaml.safe_load(read(package, "config/joint_limits.yaml"))["default_robot_padding"] == arm.clearance == 0.01
    assert yaml.safe_load(read(package, "config/pilz_cartesian_limits.yaml")) == {
        "cartesian_limits": {
            "max_trans_vel": arm.speed,
            "max_trans_acc": arm.acceleration,
            "max_trans_dec": -arm.acceleration,
            "max_rot_vel": arm.angular_speed,
        }
    }


class Builder:
    """MoveItConfigsBuilder of moveit_configs_utils, which cannot be installed here, as to which files it reads."""

    package: ClassVar[Path]

    def __init__(self, robot: str, package_name: str) -> None:
        assert package_name == self.package.name
        self._robot, self._files = robot, {kind: f"config/{robot}.{kind}" for kind in ("urdf", "srdf")}
        self._pipelines: list[str] = []

    def robot_description(self, file_path: str) -> None:
        self._files["urdf"] = file_path

    def robot_description_semantic(self, file_path: str) -> None:
        self._files["srdf"] = file_path

    def planning_pipelines(self, default: str, pipelines: list[str]) -> None:
        assert default in pipelines
        self._pipelines = pipelines

    def to_moveit_configs(self) -> Any:
        """Read what it reads by default. Without a file for a pipeline it takes its own."""

        def found(name: str) -> Any:
            return yaml.safe_load(read(self.package, f"config/{name}.yaml"))

        files = {path.name for path in (self.package / "config").iterdir()}
        [controllers] = [name for name in ("moveit", "moveit2", self._robot) if f"{name}_controllers.yaml" in files][:1]
        limits = {"robot_description_planning": found("joint_limits")}
        parameters = {
            "robot_description": read(self.package, self._files["urdf"]),
            "robot_description_semantic": read(self.package, self._files["srdf"]),
            "robot_description_kinematics": found("kinematics"),
            "planning_pipelines": self._pipelines,
            **found(f"{controllers}_controllers"),
            # Early releases of Humble: in place of the joint limits.
            "robot_description_planning": found("pilz_cartesian_limits"),
        }
        assert not any(name.endswith("_planning.yaml") for name in files), "its own pipelines suit its version"
        return SimpleNamespace(to_dict=lambda: parameters, joint_limits=limits)


def test_moveit_2_is_started_with_all_that_moveit_configs_utils_reads(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Builder.package = package
    modules: dict[str, dict[str, Any]] = {
        "launch": {"LaunchDescription": list},
        "launch_ros": {},
        "launch_ros.actions": {"Node": dict},
        "moveit_configs_utils": {"MoveItConfigsBuilder": Builder},
    }
    for name, contents in modules.items():
        module = ModuleType(name)
        vars(module).update(contents)
        monkeypatch.setitem(sys.modules, name, module)
    started = runpy.run_path(str(package / "launch/move_group.launch.py"))["generate_launch_description"]()
    [node] = started
    assert (node["package"], node["executable"]) == ("moveit_ros_move_group", "move_group")
    everything, limits = node["parameters"]
    assert everything["planning_pipelines"] == ["ompl", "pilz_industrial_motion_planner"]
    assert everything["moveit_controller_manager"].endswith("MoveItSimpleControllerManager")
    assert limits["robot_description_planning"]["joint_limits"].keys() == {f"joint{n}" for n in range(1, 7)}


def test_the_setup_assistant_finds_urdf_and_srdf(package: Path) -> None:
    names = yaml.safe_load(read(package, ".setup_assistant"))["moveit_setup_assistant_config"]
    assert names["URDF"]["package"] == package.name
    assert [(package / names[kind]["relative_path"]).is_file() for kind in ("URDF", "SRDF")] == [True, True]


@pytest.mark.parametrize("name", ["config/assistive_arm.urdf", "config/assistive_arm.srdf"])
def test_xacro_finds_nothing_to_expand_in_the_descriptions(package: Path, name: str) -> None:
    """moveit_configs_utils passes both through xacro."""
    xacro = pytest.importorskip("xacro", reason="xacro is not installed: pip install xacro")
    expanded = xacro.process_file(str(package / name)).toxml()
    assert ET.canonicalize(expanded, strip_text=True) == ET.canonicalize(read(package, name), strip_text=True)


@pytest.mark.skipif(shutil.which("roslaunch") is None, reason="roslaunch is not installed: make test-ros installs it")
def test_roslaunch_starts_move_group_of_moveit_1_with_the_parameters_of_the_arm(package: Path) -> None:
    environment = {**os.environ, "ROS_PACKAGE_PATH": str(package.parent)}

    def roslaunch(option: str, *arguments: str) -> str:
        command = ["roslaunch", option, package.name, "move_group.launch", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout

    assert roslaunch("--nodes").split() == ["/move_group"]
    parameters = yaml.safe_load(roslaunch("--dump-params"))
    assert ET.fromstring(parameters["/robot_description"]).get("name") == "assistive-arm"
    for name, value in {
        "/robot_description_planning/default_robot_padding": 0.01,
        "/robot_description_planning/cartesian_limits/max_trans_vel": 0.25,
        "/robot_description_planning/joint_limits/joint6/max_velocity": 0.5,
        "/robot_description_kinematics/manipulator/kinematics_solver": f"{package.name}/KinematicsPlugin",
        "/move_group/default_planning_pipeline": "ompl",
        "/move_group/planning_pipelines/ompl/planning_plugin": "ompl_interface/OMPLPlanner",
        "/move_group/planning_pipelines/ompl/manipulator/planner_configs": ["RRTConnect"],
        "/move_group/planning_plugin": "ompl_interface/OMPLPlanner",
        "/move_group/moveit_controller_manager": "moveit_simple_controller_manager/MoveItSimpleControllerManager",
    }.items():
        assert parameters[name] == value, name
    assert parameters["/move_group/controller_list"][0]["name"] == "joint_trajectory_action"
    others = yaml.safe_load(roslaunch("--dump-params", "load_robot_description:=false", "pipeline:=pilz"))
    assert "/robot_description" not in others
    assert others["/move_group/default_planning_pipeline"] == "pilz"


@needs_cpp
@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no CMake on this machine")
@pytest.mark.parametrize(("ros", "library"), [(1, "{}.so"), (2, "lib{}.so")])
def test_cmake_builds_the_library_under_the_name_that_pluginlib_looks_for(
    package: Path, tmp_path: Path, ros: int, library: str
) -> None:
    for name in (*HEADERS[ros], "pluginlib/class_list_macros.hpp"):
        (tmp_path / "include" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "include" / name).write_text(f'#include "{HERE / "stand_in.hpp"}"\n')
    for name, text in STUBS.items():
        (tmp_path / f"Find{name}.cmake").write_text(text)
    environment = {**os.environ, "ROS_VERSION": str(ros), "CXXFLAGS": f"-DSTAND_IN_MOVEIT={ros}"}
    options = [f"-DCMAKE_MODULE_PATH={tmp_path}", f"-DSTAND_INS={tmp_path / 'include'}"]
    build = tmp_path / "build"
    configured = subprocess.run(
        ["cmake", "-S", package, "-B", build, *options], env=environment, capture_output=True, text=True, check=False
    )
    assert configured.returncode == 0, configured.stderr
    assert ("exported to moveit_core: kinematics_plugin.xml" in configured.stdout) == (ros == 2)
    built = subprocess.run(["cmake", "--build", build], env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert (build / library.format(package.name)).is_file()


def test_an_existing_package_is_not_overwritten(package: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (package / "mine").write_text("")
    assert main(["arm", "export-moveit", "--arm", "assistive_arm", "--out", str(package.parent)]) == 2
    assert f"{package} exists: remove it, or name another folder by --out" in capsys.readouterr().err.replace("\n", " ")


@pytest.mark.parametrize("command", ["export-c", "export-moveit"])
def test_an_arm_without_a_solver_is_refused_with_the_reason(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ur5.yaml").write_text(UR5)
    assert main(["arm", command, "--arm", str(tmp_path / "ur5.yaml"), "--out", str(tmp_path / "out")]) == 3
    assert "ur5 has no spherical wrist" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
