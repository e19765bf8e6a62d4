"""The nodes: each converts messages, declares parameters and calls its library."""

from tactile_base.end_signals import end_with_launcher

end_with_launcher()  # before anything that takes time is loaded
