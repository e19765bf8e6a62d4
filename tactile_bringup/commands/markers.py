"""Find the markers of a camera image or of a pre-processed one.

Against a reference image without contact, show where they have parted (blue) and where they are closer (red).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import cv2

from tactile_base.whole_file import check_file, room_for_files, whole_file
from tactile_bringup.commands.changes import add_command
from tactile_perception.estimating.image import read_image
from tactile_perception.markers.detection import density_change, detect
from tactile_perception.markers.view import draw_markers, side_by_side


def register(subparsers: Any) -> None:
    add = add_command(subparsers, "markers", run_markers, __doc__, status=1).add_argument
    add("image", type=Path, help="image file")
    add("--reference", type=Path, help="image without contact, of the same crop")
    add("--out", type=Path, help="picture to write (default: out/IMAGE.markers.png)")
    add("--csv", type=Path, help="table of the centers to write")


def run_markers(arguments: argparse.Namespace) -> int:
    out = arguments.out or Path("out") / f"{arguments.image.stem}.markers.png"
    for path in (out, *filter(None, [arguments.csv])):
        check_file(path)
    if not cv2.haveImageWriter(str(out)):
        raise ValueError(f"{out}: OpenCV writes no pictures of this kind; end its name with .png")
    image = _read(arguments.image)
    markers = detect(image)
    lines = [f"{arguments.image}: {len(markers)} markers, {markers.merged.sum()} of them from merged blobs"]
    picture = draw_markers(image, markers)
    if arguments.reference is not None:
        reference_image = _read(arguments.reference)
        if reference_image.shape != image.shape:
            raise ValueError(
                f"{arguments.reference}: is {_size(reference_image)}; must be {_size(image)} "
                f"like {arguments.image}"
            )
        reference = detect(reference_image)
        change = density_change(markers, reference, image.shape)
        picture = side_by_side(image, markers, change)
        lines += [
            f"{arguments.reference}: {len(reference)} markers, {change.spacing:.1f} px apart",
            f"change of density, markers per squared spacing: {change.values.min():.2f} to "
            f"{change.values.max():.2f}",
        ]
    room_for_files(out, *filter(None, [arguments.csv]))
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(out) as temporary:
        temporary.write_bytes(cv2.imencode(out.suffix, picture)[1].tobytes())
    lines.append(f"picture: {out}")
    if arguments.csv is not None:
        rows = zip(markers.centers, markers.areas, markers.merged, strict=True)
        text = "".join(f"{c[0]:.3f},{c[1]:.3f},{area:.1f},{int(merged)}\n" for c, area, merged in rows)
        arguments.csv.parent.mkdir(parents=True, exist_ok=True)
        arguments.csv.write_text("column_px,row_px,area_px2,merged\n" + text)
        lines.append(f"table: {arguments.csv}")
    print("\n".join(lines))
    return 0


def _read(path: Path) -> Any:

    if not path.is_file():
        raise OSError(f"{path}: there is no such file")
    return read_image(path)


def _size(image: Any) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
