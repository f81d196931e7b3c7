"""Start move_group of MoveIt 2 with this package's configuration."""

from launch import LaunchDescription
from launch_ros.actions import Node
from moveit_configs_utils import MoveItConfigsBuilder


def generate_launch_description() -> LaunchDescription:
    """Return move_group with the arm's parameters."""
    builder = MoveItConfigsBuilder("{{ prefix }}", package_name="{{ package }}")
    builder.robot_description(file_path="config/{{ prefix }}.urdf")
    builder.robot_description_semantic(file_path="config/{{ prefix }}.srdf")
    builder.planning_pipelines("ompl", ["ompl", "pilz_industrial_motion_planner"])
    configs = builder.to_moveit_configs()
    # The joint limits again: in early releases of Humble the limits of Pilz take their place in to_dict().
    parameters = [configs.to_dict(), configs.joint_limits]
    return LaunchDescription(
        [Node(package="moveit_ros_move_group", executable="move_group", output="screen", parameters=parameters)]
    )
