"""Start move_group of MoveIt 2 with this package's configuration."""

from launch import LaunchDescription
from launch_ros.actions import Node
from moveit_configs_utils import MoveItConfigsBuilder


def generate_launch_description() -> LaunchDescription:
    """Return move_group with the arm's parameters."""
    builder = MoveItConfigsBuilder("{{ prefix }}", package_name="{{ package }}")
    builder.robot_description(file_path="config/{{ prefix }}.urdf")
    builder.robot_description_semantic(file_path="config/{{ prefix }}.srdf")
    parameters = builder.to_moveit_configs().to_dict()
    return LaunchDescription([Node(package="moveit_ros_move_group", executable="move_group", parameters=[parameters])])
