"""Where the messages of a bag lie: MCAP, databases of rosbag2, bags of ROS 1."""
