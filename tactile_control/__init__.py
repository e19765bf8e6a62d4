"""Control: tangent-space PID, tactile servoing, limits, watchdog and the surface following task. No ROS here."""
