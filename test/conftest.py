"""What holds for all tests.

Property tests draw the same examples in every run; `--hypothesis-profile=explore` draws new ones.
"""

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))  # tests import `launched`

settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile("same")
