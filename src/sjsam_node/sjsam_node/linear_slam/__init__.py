"""Text submaps of Linear SLAM, joined by ``slam join``."""
