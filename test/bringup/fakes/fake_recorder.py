"""The recorder, with what happens to its bag at its close: AT_THE_CLOSE in the environment says it."""

import os
import resource
import shutil
import sys

from tactile_ros.nodes.recorder_node import RecorderNode
from tactile_ros.run_nodes import run


class FakeRecorder(RecorderNode):
    def cleanup(self):
        fault = os.environ.get("AT_THE_CLOSE", "")
        if fault == "disk full":
            resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))  # enough for the log of this process
        if fault == "bag deleted":
            shutil.rmtree(self.folder)
        super().cleanup()


if __name__ == "__main__":
    sys.exit(run(FakeRecorder))
