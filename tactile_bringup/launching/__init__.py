"""Processes of a graph, started, watched and ended; the one part of this package that uses ROS."""
