"""What ``benchmarks.node`` measures: real processes over DDS on this machine's loopback; needs ROS 2, and no peers."""
