"""Sensors and arms: real drivers and the simulated cell."""
