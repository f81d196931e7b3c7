"""Packages of the messages that have no wheel, for rosidl's generators: `python -m tests.ros2.interfaces FOLDER`.

The definitions are those of `ros2_types`, so that generated classes and our own encoding have one source, which
`test_types.py` compares with published type hashes.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rtcp.ros import ros2_types
from rtcp.ros.ros1_messages import DEFINITIONS

PACKAGES = {
    "control_msgs": "action_msgs builtin_interfaces std_msgs trajectory_msgs",
    "industrial_msgs": "std_msgs trajectory_msgs",
    "tf2_msgs": "geometry_msgs",
}
"""Package -> packages that its messages use."""
GENERATORS = ("rosidl_generator_type_description", "rosidl_generator_c", "rosidl_typesupport_introspection_c",
              "rosidl_typesupport_fastrtps_c", "rosidl_typesupport_c", "rosidl_generator_py")  # fmt: skip
"""What rclpy needs on Fast DDS; the generators of C++ take as long again."""
CMAKE = """cmake_minimum_required(VERSION 3.20)
project({package})
find_package(ament_cmake REQUIRED)
find_package(rosidl_cmake REQUIRED)
{packages}
list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX cpp)
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {dependencies})
ament_package()
"""
MANIFEST = """<package format="3">
  <name>{package}</name>
  <version>0.0.0</version>
  <description>Messages for tests</description>
  <maintainer email="nobody@example.com">nobody</maintainer>
  <license>Apache-2.0</license>
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""


def definitions() -> dict[str, str]:
    """Return the definitions by the names of their files: `control_msgs/msg/JointTolerance.msg`."""
    texts = {f"{name}.msg": (DEFINITIONS / f"{name}.msg").read_text() for name in ros2_types._AS_IN_ROS_1}
    for name, text in ros2_types._MESSAGES.items():
        if "/msg/" in name and name.partition("/")[0] in PACKAGES:
            texts[f"{name}.msg"] = text
    parts = (ros2_types._MESSAGES[f"{ros2_types.FOLLOW}_{part}"] for part in ("Goal", "Result", "Feedback"))
    texts[f"{ros2_types.FOLLOW}.action"] = "\n---\n".join(parts)
    for name, pair in ros2_types._SERVICES.items():
        if "/srv/" in name and name.partition("/")[0] in PACKAGES:
            texts[f"{name}.srv"] = "\n---\n".join(pair)
    texts["tf2_msgs/msg/TFMessage.msg"] = "geometry_msgs/TransformStamped[] transforms"
    return {name: "".join(f"{line.strip()}\n" for line in text.splitlines()) for name, text in texts.items()}


def write_packages(folder: Path) -> None:
    """Write a package for CMake into a folder for each of `PACKAGES`."""
    texts = definitions()
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for package, dependencies in PACKAGES.items():
        files = " ".join(name.partition("/")[2] for name in texts if name.startswith(package))
        packages = "\n".join(f"find_package({name} REQUIRED)" for name in (*GENERATORS, *dependencies.split()))
        values = {"package": package, "packages": packages, "files": files, "dependencies": dependencies}
        (folder / package / "CMakeLists.txt").write_text(CMAKE.format(**values))
        (folder / package / "package.xml").write_text(MANIFEST.format(package=package))


if __name__ == "__main__":
    write_packages(Path(sys.argv[1]))
