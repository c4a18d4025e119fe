"""The package of ROS 2 about `placegraph.ros.node`; all code lies in placegraph itself."""
