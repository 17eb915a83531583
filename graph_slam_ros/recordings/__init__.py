"""Recordings, read and written: mcap, sqlite3 and ROS 1 bags, and what they contain."""
