#!/usr/bin/env bash
# Run pytest on what make installed, in a ROS domain of its own: test.sh [ARGUMENT OF PYTEST...]
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/env.sh
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$((1 + $$ % 101))}
# The command pytest, not `python -m pytest`: the latter would import the sources instead of what is installed.
exec pytest "$@"
