"""Perception: from a tactile image to a Gaussian over the surface contact pose.

Needs no ROS and, to run, no PyTorch.
"""
