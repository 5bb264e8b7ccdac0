"""Bags: reading, writing, playing and recording them; the sensors that are in them."""
