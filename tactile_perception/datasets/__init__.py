"""Data folders in the public layout: read, written, checked."""
