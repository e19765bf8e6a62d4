"""The ROS edge that all nodes share: managed node, parameters from settings, conversions, TF, QoS, latency.

Imports rclpy and messages, and nothing else of `tactile_bringup`.
"""
