"""The nodes: each converts messages, declares parameters and calls its library."""

import os
import sys

from tactile_base.end_signals import end_with_launcher
from tactile_base.requirements import RequirementMissing, require_packages

# One thread for numbers, read when numpy is loaded. Where more of them have a real-time priority, each waits
# for its helpers by turning in circles, and two nodes on two cores keep the helpers from ever running.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

# before anything is loaded that takes time, or is missing
end_with_launcher()
try:
    require_packages()
except RequirementMissing as error:
    sys.exit(f"cannot start: {error}")
