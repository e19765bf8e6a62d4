"""Recordings: bags, replay through the filter, and the numbers and pictures of a run."""
