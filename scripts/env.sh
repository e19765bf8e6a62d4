# Environment of the build in this folder, ROS 2 from wheels included:  . scripts/env.sh  (bash, zsh or sh)
#
# Only for machines without a ROS 2 install; with one, source its setup file and install/setup.bash instead.
# The variables are set rather than extended, so that a sourced ROS 2 cannot mix with this one.

# Where this file lies is known to bash and zsh alone; the others have to be in the folder.
if [ -n "${BASH_VERSION-}" ]; then
    eval '_tactile_file=${BASH_SOURCE[0]}'
elif [ -n "${ZSH_VERSION-}" ]; then
    _tactile_file=$0
else
    _tactile_file=./scripts/env.sh
fi
if [ ! -f "$_tactile_file" ]; then
    echo "scripts/env.sh: in this shell, change to the folder that it is in first:  cd FOLDER; . scripts/env.sh" >&2
    return 1
fi
_tactile_root=$(cd "$(dirname "$_tactile_file")/.." && pwd)
_tactile_venv=$_tactile_root/.venv
_tactile_install=$_tactile_root/install

if [ ! -x "$_tactile_venv/bin/python" ]; then
    echo "scripts/env.sh: $_tactile_venv is missing: run 'make' in $_tactile_root first" >&2
    return 1
fi

export VIRTUAL_ENV=$_tactile_venv
case ":$PATH:" in
    *":$_tactile_install/bin:$_tactile_venv/bin:"*) ;;
    *) export PATH=$_tactile_install/bin:$_tactile_venv/bin:$PATH ;;
esac
export AMENT_PREFIX_PATH=$_tactile_install:$_tactile_venv
export CMAKE_PREFIX_PATH=$AMENT_PREFIX_PATH
export ROS_DISTRO=kilted ROS_VERSION=2 ROS_PYTHON_VERSION=3
unset COLCON_PREFIX_PATH PYTHONHOME

# Nodes are started with `python -m`, which would import from the current folder first: in this one, sources whose C
# modules are not built (Python 3.11 or newer knows this variable).
export PYTHONSAFEPATH=1

# Our own packages come before those of the virtual environment.
export PYTHONPATH=
for _tactile_site in "$_tactile_install"/lib/python3*/site-packages; do
    PYTHONPATH=$_tactile_site
done

# The libraries of the wheels lie in the environment's lib and in folders named ros_*.libs. The wheels have a start-up
# hook that puts these into LD_LIBRARY_PATH in random order and starts Python a second time, so that which copy of an
# interface library wins changes from run to run. The guard variable switches it off; the order here is fixed.
LD_LIBRARY_PATH=$_tactile_install/lib:$_tactile_venv/lib
for _tactile_libs in "$_tactile_venv"/lib/python3*/site-packages/ros_*.libs; do
    LD_LIBRARY_PATH=$LD_LIBRARY_PATH:$_tactile_libs
done
export LD_LIBRARY_PATH
export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1

# Stay on this machine unless told otherwise, and write logs even where HOME is not set.
export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
export ROS_LOG_DIR=${ROS_LOG_DIR:-$_tactile_root/log/ros}

# Completion, in a shell that somebody types in; zsh looks for it when its own is set up.
case $- in *i*)
    if [ -n "${BASH_VERSION-}" ] && [ -r "$_tactile_install/share/bash-completion/completions/tactile" ]; then
        . "$_tactile_install/share/bash-completion/completions/tactile"
    elif [ -n "${ZSH_VERSION-}" ]; then
        eval 'fpath=("$_tactile_install/share/zsh/site-functions" $fpath)'
        command -v compdef >/dev/null || { autoload -Uz compinit && compinit -i -D; }  # where .zshrc has none
        ! command -v compdef >/dev/null || { autoload -Uz _tactile && compdef _tactile tactile; }
    fi ;;
esac

unset _tactile_file _tactile_root _tactile_venv _tactile_install _tactile_site _tactile_libs
