"""Keyframes from odometry: order of stamps, choice of odometry, its integration, pose edges."""
