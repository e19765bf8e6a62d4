"""The nodes: each converts messages, declares parameters and calls its library."""

import sys

from tactile_base.end_signals import end_with_launcher
from tactile_base.requirements import RequirementMissing, require_packages

# before anything is loaded that takes time, or is missing
end_with_launcher()
try:
    require_packages()
except RequirementMissing as error:
    sys.exit(f"cannot start: {error}")
