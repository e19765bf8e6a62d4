"""A package that brings drivers along; `installed` makes it as good as installed."""

import configparser
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


def as_installed(project: Path) -> str:
    """Write the metadata of a package with a pyproject.toml beside it; what has to be in PYTHONPATH."""
    described = configparser.ConfigParser()  # what these files use of TOML it reads as well
    described.read_string((project / "pyproject.toml").read_text().replace('"', ""))
    info = project / f"{project.name}-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project.name}\nVersion: 0.1\n")
    for section in described.sections():
        if section.startswith("project.entry-points."):
            points = "".join(f"{point} = {place}\n" for point, place in described[section].items())
            with (info / "entry_points.txt").open("a") as file:
                file.write(f"[{section.removeprefix('project.entry-points.')}]\n{points}")
    return str(project)
