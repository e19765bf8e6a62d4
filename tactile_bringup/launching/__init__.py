"""Processes of a graph, started, watched and ended; the one part of this package that uses ROS."""

from tactile_base.requirements import require_packages

require_packages()  # before a launch file loads what is missing
