"""Geometry, cameras, data types, least squares, evaluation and simulation: everything the SLAM packages share."""
