"""Control: tangent-space PID, tactile servoing, limits, watchdog, tasks. Without ROS."""
