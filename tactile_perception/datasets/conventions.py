"""Signs, units and frames of a data set's labels, as far as its images tell them.

`find_conventions` compares what markers do (`marker_flow`) with what they must do if the labels are the Euler
surface contact pose of the paper: which components have the opposite sign, whether axes are swapped or images
mirrored, whether lengths are mm and angles degrees, and in which order the angles turn.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_perception.datasets.table import ConventionSettings
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.markers.flow import MarkerFlow, regressions

Array = NDArray[np.float64]

TIP_RADIUS_MM = 20.0  # only the order of magnitude matters
CERTAIN_RATIO = 1.15  # variety at one end of z over that at the other
_FLIPPABLE = ("x", "y", "alpha", "beta", "gamma")
_SWAPS = ("", "x and y", "alpha and beta")
_COST_SWAP, _COST_MIRROR = 2.0, 1.5
_DRAWS = 12  # of the samples, for a standard error
_FITS = 45.0  # deg between the camera's angle by shear and by tilt


@dataclass(frozen=True)
class Explanation:
    """What has to be changed for labels and images to fit together; nothing where they do."""

    flipped: tuple[str, ...] = ()
    swapped: str = ""
    mirrored: bool = False

    @property
    def cost(self) -> float:
        return len(self.flipped) + _COST_SWAP * bool(self.swapped) + _COST_MIRROR * self.mirrored

    def __str__(self) -> str:
        parts = []
        if self.flipped:
            have = "has" if len(self.flipped) == 1 else "have"
            parts.append(f"{', '.join(self.flipped)} {have} the opposite sign")
        if self.swapped:
            parts.append(f"{self.swapped} are swapped")
        if self.mirrored:
            parts.append("the images are mirrored")
        return " and ".join(parts) or "as in the paper"


@dataclass(frozen=True)
class Conventions:
    """What was found.

    Attributes
    ----------
    depth_flipped : whether z falls as contacts get deeper; None where images do not tell
    explanations : the simplest ones that make labels and images fit, all of one cost; empty where none does,
        or where images do not tell
    cameras_deg : by each explanation, the angle of the sensor's x-axis in the image, from columns to rows
    uncertain : what images do not tell
    camera_deg : the same angle by the labels as they are
    length_unit, angle_unit : "mm", "m", "deg", "rad", or "" where images do not tell
    gains : numbers from which the units were inferred
    order : "extrinsic", "intrinsic", or ""
    order_t : Student's t of extrinsic against intrinsic; positive for extrinsic
    """

    depth_flipped: bool | None
    explanations: list[Explanation]
    cameras_deg: list[float]
    uncertain: list[str]
    camera_deg: float
    length_unit: str
    angle_unit: str
    gains: dict[str, float]
    order: str
    order_t: float

    @property
    def wrong(self) -> bool:
        """Whether a sign or a unit is found to be another one than the paper's."""
        flipped = bool(self.explanations) and self.explanations[0].cost > 0
        return flipped or bool(self.depth_flipped) or self.length_unit == "m" or self.angle_unit == "rad"

    def corrections(self, applied: ConventionSettings) -> list[tuple[dict[str, Any], float]]:
        """What `conventions.json` may hold: each way to correct signs and units, with the camera's angle.

        `applied` is what it holds already.
        """
        z = ["z"] if self.depth_flipped else []
        units = {
            "length_unit": "m" if self.length_unit == "m" else applied.length_unit,
            "angle_unit": "rad" if self.angle_unit == "rad" else applied.angle_unit,
        }

        def flip(way: Explanation) -> list[str]:
            found, before = [*way.flipped, *z], applied.flip
            return [n for n in found if n not in before] + [n for n in before if n not in found]

        ways = list(zip(self.explanations, self.cameras_deg, strict=True))
        if self.uncertain and not ways:  # of which z and units may be told all the same
            ways = [(Explanation(), self.camera_deg)]
        return [
            ({"flip": flip(way), **units}, camera)
            for way, camera in ways
            if not way.swapped and not way.mirrored
        ]


def find_conventions(flow: MarkerFlow) -> Conventions:
    """Read off the flow of the markers what the labels' conventions are."""
    uncertain = [
        text
        for text, measured in (
            ("the direction of x and y", flow.shear),
            ("the direction of alpha and beta", flow.tilt),
            ("the direction of gamma", flow.turn),
        )
        if not measured.certain
    ]
    depth_flipped = depth_alone(flow.deeper).depth_flipped
    if depth_flipped is None:
        uncertain.append("the direction of z")
    C_shear, C_tilt = -flow.shear.value, -flow.tilt.value * np.sign(flow.spread.value)
    explanations = explain(C_shear, C_tilt, float(np.sign(np.nan_to_num(flow.turn.value))), uncertain)
    length_unit, angle_unit, gains = _units(flow, uncertain)
    order, t = euler_order(flow, explanations, angle_unit)
    cameras = [_angle(_corrected_shear(C_shear, explanation)) for explanation in explanations]
    angle = _angle(C_shear)
    return Conventions(
        depth_flipped, explanations, cameras, uncertain, angle, length_unit, angle_unit, gains, order, t
    )


def depth_alone(deeper: float) -> Conventions:
    """What is known where images tell nothing but the direction of z, by how `MarkerFlow.deeper` has it."""
    certain = max(deeper, 1.0 / max(deeper, 1e-9)) >= CERTAIN_RATIO
    return Conventions(
        depth_flipped=deeper < 1.0 if certain else None, uncertain=["directions"],
        explanations=[], cameras_deg=[], camera_deg=float("nan"), length_unit="", angle_unit="", gains={},
        order="", order_t=0.0,
    )  # fmt: skip


def explain(C_shear: Array, C_tilt: Array, turn: float, uncertain: Sequence[str] = ()) -> list[Explanation]:
    """The simplest explanations of the two maps (2, 2) from sensor to image and of the sense of rotation.

    What is `uncertain` is left out of the comparison; without shear or tilt nothing can be said.
    """
    unknown = " ".join(uncertain)
    if "x and y" in unknown or "alpha and beta" in unknown:
        return []
    flippable = tuple(name for name in _FLIPPABLE if not (name == "gamma" and "gamma" in unknown))
    candidates = (
        Explanation(flipped, swapped, mirrored)
        for count in range(len(flippable) + 1)
        for flipped in itertools.combinations(flippable, count)
        for swapped in _SWAPS
        for mirrored in (False, True)
    )
    sense = 0.0 if "gamma" in unknown else turn
    fitting = [candidate for candidate in candidates if _fits(C_shear, C_tilt, sense, candidate)]
    least = min((explanation.cost for explanation in fitting), default=0.0)
    return [explanation for explanation in fitting if explanation.cost == least]


def _fits(C_shear: Array, C_tilt: Array, turn: float, explanation: Explanation) -> bool:
    """Whether shear, tilt and rotation agree on one camera, once labels are changed as explained."""
    signs = {name: -1.0 if name in explanation.flipped else 1.0 for name in _FLIPPABLE}
    shear = _corrected_shear(C_shear, explanation)
    tilt = C_tilt * [signs["beta"], signs["alpha"]]
    if explanation.swapped == "alpha and beta":
        # (-beta, alpha) of swapped labels: the columns change places, and each its sign
        tilt = -tilt[:, ::-1]
    handed = -1.0 if explanation.mirrored else 1.0
    if np.sign(np.linalg.det(shear)) != handed or np.sign(np.linalg.det(tilt)) != handed:
        return False
    apart = (_angle(shear) - _angle(tilt) + 180.0) % 360.0 - 180.0
    return abs(apart) < _FITS and turn * signs["gamma"] * handed <= 0.0


def _corrected_shear(C_shear: Array, explanation: Explanation) -> Array:
    signs = [-1.0 if name in explanation.flipped else 1.0 for name in ("x", "y")]
    shear = C_shear * signs
    return shear[:, ::-1] if explanation.swapped == "x and y" else shear


def _angle(C: Array) -> float:
    """Angle (deg) of the rotation, after a mirror where there is one, that is nearest to a map (2, 2)."""
    U, _, Vt = np.linalg.svd(C)
    Q = U @ Vt
    return float(np.degrees(np.arctan2(Q[1, 0], Q[0, 0])))


def _units(flow: MarkerFlow, uncertain: Sequence[str]) -> tuple[str, str, dict[str, float]]:
    """Units by how far markers go: about a millimeter by a millimeter, and about a radian by a radian."""
    shear = float(np.sqrt(np.abs(np.linalg.det(flow.shear.value)))) * TIP_RADIUS_MM
    tilt = float(np.sqrt(np.abs(np.linalg.det(flow.tilt.value)))) / max(abs(float(flow.spread.value)), 1e-9)
    turn = abs(float(flow.turn.value))
    gains = {"mm of marker by unit of x, y": shear, "radii of contact by unit of angle": tilt,
             "rad of marker by unit of gamma": turn}  # fmt: skip
    unknown = " ".join(uncertain)
    length = "" if "x and y" in unknown else "m" if shear > np.sqrt(1000.0) else "mm"
    angle = ""
    if "alpha and beta" not in unknown:
        # by radian, contacts move by one to four radii of the marker field, on sensors real and simulated
        angle = "rad" if tilt > 2.0 / np.sqrt(180.0 / np.pi) else "deg"
    return length, angle, gains


def sense_of_turning(flow: MarkerFlow) -> float:
    """Whether what is seen turns against gamma, for labels whose gamma goes all round, as at an edge.

    The sensor turns by gamma over the surface: all that is not round turns by -gamma in the image. How
    inner markers move by (cos gamma, sin gamma) is then a map (2, 2) with a negative determinant. Gives that
    in standard errors: below -5 as in the paper, over 5 if gamma is flipped or images are mirrored.
    """
    gamma, z = np.radians(flow.labels[:, 5]), flow.labels[:, 2]
    y = flow.labels[:, 1] / max(float(np.abs(flow.labels[:, 1]).max()), 1e-12)
    basis = np.stack([np.ones_like(y), z - z.mean(), y, y * y, np.cos(gamma), np.sin(gamma)], axis=1)
    basis = np.hstack([basis, y[:, None] * basis[:, 4:], (y * y)[:, None] * basis[:, 4:]])
    inner = np.linalg.norm(flow.rest - flow.center, axis=1) < 0.5 * flow.radius
    rng, dets = np.random.default_rng(0), []
    for draw in range(1 + _DRAWS):
        weights = np.ones(len(y)) if draw == 0 else rng.multinomial(len(y), np.full(len(y), 1.0 / len(y)))
        moved = regressions(basis, flow.positions, weights, markers=inner)
        moved = moved[np.isfinite(moved[:, 0, 0])]
        dets.append(np.linalg.det(moved[:, 4:6].mean(axis=0)) if len(moved) else 0.0)
    return float(dets[0] / max(float(np.std(dets[1:])), 1e-12))


def corrected(labels: Array, explanation: Explanation, angle_unit: str) -> Array:
    """Labels (n, 6) with angles in rad and the explanation applied."""
    out = labels.copy()
    for name in explanation.flipped:
        out[:, EULER_COMPONENTS.index(name)] *= -1.0
    if explanation.swapped == "x and y":
        out[:, [0, 1]] = out[:, [1, 0]]
    if explanation.swapped == "alpha and beta":
        out[:, [3, 4]] = out[:, [4, 3]]
    if angle_unit != "rad":
        out[:, 3:] = np.radians(out[:, 3:])
    return out


def euler_order(flow: MarkerFlow, explanations: Sequence[Explanation], angle_unit: str) -> tuple[str, float]:
    """Whether angles turn about fixed axes (extrinsic xyz) or about the sensor's own (intrinsic xyz).

    Both orders are fitted to the inner markers; the better one wins if it does so sample by sample.

    Returns
    -------
    order : "extrinsic", "intrinsic", or "" where images do not tell
    t : Student's t over the samples, positive for extrinsic
    """
    if not explanations or not angle_unit:
        return "", 0.0
    labels = corrected(flow.labels, explanations[0], angle_unit)
    rank = np.argsort(np.argsort(np.abs(labels[:, 2] - labels[np.argmin(flow.labels[:, 2]), 2])))
    deep = rank > 0.3 * len(rank)
    inner = np.linalg.norm(flow.rest - flow.center, axis=1) < 0.6 * flow.radius
    errors = []
    for extrinsic in (True, False):
        basis = _order_basis(labels, extrinsic)
        errors.append(_squared_errors(basis, flow.positions[:, inner], deep))
    better = (errors[1] - errors[0])[deep]
    better = better[np.isfinite(better)]
    if not len(better):
        return "", 0.0
    t = float(better.mean() / max(better.std() / np.sqrt(max(len(better), 1)), 1e-12))
    return ("extrinsic" if t > 3.0 else "intrinsic" if t < -3.0 else ""), t


def _order_basis(labels: Array, extrinsic: bool) -> Array:
    """What markers follow in one order of angles: direction of contact and shear in the sensor, by depth."""
    x, y, z, _, _, gamma = labels.T
    R = Rotation.from_euler("xyz" if extrinsic else "XYZ", labels[:, 3:]).as_matrix()
    u, v = R[:, 2, 0], R[:, 2, 1]
    size = max(float(np.abs(labels[:, :2]).max()), 1e-12)
    shear = np.einsum("nji,nj->ni", R, np.column_stack([x, y, np.zeros_like(x)])) / size
    d = (z - z.mean()) / max(float(np.ptp(z)), 1e-12)
    columns = [np.ones_like(x), d, d * d, gamma, gamma * d]
    for q in (u, v, shear[:, 0], shear[:, 1]):
        columns += [q, q * d, q * d * d]
    for q in (u * u, v * v, u * v, u**3, v**3, u * u * v, u * v * v):
        columns += [q, q * d]
    return np.stack(columns, axis=1)


def _squared_errors(basis: Array, positions: Array, chosen: NDArray[np.bool_]) -> Array:
    """Mean squared error of each sample (n,), of markers regressed on the basis; NaN where none is seen."""
    weights = regressions(basis, positions, chosen, 3 * basis.shape[1])
    errors = ((positions - np.einsum("nb,mbk->nmk", basis, weights)) ** 2).sum(axis=2)[chosen]
    known = np.isfinite(errors)
    result = np.full(len(basis), np.nan)
    with np.errstate(invalid="ignore"):
        result[chosen] = np.where(known, errors, 0.0).sum(axis=1) / known.sum(axis=1)
    return result
