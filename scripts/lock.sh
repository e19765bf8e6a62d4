#!/usr/bin/env bash
# Renew the two sets of exact versions, for Python 3.10 to 3.13: constraints.txt has the newest that setup.cfg and
# ros_wheels.txt allow, lowest.txt the lowest that setup.cfg allows. PyTorch is not in them: TORCH chooses it.
set -euo pipefail
. "$(dirname "$0")/common.sh"

# resolve FILE [OPTION...]: write the versions that satisfy the requirements on standard input.
resolve() {
    local file=$1
    shift
    .venv/bin/uv pip compile --quiet --universal --python-version 3.10 --upgrade --no-annotate \
        --custom-compile-command "make lock" "$@" - -o "$logs/resolved.txt"
    # What PyTorch brings for CUDA has the versions that PyTorch itself names.
    grep -vE '^(torch|triton|cuda-[a-z]+|nvidia-[a-z0-9-]+)==' "$logs/resolved.txt" >"scripts/$file"
}

cat scripts/ros_wheels.txt <(.venv/bin/python scripts/requirements.py train cluster completion view test browser lint docs lock franka-sim) |
    resolve constraints.txt
.venv/bin/python scripts/requirements.py train test | grep -v '^torch' | resolve lowest.txt --resolution lowest-direct
