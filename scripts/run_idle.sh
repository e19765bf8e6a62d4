# Tests that wait for nothing beside those that run against the clock; sourced.

# run_idle COMMAND...: run it, in a session of its own, in what others leave of the machine. For the background. Its policy
# (SCHED_IDLE) counts within the session alone where the kernel shares time out by session (autogroup), whose own is 19 there.
run_idle() {
    exec setsid bash -c '{ echo 19 >/proc/self/autogroup; } 2>/dev/null || true; exec chrt --idle 0 "$@"' - "$@"
}

# finish PID: let such a command run as others do from now on, where the user may ask for that, and wait for it.
finish() {
    local file fields
    { echo 0 >"/proc/$1/autogroup"; } 2>/dev/null || true
    for file in /proc/[0-9]*/stat; do
        read -r fields 2>/dev/null <"$file" || continue
        read -r -a fields <<<"${fields##*) }" # state, parent, group, session
        if [ "${fields[3]}" = "$1" ]; then
            file=${file#/proc/}
            chrt --all-tasks --other --pid 0 "${file%/stat}" >/dev/null 2>&1 || true
        fi
    done
    wait "$1"
}
