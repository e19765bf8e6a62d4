"""The nodes: each converts messages, declares parameters and calls its library."""
