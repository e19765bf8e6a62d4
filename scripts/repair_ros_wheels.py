"""Point the CMake files of the ROS 2 wheels to the virtual environment whose Python runs this.

The wheels were built under /opt/python/cpXY-cpXY and in a folder of their own, and both names are still in
what they installed: CMake then asks for Python and NumPy headers that are not there. A second run changes
nothing.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

# Longest first: the last pattern is the prefix of the two before it.
REPLACEMENTS = (
    (r"/opt/python/cp\d+-cp\d+/lib/python[\d.]+/site-packages/numpy/_?core/include", numpy.get_include()),
    (r"/opt/python/cp\d+-cp\d+/include/python[\d.]+", sysconfig.get_paths()["include"]),
    (r"/opt/python/cp\d+-cp\d+", sys.prefix),
    (r"/project/build/temp\.[\w.-]+/install", sys.prefix),
)


def repair(prefix: Path) -> int:
    """Rewrite the files below `prefix` that hold stale paths; returns how many did."""
    index = prefix / "share" / "ament_index" / "resource_index" / "parent_prefix_path"
    files = [path for pattern in ("*.cmake", "*.sh", "*.dsv") for path in (prefix / "share").rglob(pattern)]
    files += [*(prefix / "lib" / "cmake").rglob("*.cmake"), *index.glob("*")]
    changed = 0
    for path in files:
        before = after = path.read_text()
        for pattern, replacement in REPLACEMENTS:
            after = re.sub(pattern, lambda _, new=replacement: new, after)
        if after != before:
            mode = path.stat().st_mode
            path.unlink()  # it may be a link into the cache of an installer, for other environments as well
            path.write_text(after)
            path.chmod(mode)
            changed += 1
    return changed


if __name__ == "__main__":
    if sys.prefix == sys.base_prefix:
        sys.exit(f"{sys.executable} is not in a virtual environment: run this with .venv/bin/python")
    print(f"repaired stale paths in {repair(Path(sys.prefix))} files")
