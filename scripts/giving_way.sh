# Tests that wait for nothing beside those that run against the clock; sourced.

# giving_way COMMAND...: run it, in a session of its own, in what others leave of the machine (SCHED_IDLE). For the background.
giving_way() {
    exec setsid chrt --idle 0 "$@"
}

# finish PID: let such a command run as others do from now on, where the user may ask for that, and wait for it.
finish() {
    local file fields
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
