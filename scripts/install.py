"""Install packages into the environment of this Python: install.py [ARGUMENT OF PIP INSTALL...].

By uv, which takes a tenth of pip's time and is told to look where pip is configured to look; by pip itself
where there is no uv for this machine, or uv fails.
"""

import ast
import os
import subprocess
import sys
from pathlib import Path

PIP = (sys.executable, "-m", "pip")
UV = Path(sys.executable).with_name("uv")
CONSTRAINTS = Path(__file__).with_name("constraints.txt")
#: Variables of uv by the settings of pip.
VARIABLES = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "trusted-host": "UV_INSECURE_HOST",
    "timeout": "UV_HTTP_TIMEOUT",
    "cert": "SSL_CERT_FILE",
}


def configured() -> dict[str, str]:
    """Variables that have uv look where pip does; like pip it takes all indexes for equally good."""
    listed = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True, check=True).stdout
    lines = [line.partition("=") for line in listed.splitlines()]
    found = {"UV_INDEX_STRATEGY": "unsafe-best-match"}
    for key, _, value in sorted(lines, key=lambda line: line[0].startswith(":env:")):  # which count more
        if variable := VARIABLES.get(key.rpartition(".")[2]):
            found[variable] = " ".join(ast.literal_eval(value).split())
    return found


def main() -> int:
    """Install; returns the exit code."""
    wanted = sys.argv[1:]
    if not UV.exists():
        subprocess.run(
            [*PIP, "install", "--quiet", "--only-binary=uv", "--constraint", CONSTRAINTS, "uv"], check=False
        )
    if UV.exists():
        command = [UV, "pip", "install", "--python", sys.executable, *wanted]
        if subprocess.run(command, env={**configured(), **os.environ}, check=False).returncode == 0:
            return 0
        print("uv failed: trying pip", flush=True)
    return subprocess.run([*PIP, "install", "--progress-bar", "off", *wanted], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
