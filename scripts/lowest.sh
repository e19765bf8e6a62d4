#!/usr/bin/env bash
# Run tests that need neither ROS 2 nor PyTorch with the lowest versions that setup.cfg allows, in a virtual environment
# of their own: lowest.sh [ARGUMENT OF PYTEST...]. After `make`, on Python 3.10 or 3.11.
set -euo pipefail
. "$(dirname "$0")/common.sh"
scripts/setup.sh lowest
. scripts/env.sh
# Of ROS 2 only the definitions of the messages, which are text (AMENT_PREFIX_PATH); none of its code.
unset LD_LIBRARY_PATH PYTHONPATH
lock lowest

lowest=$root/build/lowest
venv=$root/.venv-lowest
wanted=$(cat build/stamp-package "$venv/stamp" scripts/lowest.sh | sha256sum)
if ! up_to_date "$lowest/stamp" "$wanted"; then
    rm -rf "$lowest"
    mkdir -p "$lowest/lib"
    step lowest-package "Python package with C extensions" "$venv/bin/python" setup.py egg_info --egg-base "$lowest/lib" \
        build --build-base "$lowest/build" --build-lib "$lowest/lib"
    printf '%s\n' "$wanted" >"$lowest/stamp"
fi

exec 9>&-
export PYTHONPATH=$lowest/lib
# What differs with versions is what a library does, not what numbers do: few examples show it, of those tests that meet one
# (NumPy, SciPy, OpenCV, onnxruntime, rosbags, matplotlib, Ruckig, ur_rtde), and none of those that only compute long.
chosen=(base filter/test_{bayes_filter,consistency,object_tracker,robust,smoother}.py
    control/test_{limiter,servoing,task_file,trajectory}.py drivers/test_{camera_frames,replay_camera,ur_limits,uvc_camera}.py
    scene/test_{kinematics,scene,shapes}.py sim/test_{arm,collection,sensor_file,tactip}.py
    records/test_{bag,damaged_bags,export,figures,lerobot,metrics,mounting,replay_inputs,run_page,time_offset,tip}.py
    perception/test_{estimator,estimate,evaluation}.py)
[ $# -gt 0 ] || set -- -q --disable-warnings --hypothesis-profile=few --numprocesses auto --maxprocesses 4 --dist loadfile \
    -m "not slow and not live" "${chosen[@]/#/test/}"
export OMP_NUM_THREADS=1  # there are as many processes as cores
exec "$venv/bin/pytest" "$@"
