"""A package that brings drivers along; `installed` makes it as good as installed."""

from pathlib import Path

FOLDER = Path(__file__).parent
ENTRY_POINTS = """\
[tactile_servoing.arms]
bench_arm = bench_cell:BenchArm
[tactile_servoing.cameras]
bench_camera = bench_cell:BenchCamera
double_camera = double_camera:DoubleCamera
[tactile_servoing.doubles]
bench_arm = tactile_doubles.reported:ReportedDouble
[tactile_servoing.motions]
drift = bench_cell:Drift
"""
ERRORS = """\
[tactile_servoing.tasks]
rubbing = my_errors:Rubbing
refusing = my_errors:Refusing
silent = my_errors:Silent
[tactile_servoing.motions]
swing = my_errors:Swing
[tactile_servoing.shapes]
bowl = my_errors:Bowl
"""


def installed(folder: Path, entry_points: str = ENTRY_POINTS) -> list[str]:
    """Write the package's metadata into the folder; what has to be in PYTHONPATH or sys.path."""
    info = folder / "bench_cell-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bench-cell\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    return [str(folder), str(FOLDER)]
