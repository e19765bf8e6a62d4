"""SE(3) geometry, Gaussian fusion and the Bayesian filter over surface contact poses. No ROS but in `filter_node`."""
