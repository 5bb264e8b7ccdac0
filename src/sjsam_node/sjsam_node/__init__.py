"""Submap Joining Smoothing and Mapping: joins submaps by sparse least squares into one map."""
