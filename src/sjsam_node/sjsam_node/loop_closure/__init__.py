"""Which submaps see the same place: candidates, their verification, and whether they are consistent."""
