"""From odometry to keyframes: order of stamps, choice of odometry, its integration, pose edges."""
