"""The estimate: everything that is written to poses and points is written here."""
