"""Whether a bag holds what was published, on a machine that has too much to do.

Surface following is launched and recorded over and over beside busy loops; in some runs the recorder is
stopped (SIGSTOP) for so long while the surface is followed. A witness of its own subscribes to the beliefs.
Printed for each run: beliefs published (by the publisher's own numbers), seen by the witness, in the bag,
missing in it, what the bag and the report say is missing; and how many of a replay's states are those of the
bag, to the bit::

    python bench/bags_under_load.py [--runs 20] [--loops 4] [--stalls 0 1 3 10] [--out out/bags]
"""

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from latency_under_load import busy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

from tactile_base.topics import BELIEF
from tactile_bringup.launching.environment import ros_environment
from tactile_records.bags.contents import UNKNOWN
from tactile_records.replay.inputs import read_inputs
from tactile_records.replay.run import agreement, run_filter
from tactile_records.replay.sweep import base_settings
from tactile_records.runs.from_bag import read_arms
from tactile_records.runs.metrics import report
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_ros.discovery import use_dds_profile

ARM = "arm"
TOPIC = f"/{ARM}/{BELIEF.name}"
FOLLOWED = 3.0  # s that the surface is followed before the recorder is stopped


class Witness:
    """Stamps of the beliefs that were published, and the numbers that their publisher gave them."""

    def __init__(self) -> None:
        self.stamps: set[int] = set()
        self.first, self.last = 0, 0
        self._context = rclpy.Context()
        rclpy.init(context=self._context, domain_id=int(os.environ["ROS_DOMAIN_ID"]))
        self._node = rclpy.create_node("witness", context=self._context)
        self._node.create_subscription(
            PoseWithCovarianceStamped, TOPIC, self._take, qos.recorder_profile(BELIEF)
        )
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def _take(self, message: PoseWithCovarianceStamped, info: Any) -> None:
        self.stamps.add(ns_from_time(message.header.stamp))
        self.last = int(info["publication_sequence_number"])
        self.first = self.first or self.last

    def _spin(self) -> None:
        executor = SingleThreadedExecutor(context=self._context)
        executor.add_node(self._node)
        try:
            executor.spin()
        except ExternalShutdownException:
            return

    def close(self) -> None:
        self._context.shutdown()
        self._thread.join()


def recorder(folder: Path) -> int:
    """The process of the run's recorder."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = process.joinpath("cmdline").read_bytes().decode(errors="replace")
        except OSError:  # it ended
            continue
        if "tactile_ros.nodes.recorder_node" in words and str(folder) in words:
            return int(process.name)
    raise RuntimeError(f"no recorder runs in {folder}")


def launch(folder: Path, stall: float) -> int:
    """Run the task; its exit code."""
    command = [sys.executable, "-m", "tactile_bringup.cli", "launch", "surface_following", "--scene", "ramp"]
    command += ["--headless", "--out", str(folder / "run"), "--record", str(folder / "bag")]
    with (folder / "log").open("w") as log:
        run = subprocess.Popen(command, stdout=log, stderr=log)
    while run.poll() is None and "arm: follow" not in (folder / "log").read_text():
        time.sleep(0.1)
    if stall and run.poll() is None:
        time.sleep(FOLLOWED)
        pid = recorder(folder)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(stall)
        os.kill(pid, signal.SIGCONT)
    return run.wait()


def measure(folder: Path, stall: float) -> str:
    """One run; a row of the table."""
    folder.mkdir(parents=True)
    witness = Witness()
    try:
        code = launch(folder, stall)
    finally:
        witness.close()
    (record,) = read_arms(folder / "bag").values()
    inputs = read_inputs(folder / "bag")
    stamps = set(record.belief.stamp_ns.tolist())
    published = witness.last - witness.first + 1
    missing = len(witness.stamps - stamps)
    gaps = [gap.messages for gap in inputs.bag.gaps if gap.topic == TOPIC and gap.messages != UNKNOWN]
    run = run_filter(inputs.arms[0], base_settings(inputs, None)[ARM])
    assert inputs.arms[0].live is not None
    same = agreement(run.states, inputs.arms[0].live)
    cells = [f"{stall:g}", code, published, len(witness.stamps), len(stamps), missing, sum(gaps)]
    cells += [
        report(record)["bag_problem"] or "complete",
        f"{same.identical} of {same.common}",
        same.only_live,
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    """Measure each run of the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--loops", type=int, default=4)
    parser.add_argument("--stalls", type=float, nargs="*", default=[0.0, 1.0, 3.0, 10.0], help="in turn, s")
    parser.add_argument("--out", type=Path, default=Path("out/bags"))
    arguments = parser.parse_args()
    folder = arguments.out.resolve()
    use_dds_profile()
    os.environ |= ros_environment(folder / "ros").variables
    columns = [
        *("recorder stopped s", "exit code", "published", "seen", "in the bag", "missing", "told"),
        *("report says of the bag", "replayed to the bit", "only live"),
    ]
    print("| " + " | ".join(columns) + " |\n" + "| --- " * len(columns) + "|", flush=True)
    with busy(arguments.loops):
        for number in range(arguments.runs):
            stall = arguments.stalls[number % len(arguments.stalls)]
            print(measure(folder / f"{number:02d}", stall), flush=True)


if __name__ == "__main__":
    main()
