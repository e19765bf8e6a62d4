#!/usr/bin/env bash
# Run pytest on what make installed, in a ROS domain of its own: test.sh [ARGUMENT OF PYTEST...]. Without arguments the
# whole suite: what starts no nodes in a process per core, then what does in three.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/env.sh
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$((1 + $$ % 101))}
# The command pytest, not `python -m pytest`: the latter would import the sources instead of what is installed.
if [ $# -gt 0 ]; then
    exec pytest "$@"
fi
# A thread each: there are as many processes as cores. Tests with nodes wait for each other much of the time.
export OMP_NUM_THREADS=1
status=0
pytest -q --durations=15 -m "not ros" --numprocesses auto --maxprocesses 4 --dist loadfile || status=$?
pytest -q --durations=15 -m ros --numprocesses 3 --dist loadgroup --no-loadscope-reorder || status=$?
exit "$status"
