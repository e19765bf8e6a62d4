#!/usr/bin/env bash
# Run pytest on what make installed: test.sh [ARGUMENT OF PYTEST...]. Without arguments the whole suite in a process per
# core: what runs against the clock, and in as many, giving way to it, all the rest. With RETEST=1 up to sixteen tests against
# the clock that fail beside others run once more, alone: a machine that somebody else holds up for a second is no defect.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/env.sh
# The command pytest, not `python -m pytest`: the latter would import the sources instead of what is installed.
if [ $# -gt 0 ]; then
    exec pytest "$@"
fi
# By file: what its tests share is made once. A thread each: there are as many processes as cores.
export OMP_NUM_THREADS=1
mkdir -p log
. scripts/run_idle.sh
status=0 live=0
suite=(pytest -q --durations=15 --numprocesses auto --maxprocesses 4 --dist loadfile)
run_idle "${suite[@]}" -m "not live" >log/test.txt 2>&1 &
computing=$!
trap 'kill -- -$computing 2>/dev/null || true' EXIT
"${suite[@]}" -m live --no-loadscope-reorder -o cache_dir=log/live || live=$?
finish $computing || status=$?
cat log/test.txt
if [ "${RETEST:-0}" = 1 ] && [ $live = 1 ] && [ "$(grep -c '": true' log/live/v/cache/lastfailed)" -le 16 ]; then
    printf '\nFailed beside other tests, and run once more, alone:\n'
    live=0
    pytest -v -m live -o cache_dir=log/live --last-failed --last-failed-no-failures none || live=$?
fi
exit $((status ? status : live))
