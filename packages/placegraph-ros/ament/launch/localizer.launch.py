"""Start the localizer under the names that nav2 and RViz expect.

ros2 launch placegraph_ros localizer.launch.py map:=/maps/house.scene image:=/camera/color/image_raw
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = {
    "image": "rgb/image",
    "camera_info": "rgb/camera_info",
    "depth": "depth/image",
    "depth_camera_info": "depth/camera_info",
    "odom": "odom",
    "imu": "imu",
}


def generate_launch_description():
    """Return the arguments and the node."""
    share = Path(get_package_share_directory("placegraph_ros"))
    given = {
        "params": (str(share / "config" / "localizer.yaml"), "File of parameters"),
        "namespace": ("", "Namespace of the node, its topics and services"),
        "mode": ("continuous", "continuous or once"),
        "use_sim_time": ("false", "Use the time of /clock"),
        "autostart": ("true", "false: nav2's lifecycle manager starts the node"),
    } | {name: (topic, f"Topic instead of {topic}") for name, topic in TOPICS.items()}
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="Scene map, or library of several"),
            *(
                DeclareLaunchArgument(name, default_value=value, description=text)
                for name, (value, text) in given.items()
            ),
            Node(
                package="placegraph_ros",
                executable="localizer",
                name="placegraph_localizer",
                namespace=LaunchConfiguration("namespace"),
                output="screen",
                parameters=[
                    LaunchConfiguration("params"),
                    {
                        "map": LaunchConfiguration("map"),
                        "mode": LaunchConfiguration("mode"),
                        "autostart_node": LaunchConfiguration("autostart"),
                        "use_sim_time": LaunchConfiguration("use_sim_time"),
                    },
                ],
                remappings=[
                    ("/tf", "tf"),
                    ("/tf_static", "tf_static"),
                    ("localization/pose", "amcl_pose"),
                    ("localization/particle_cloud", "particle_cloud"),
                    *((topic, LaunchConfiguration(name)) for name, topic in TOPICS.items()),
                ],
            ),
        ]
    )
