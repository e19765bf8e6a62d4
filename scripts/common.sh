# What the scripts of the build share; sourced by them.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"
logs=$root/log/make
mkdir -p "$logs" && touch "$root/log/COLCON_IGNORE"

# step NAME TITLE COMMAND...: one progress line; the output goes to log/make/NAME.log, its end is shown on failure.
step() {
    local log=$logs/$1.log title=$2 start=$SECONDS
    shift 2
    printf '%-60s' "$title"
    if "$@" >"$log" 2>&1; then
        printf ' %3d s\n' $((SECONDS - start))
        return
    fi
    printf ' failed\n\n'
    tail -n 30 "$log" | cut -c -400 >&2
    printf '\n%s failed; the whole output is in %s\n' "$title" "$log" >&2
    return 1
}

# fingerprint PATH...: one number for the names, permissions and contents of all files below the paths.
fingerprint() {
    find "$@" -type f ! -path '*/__pycache__/*' ! -name '*.so' -printf '%m ' -exec sha256sum {} + |
        LC_ALL=C sort | sha256sum
}

# up_to_date STAMP FINGERPRINT: whether the step that left the stamp ran with this fingerprint.
up_to_date() {
    [ -f "$1" ] && [ "$(cat "$1")" = "$2" ]
}

# lock [NAME]: one set-up or build at a time in this folder, or one of that name; a second one waits for the first.
lock() {
    exec 9>"$logs/lock${1:+-$1}"
    flock -n 9 || { echo "waiting for another make in this folder"; flock 9; }
}
