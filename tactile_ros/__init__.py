"""The ROS edge: what all nodes share (managed node, parameters, conversions, TF, diagnostics), and the nodes.

The libraries beside this package do not import ROS.
"""
