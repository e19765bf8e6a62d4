"""A recording through the filter again."""
