"""The border to ROS: messages, bags, parameters and the node."""
