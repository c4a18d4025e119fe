"""Where a camera is, told to robots: messages of ROS, and the bags, viewers and nodes that carry them."""
