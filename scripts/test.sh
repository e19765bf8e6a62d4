#!/usr/bin/env bash
# Run pytest on what make installed, in a ROS domain of its own: test.sh [ARGUMENT OF PYTEST...]. Without arguments the
# whole suite: first, in a process per core, what starts no nodes; then whole tasks on nodes, two at a time; then other
# tests with nodes, three at a time: they wait for each other much of the time.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/env.sh
export ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$((1 + $$ % 101))}
# The command pytest, not `python -m pytest`: the latter would import the sources instead of what is installed.
if [ $# -gt 0 ]; then
    exec pytest "$@"
fi
# By file: what a file's tests share is made once. A thread each: there are as many processes as cores.
status=0
OMP_NUM_THREADS=1 pytest -q --durations=15 -m "not ros" --numprocesses auto --maxprocesses 4 --dist loadfile || status=$?
OMP_NUM_THREADS=1 pytest -q --durations=15 -m ros --numprocesses 2 --dist loadfile test/system || status=$?
OMP_NUM_THREADS=1 pytest -q --durations=15 -m ros --numprocesses 3 --dist loadfile --ignore=test/system || status=$?
exit "$status"
