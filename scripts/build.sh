#!/usr/bin/env bash
# Build what changed with colcon into install/: first the interface packages, then the Python package with its C code.
# build.sh --check: build nothing; exit with 1 if there is something to build.
set -euo pipefail
. "$(dirname "$0")/common.sh"
. scripts/env.sh

shopt -s extglob
packages=(tactile_!(msgs|*.egg-info))
interfaces=(tactile_msgs)
# Wheels of tf2_msgs do not exist yet; where they do, the real package is used.
[ -d .venv/share/tf2_msgs ] || interfaces+=(deps/tf2_msgs)

# What was built with another Python, or before the folder moved, holds the old paths.
python="$root $(cat .venv/pyvenv.cfg)"
of_interfaces() { echo "$(fingerprint "${interfaces[@]}") $(cat .venv/stamp-base)"; }
of_package() { fingerprint package.xml setup.py setup.cfg resource scripts/tactile launch config tactile_msgs "${packages[@]}"; }

if [ "${1-}" = --check ]; then
    up_to_date build/stamp-python "$python" && up_to_date build/stamp-interfaces "$(of_interfaces)" &&
        up_to_date build/stamp-package "$(of_package)"
    exit
fi
lock build

# build NAME TITLE PACKAGE...: run colcon on these packages.
build() {
    local name=$1 title=$2
    shift 2
    step "$name" "$title" colcon build --base-paths . "${interfaces[@]}" --merge-install \
        --packages-select "$@" --event-handlers console_direct+ \
        --cmake-args -DPython3_EXECUTABLE="$VIRTUAL_ENV/bin/python" -DBUILD_TESTING=OFF -DCMAKE_BUILD_TYPE=Release \
        -DCMAKE_UNITY_BUILD=ON
}

if ! up_to_date build/stamp-python "$python"; then
    rm -rf build install
    mkdir build
    printf '%s\n' "$python" >build/stamp-python
fi

wanted=$(of_interfaces)
if ! up_to_date build/stamp-interfaces "$wanted"; then
    build colcon-interfaces "messages, services and actions" "${interfaces[@]##*/}"
    printf '%s\n' "$wanted" >build/stamp-interfaces
    # The overlay's site-packages exist only now.
    . scripts/env.sh
fi

wanted=$(of_package)
if ! up_to_date build/stamp-package "$wanted"; then
    # Neither setuptools nor colcon removes what a deleted or renamed source left behind.
    rm -rf build/tactile_servoing/build install/share/tactile_servoing install/lib/tactile_servoing \
        install/lib/python3*/site-packages/tactile_!(msgs|msgs-*)
    build colcon-package "Python package with C extensions" tactile_servoing
    # Python 3.10 has no PYTHONSAFEPATH (see env.sh): what is started in this folder imports its sources.
    if python -c 'import sys; sys.exit(sys.version_info >= (3, 11))'; then
        step inplace "C extensions beside the sources" python setup.py build_ext --inplace
    fi
    mkdir -p install/share/bash-completion/completions install/share/zsh/site-functions
    tactile completion bash >install/share/bash-completion/completions/tactile
    tactile completion zsh >install/share/zsh/site-functions/_tactile
    printf '%s\n' "$wanted" >build/stamp-package
fi
