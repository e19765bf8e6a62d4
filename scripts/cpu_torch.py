"""Install PyTorch without CUDA, which takes gigabytes less, where this machine has no NVIDIA GPU:
cpu_torch.py torch==VERSION.

Where PyTorch's index of such builds does not answer, or lacks one for this Python, nothing is done but to say
so: what installs the requirements afterwards then takes the build that it finds. The environment variable
TORCH, if set, is somebody's own choice: then nothing is done either.
"""

import importlib.metadata
import os
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path
from urllib.parse import unquote

INDEX = "https://download.pytorch.org/whl/cpu"
TIMEOUT = 3.0  # s
INSTALL = Path(__file__).with_name("install.py")


def has_gpu(devices: Path = Path("/dev")) -> bool:
    """Whether there is an NVIDIA GPU, or what belongs to one."""
    return any(devices.glob("nvidia*")) or shutil.which("nvidia-smi") is not None


def offered(index: str, build: str) -> str:
    """'' if the index has that build ("2.13.0+cpu") for this Python; else what it has not, or why."""
    try:
        with urllib.request.urlopen(f"{index}/torch/", timeout=TIMEOUT) as page:
            listed = unquote(page.read().decode())
    except (OSError, ValueError) as error:
        return f"{index} does not answer ({error})"
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}"
    return "" if f"torch-{build}-{tag}-" in listed else f"{index} has no {build} for {tag}"


def is_installed(version: str) -> bool:
    """Whether PyTorch is there in this version, in whichever build."""
    try:
        return importlib.metadata.version("torch").partition("+")[0] == version
    except importlib.metadata.PackageNotFoundError:
        return False


def main() -> int:
    """Install it if that makes sense; never fails."""
    version = sys.argv[1].partition("==")[2]
    if os.environ.get("TORCH") or is_installed(version) or has_gpu():
        return 0
    build = f"{version}+cpu"
    missing = offered(INDEX, build)
    if not missing:
        command = [sys.executable, INSTALL, "--no-deps", "--index-url", INDEX, f"torch=={build}"]
        if subprocess.run(command, check=False, stdout=sys.stderr).returncode == 0:
            return 0
        missing = "it could not be installed"
    print(f"PyTorch is taken as found, perhaps with gigabytes of CUDA: {missing}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
