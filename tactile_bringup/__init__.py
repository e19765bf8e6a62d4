"""Brings a task up: scene -> graph -> processes, records it, reads it back; the `tactile` command line."""
