"""One run as arrays, and its numbers and pictures."""
