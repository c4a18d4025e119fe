"""The package of ROS 2 about `placegraph_ros.node`; all code lies in placegraph itself."""
