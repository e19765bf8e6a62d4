"""Control: tangent-space PID, tactile servoing, limits, watchdog, the surface following task. Without ROS."""
