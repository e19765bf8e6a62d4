"""Does the simulated skin stick, slip and push as real ones do? z: depth, N: normal force, k: its stiffness.

    python bench/simulation/real_skin.py forces DATA/tacpad_ur5/train
    python bench/simulation/real_skin.py sticking DATA/tactip_franka/train
    python bench/simulation/real_skin.py friction DATA/tactip_franka/train DATA/cr_tactip/train

Followed are the markers around the point of contact, within 0.7 of the angle that the depth cuts off.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from shared import Array, Table, parser

from tactile_perception.datasets.dataset import open_folder
from tactile_perception.markers import labelled
from tactile_scene.simulated_sensors import ContactSettings, TacTipSettings
from tactile_sim.collection import Mounting, SensorFile, load_sensor, press_then_shear
from tactile_sim.tactip import TacTip

SLIPPERY = SensorFile(TacTipSettings(contact=ContactSettings(friction=0.25)))
SENSORS = {"built in": SensorFile(), "fitted": load_sensor("tactip_franka"), "friction 0.25": SLIPPERY}
FRICTIONS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.5)
HOW = "95 % of a bootstrap in brackets"


def bands(measure: Callable[[Array], list[float]], rows: Array) -> Array:
    """The numbers (K,) that are measured on rows, and the ends of their bands: (3, K)."""
    rng, n = np.random.default_rng(0), len(rows)
    ends = np.percentile([measure(rows[rng.integers(n, size=n)]) for _ in range(300)], (2.5, 97.5), axis=0)
    return np.array([measure(rows), *ends])


def banded(measure: Callable[[Array], list[float]], rows: Array) -> list[str]:
    """Each number that is measured on rows, with its band."""
    return [f"{v:.2f} ({low:.2f}, {high:.2f})" for v, low, high in bands(measure, rows).T]


def stiffness(rows: Array) -> list[float]:
    """k, k z / N in all, by shear and in Mindlin's law, its friction; RMS that a line and that law leave."""
    z, press, size = rows[:, 2], np.maximum(rows[:, 8], 0.1), np.hypot(*rows[:, :2].T)
    scale = np.polyval(np.polyfit(z, press, 1), z) / z  # k z / N is more even in a bin of z than k
    columns = np.column_stack([rows[:, :2] * scale[:, None], rows[:, 3:6], np.ones(len(z))])
    fit = np.linalg.lstsq(columns, rows[:, 6:8], rcond=None)[0]
    along = np.sum((rows[:, 6:8] - columns[:, 2:] @ fit[2:]) * rows[:, :2], axis=1) / size
    ratio, way, bins = float(np.linalg.det(fit[:2])) ** 0.5, size * scale, np.digitize(size, (1, 1.5, 2))

    def off(p: Array) -> Array:
        left = np.maximum(1 - 2 / 3 * p[0] * p[1] * way / press, 0.0)
        return np.asarray(press / p[1] * (1 - left**1.5) - along)

    law = least_squares(off, (ratio, 0.5), bounds=((0.05, 0.01), (9, 9)))
    by_shear = [along[bins == j].sum() / way[bins == j].sum() for j in range(4)]
    numbers = [ratio * scale.mean(), ratio, *by_shear, law.x[0], 1 / law.x[1]]
    return [*numbers, *(np.sqrt(np.mean(error**2)) for error in (along - ratio * way, law.fun))]


def forces(folder: Path) -> None:
    """A pad with a force sensor behind it; simulated tips on a plane."""
    data = open_folder(folder)
    rows = np.column_stack([data.euler_mm_deg, [row.force for row in data.rows]])
    heads = "z (mm), contacts, N (N), F_t / N: 50; 95; 99 %, k (N/mm), k z / N, at 0-1 mm, 1-1.5, 1.5-2, 2-3"
    table = Table((heads + ", by Mindlin, friction, a line leaves (N), Mindlin").split(", "), HOW)
    for low, high in (*((z, z + 0.5) for z in np.arange(0, 4, 0.5)), (0.5, 4), (0.5, 2), (2, 4)):
        b = rows[(rows[:, 2] >= low) & (rows[:, 2] < high) & (rows[:, 8] > 0.3)]
        if high - low > 0.5:
            found = banded(lambda b: [np.polyfit(np.log(b[:, 2]), np.log(b[:, 8]), 1)[0]], b)
            print(f"\nN ~ z^n, {low}-{high} mm: n =", *found)
            continue
        most = np.percentile(np.hypot(b[:, 6], b[:, 7]) / b[:, 8], (50, 95, 99)).round(2)
        table.row(f"{low}-{high}", len(b), f"{b[:, 8].mean():.2f}", most, *banded(stiffness, b))
    table = Table(["sensor", "z (mm)", "N (N)", "k z / N", "F_t / N at 1 mm", "2", "3", "4", "5"], "no noise")
    for name, z in ((name, z) for name in SENSORS for z in (1, 2, 3, 4, 6, 8)):
        poses = np.array([(s, 0, z, 0, 0, 0) for s in (0, 0.3, 1, 2, 3, 4, 5)])
        truth = [sensor.truth() for sensor in pressed(SensorFile(SENSORS[name].sensor), poses)]
        pulls = [each.tangential_force / each.normal_force for each in truth]
        ratio = truth[1].tangential_force / 0.3 * z / truth[0].normal_force
        table.row(name, z, *(f"{v:.3f}" for v in (truth[0].normal_force, ratio, *pulls[2:])))


def pressed(file: SensorFile, labels: Array) -> Iterator[TacTip]:
    """A simulated sensor in each of some contacts, with the errors of its rig."""
    sensor, offset = TacTip(file.sensor), np.array([0, 0, file.collection.depth_offset, 0, 0, 0])
    for pose in labels * np.repeat([1e-3, np.pi / 180], 3) + offset:
        sensor.reset()
        press_then_shear(sensor, pose, mounting=Mounting.of(file.collection))
        yield sensor


def following(rows: Array) -> list[float]:
    """Way of the markers over shear of 0.5-1.5 mm, and beyond over this; their turn over twist."""
    size, along, twist, turn = rows.T
    bins, turns = np.digitize(size, (0.5, 1.5, 2.5, 3.5)), np.digitize(twist, (2, 3.5))
    first, *far = (float(np.median((along / size)[bins == j])) for j in range(1, 5))
    turned = (float(turn[turns == j].sum() / twist[turns == j].sum()) for j in range(3))
    return [first, *(value / first for value in far), *turned]


def contacts(labels: Array, rest: Array, positions: Array) -> Iterator[tuple[int, Array]]:
    """By depth (mm): rows of shear, way of the markers along it, twist, turn of the markers with it."""
    z, shear, tilt = labels[:, 2], labels[:, :2] @ [1, 1j], labels[:, 3:5] @ [1, 1j]
    place, moved = (rest - np.median(rest, axis=0)) @ [1, 1j], (positions - rest) @ [1, 1j]
    near = np.argsort(np.abs(place))[:37]
    pitch = np.median(np.sort(np.abs(place[near, None] - place), axis=1)[:, 1]) / 6.6  # px a degree
    columns = np.column_stack([shear, tilt, z, np.ones(len(z))])
    a, b = np.linalg.lstsq(columns, np.nanmean(moved[:, near], axis=1), rcond=None)[0][:2]
    axis, sign = a / np.abs(a), np.sign((b / a).imag)  # cr_tactip counts shear and twist the other way
    away = np.abs(place + (1j * sign * pitch * axis * tilt)[:, None])  # from the point of contact
    reach = 0.7 * pitch * np.degrees(np.arccos(1 - z / 20))
    inside = (away < reach[:, None]) & np.isfinite(moved)
    share = inside / np.maximum(inside.sum(axis=1, keepdims=True), 1)
    part = share * np.nan_to_num(moved)
    shift, at = part.sum(axis=1), share @ place
    swing = (part @ place.conj() - shift * at.conj()) / (share @ np.abs(place) ** 2 - np.abs(at) ** 2)
    seen = np.column_stack([shift / axis / pitch / np.degrees(1) * 20, -sign * np.angle(1 + swing, deg=True)])
    for low in range(6):
        b = np.flatnonzero((z >= low) & (z < low + 1) & (inside.sum(axis=1) > 4))
        if len(b) < 100:
            continue
        h, t, s, g = z[b] - low - 0.5, tilt[b] / 25, shear[b], labels[b, 5]
        still = [h**0, h, t, t.conj(), h * t, h * t.conj(), t * t, t.conj() ** 2, np.abs(t) ** 2]
        parts = np.column_stack([*still, s, g])
        fit = np.linalg.lstsq(parts, seen[b], rcond=None)[0]
        way, turn = (seen[b] - parts @ fit + parts[:, -2:] * np.diag(fit[-2:])).T
        along = (way * s.conj()).real / np.abs(s)
        yield low, np.column_stack([np.abs(s), along, np.abs(g), turn.real * np.sign(g)])


def sticking(*folders: Path) -> None:
    """Real TacTips, and simulated ones with 2000 of the first one's labels."""
    tracks = [labelled.track(folder) for folder in folders]
    named = {f.parent.name: (t.labels, t.rest, t.positions) for f, t in zip(folders, tracks, strict=True)}
    labels = np.random.default_rng(0).permutation(tracks[0].labels)[:2000]
    for name, file in SENSORS.items():
        places = np.array([sensor.marker_pixels for sensor in pressed(file, labels)])
        named[name] = labels, TacTip(file.sensor).marker_pixels, places
    heads = "sensor, z (mm), contacts, way over shear at 0.5-1.5 mm, over this: 1.5-2.5, 2.5-3.5, 3.5-5"
    table = Table((heads + ", turn over twist at 0-2 deg, 2-3.5, 3.5-5").split(", "), HOW)
    for name, markers in named.items():
        for low, rows in contacts(*markers):
            table.row(name, f"{low}-{low + 1}", len(rows), *banded(following, rows))


def friction(*folders: Path) -> None:
    """The friction at which the built-in skin slips as much as a real TacTip does, under its labels."""
    heads = "sensor, z (mm), contacts, friction by the limit of force, by the limit of torque"
    table = Table(heads.split(", "), f"{HOW}; <, >: beyond {FRICTIONS[0]} to {FRICTIONS[-1]}")
    for folder in folders:
        track = labelled.track(folder)
        some, others = np.random.default_rng(0).permutation(track.labels)[:4000].reshape(2, -1, 6)
        simulated = [dict(contacts(*with_friction(value, some))) for value in FRICTIONS]
        real = dict(contacts(track.labels, track.rest, track.positions))
        check = dict(contacts(*with_friction(SensorFile().sensor.contact.friction, others)))
        for name, rows in ((folder.parent.name, real), ("built in", check)):
            for low in sorted(rows.keys() & simulated[0].keys()):
                curves = np.maximum.accumulate([slipping(skin[low]) for skin in simulated])
                found = bands(slipping, rows[low])
                table.row(name, f"{low}-{low + 1}", len(rows[low]), *map(as_friction, found.T, curves.T))


def with_friction(value: float, labels: Array) -> tuple[Array, Array, Array]:
    """Labels, markers at rest and in the contacts of the built-in skin with another friction."""
    file = SensorFile(TacTipSettings(contact=ContactSettings(friction=value)))
    places = np.array([sensor.marker_pixels for sensor in pressed(file, labels)])
    return labels, TacTip(file.sensor).marker_pixels, places


def slipping(rows: Array) -> list[float]:
    """Of `following` what a limit of force and what a limit of torque hold back most."""
    numbers = following(rows)
    return [numbers[3], numbers[-1]]


def as_friction(found: Array, curve: Array) -> str:
    """A number and the ends of its band as frictions, by what each of `FRICTIONS` makes of it."""
    ends = {FRICTIONS[0]: "<", FRICTIONS[-1]: ">"}
    value, low, high = (ends.get(v, f"{v:.2f}") for v in np.interp(found, curve, FRICTIONS))
    return f"{value} ({low}, {high})"


if __name__ == "__main__":
    given = parser(__doc__ or "")
    given.add_argument("what", choices=("forces", "sticking", "friction"))
    given.add_argument("folders", nargs="+", type=Path)
    arguments = given.parse_args()
    {"forces": forces, "sticking": sticking, "friction": friction}[arguments.what](*arguments.folders)
