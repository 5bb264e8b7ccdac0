"""NDT and ICP registration of point clouds, and scan odometry."""
