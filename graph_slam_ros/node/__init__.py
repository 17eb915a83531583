"""The ROS 2 node: subscriptions, publishers, services, /tf, diagnostics, and the thread that solves."""
