"""Fits of the simulation to what is measured: a sensor to real images, error models to networks."""
