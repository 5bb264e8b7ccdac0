"""3D visual EKF-SLAM that builds small, locally referenced submaps."""
