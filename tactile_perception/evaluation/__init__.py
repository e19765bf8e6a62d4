"""Evaluation of trained networks: accuracy, calibration, and what the filter makes of them."""
