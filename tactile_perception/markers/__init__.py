"""Markers in tactile images: found, followed, drawn."""
