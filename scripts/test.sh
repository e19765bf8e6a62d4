#!/usr/bin/env bash
# Run pytest on what make installed: test.sh [ARGUMENT OF PYTEST...]. Without arguments the whole suite: what runs against the
# clock in a process per two cores, since a graph of nodes keeps two busy; and in one per core, giving way to it, all the rest.
# With RETEST=1 up to sixteen tests of each that fail beside others run once more, alone: a machine that somebody else holds
# up for a second is no defect.
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
rest=0 live=0
suite=(pytest -q --durations=15 --maxprocesses 4 --dist loadfile)
graphs=$((($(nproc) + 1) / 2))
# What gives way has more time for each test than pyproject.toml says.
run_idle "${suite[@]}" --numprocesses auto -m "not live" -o cache_dir=log/rest -o timeout=1200 -o faulthandler_timeout=1260 >log/test.txt 2>&1 &
computing=$!
trap 'kill -- -$computing 2>/dev/null || true' EXIT
"${suite[@]}" --numprocesses $graphs -m live --no-loadscope-reorder -o cache_dir=log/live || live=$?
finish $computing || rest=$?
cat log/test.txt

# once_more FOLDER STATUS: whether so few tests have failed, of those whose cache that is.
once_more() { [ "${RETEST:-0}" = 1 ] && [ "$2" = 1 ] && [ "$(grep -c '": true' "$1/v/cache/lastfailed")" -le 16 ]; }
alone() {
    printf '\nFailed beside other tests, and run once more, alone:\n'
    # Once more where the process itself died: at its end Fast DDS can release the port of a node that was killed
    # after its memory has gone (SharedMemChannelResource::release).
    local status=139
    for _ in 1 2; do
        [ $status = 139 ] || break
        status=0
        pytest -v -m "$2" -o cache_dir="$1" --last-failed --last-failed-no-failures none || status=$?
    done
    return $status
}
if once_more log/live $live; then live=0 && alone log/live live || live=$?; fi
if once_more log/rest $rest; then rest=0 && alone log/rest "not live" || rest=$?; fi
exit $((rest ? rest : live))
