"""Stamps: whole nanoseconds of one clock, as int."""

SECOND_NS = 1_000_000_000
