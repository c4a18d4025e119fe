"""Start the localizer under the names that nav2 and RViz expect.

ros2 launch placegraph_ros localizer.launch.py map:=/maps/house.scene
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """Arguments, and the node."""
    share = Path(get_package_share_directory("placegraph_ros"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="Scene map, or library of several"),
            DeclareLaunchArgument("params", default_value=str(share / "config" / "localizer.yaml")),
            DeclareLaunchArgument("mode", default_value="continuous"),
            Node(
                package="placegraph_ros",
                executable="localizer",
                name="placegraph_localizer",
                output="screen",
                parameters=[
                    LaunchConfiguration("params"),
                    {"map": LaunchConfiguration("map"), "mode": LaunchConfiguration("mode")},
                ],
                remappings=[
                    ("localization/pose", "amcl_pose"),
                    ("localization/particle_cloud", "particle_cloud"),
                ],
            ),
        ]
    )
