"""Where collected samples go, and what a data folder was made with."""
