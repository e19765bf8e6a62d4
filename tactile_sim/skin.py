"""Elastic model of the tip: a gel dome under a stiffer skin, condensed to a compliance of its skin nodes.

The tip is half a ball, clamped on its flat back. Linear tetrahedra fill it: the skin's surface mesh (rings of
6k nodes) is extruded inwards through shells. Condensing the stiffness matrix to the outer surface gives
``u = C f``: displacements of the skin nodes under forces on the skin nodes, which is all that contact needs.

The default tip is condensed offline, because the factorization takes seconds. The mesh maps onto itself when
it turns by 60 degrees, so a sixth of the columns is stored. To make the file again::

    python -m tactile_sim.skin --write
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_scene.simulated_sensors import SkinSettings

Array = NDArray[np.float64]
DATA_FILE = Path(__file__).parent / "data" / "skin_compliance.npz"


@dataclass(frozen=True)
class Skin:
    """The condensed tip.

    Attributes
    ----------
    nodes : (n, 3) m
        Skin nodes that can move, at rest, in the frame of the dome's centre (z out of the tip).
    triangles : (m, 3) int
        Surface mesh over `nodes` and, with indices from n on, `rim`.
    rim : (r, 3) m
        The clamped ring.
    compliance : (3n, 3n) float32, m/N
        Displacement of the nodes under forces on them; rows and columns run node by node, xyz within.
    """

    nodes: Array
    triangles: NDArray[np.intp]
    rim: Array
    compliance: NDArray[np.float32]


def ring_directions(polar_angles: Array) -> Array:
    """Unit vectors in rings about +z: one at the pole, then 6k at `polar_angles[k]` (rad) from azimuth 0."""
    out = [np.array([[0.0, 0.0, 1.0]])]
    for k, polar in enumerate(polar_angles[1:], start=1):
        azimuth = 2 * np.pi * np.arange(6 * k) / (6 * k)
        out.append(np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth),
                             np.full_like(azimuth, np.cos(polar))], axis=1))  # fmt: skip
    return np.concatenate(out)


def ring_triangles(rings: int) -> NDArray[np.intp]:
    """Triangles between rings of 1, 6, 12, ... nodes (0..rings), wound so that normals point outwards."""
    triangles = []
    for k in range(1, rings + 1):
        for sextant in range(6):
            for j in range(k):
                a, b = _ring_index(k, sextant * k + j), _ring_index(k, sextant * k + j + 1)
                c = _ring_index(k - 1, sextant * (k - 1) + j)
                triangles.append((a, b, c))
                if j < k - 1:
                    triangles.append((b, _ring_index(k - 1, sextant * (k - 1) + j + 1), c))
    return np.array(triangles, dtype=np.intp)


def _ring_index(ring: int, position: int) -> int:
    return 0 if ring == 0 else 1 + 3 * ring * (ring - 1) + position % (6 * ring)


def build_skin(settings: SkinSettings) -> Skin:
    """Mesh, assemble and condense the tip (seconds).

    Raises
    ------
    ValueError
        If the shells do not fall from below the skin towards the centre.
    """
    radii = settings.radius * np.array([1.0, 1 - settings.skin_thickness / settings.radius, *settings.shells])
    if np.any(np.diff(radii) >= 0):
        raise ValueError(f"shells = {settings.shells}: must fall from below the skin ({radii[1]:.4g} m)")
    directions = ring_directions(np.linspace(0, np.pi / 2, settings.rings + 1))
    directions[_ring_index(settings.rings, 0) :, 2] = 0.0
    triangles = ring_triangles(settings.rings)
    positions, tetrahedra, in_skin = _extrude(directions, triangles, radii)
    modulus = settings.gel_modulus * np.where(in_skin, settings.stiffness_ratio, 1.0)
    outer = _ring_index(settings.rings, 0)
    sextant = _sextant(settings.rings)
    columns = _condense(positions, tetrahedra, modulus, settings.poisson_ratio, outer, sextant)
    return _hold_volume(_assemble_skin(settings, columns.astype(np.float32)), settings.volume_retention)


def load_skin(settings: SkinSettings | None = None) -> Skin:
    """The skin for these settings: built (seconds), or the shipped one if only modulus or volume differ."""
    settings, shipped = settings or SkinSettings(), SkinSettings()
    same = {"volume_retention": shipped.volume_retention, "gel_modulus": shipped.gel_modulus}
    if settings.replaced(**same) != shipped:
        return build_skin(settings)
    if not DATA_FILE.exists():
        raise FileNotFoundError(f"{DATA_FILE} is missing: run python -m tactile_sim.skin --write")
    with np.load(DATA_FILE) as data:
        columns = data["columns"] * np.float32(shipped.gel_modulus / settings.gel_modulus)
    return _hold_volume(_assemble_skin(settings, columns), settings.volume_retention)


def _assemble_skin(settings: SkinSettings, columns: NDArray[np.float32]) -> Skin:
    directions = ring_directions(np.linspace(0, np.pi / 2, settings.rings + 1))
    triangles = ring_triangles(settings.rings)
    positions = settings.radius * directions
    outer = _ring_index(settings.rings, 0)
    return Skin(positions[:outer], triangles, positions[outer:], _unfold(columns, settings.rings))


def _hold_volume(skin: Skin, retention: float) -> Skin:
    """The skin with a part of the volume change under any force taken back by pressure inside.

    With g the volume that a unit displacement of each node adds, a pressure p adds the forces p g. The one
    that takes back the part `retention` of the change g^T C f gives C - retention C g (C g)^T / (g^T C g).
    """
    if retention == 0.0:
        return skin
    share = _volume_gradient(skin).astype(np.float32)
    bulge = skin.compliance @ share
    factor = np.float32(retention / float(share @ bulge))
    held = skin.compliance - factor * np.outer(bulge, bulge)
    return replace(skin, compliance=np.ascontiguousarray(held, dtype=np.float32))


def _volume_gradient(skin: Skin) -> Array:
    """Volume (3n,) m^3 that the tip gains per m of displacement of each skin node."""
    points = np.concatenate([skin.nodes, skin.rim])
    a, b, c = (points[skin.triangles[:, k]] for k in range(3))
    third = np.cross(b - a, c - a) / 6
    gradient = np.zeros_like(points)
    for k in range(3):
        np.add.at(gradient, skin.triangles[:, k], third)
    return gradient[: len(skin.nodes)].ravel()


def _sextant(rings: int) -> NDArray[np.intp]:
    """Nodes whose columns, turned by multiples of 60 degrees, are the columns of all free nodes."""
    return np.array([0] + [_ring_index(k, j) for k in range(1, rings) for j in range(k)], dtype=np.intp)


def _unfold(columns: NDArray[np.float32], rings: int) -> NDArray[np.float32]:
    """The full compliance from the columns of one sextant, made exactly symmetric and six-fold."""
    count = _ring_index(rings, 0)
    source = _sextant(rings)
    blocks = columns.reshape(count, 3, len(source), 3).transpose(0, 2, 1, 3)
    full = np.zeros((count, count, 3, 3), dtype=np.float32)
    for turn in range(6):
        permuted = _turned(rings, turn)
        c, s = np.cos(turn * np.pi / 3), np.sin(turn * np.pi / 3)
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=np.float32)
        rotated = rotation @ blocks @ rotation.T
        full[np.ix_(permuted, permuted[source[1:]])] = rotated[:, 1:]
        full[permuted, 0] += rotated[:, 0] / 6  # the pole is its own image
    matrix = np.ascontiguousarray(full.transpose(0, 2, 1, 3)).reshape(3 * count, 3 * count)
    return np.ascontiguousarray((matrix + matrix.T) / 2)


def _turned(rings: int, turn: int) -> NDArray[np.intp]:
    """Where each free node goes when the tip turns by `turn` times 60 degrees."""
    out = [0] + [_ring_index(k, j + turn * k) for k in range(1, rings) for j in range(6 * k)]
    return np.array(out, dtype=np.intp)


def _extrude(
    directions: Array, triangles: NDArray[np.intp], radii: Array
) -> tuple[Array, NDArray[np.intp], NDArray[np.bool_]]:
    """Tetrahedra between consecutive shells, and from the innermost one to the centre."""
    count = len(directions)
    positions = np.concatenate([directions * r for r in radii] + [np.zeros((1, 3))])
    # splitting prisms by node order makes neighbours agree on the diagonals
    ordered = np.sort(triangles, axis=1)
    layers = []
    for layer in range(len(radii) - 1):
        a, b, c = (ordered[:, i] + layer * count for i in range(3))
        d, e, f = a + count, b + count, c + count
        layers.append(np.concatenate([np.stack(t, 1) for t in ((a, b, c, f), (a, b, e, f), (a, d, e, f))]))
    in_skin: NDArray[np.bool_] = np.zeros(sum(map(len, layers)) + len(triangles), dtype=bool)
    in_skin[: len(layers[0])] = True
    core = ordered + (len(radii) - 1) * count
    layers.append(np.column_stack([core, np.full(len(core), len(positions) - 1)]))
    return positions, np.concatenate(layers), in_skin


def _condense(
    positions: Array,
    tetrahedra: NDArray[np.intp],
    modulus: Array,
    poisson: float,
    outer: int,
    loaded: NDArray[np.intp],
) -> Array:
    """Displacements (3 outer, 3 len(loaded)) of the first `outer` nodes under unit forces on those loaded."""
    from scipy.sparse.linalg import splu

    stiffness = _assemble(positions, tetrahedra, modulus, poisson)
    free = np.flatnonzero(np.repeat(positions[:, 2] > 1e-9, 3))  # what lies on the flat back is clamped
    factor = splu(stiffness[free][:, free].tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0,
                  options={"SymmetricMode": True})  # fmt: skip
    rows = (3 * loaded[:, None] + np.arange(3)).ravel()
    load = np.zeros((len(free), len(rows)))
    load[rows, np.arange(len(rows))] = 1.0
    displacement: Array = factor.solve(load)[: 3 * outer]
    return displacement


def _assemble(positions: Array, tetrahedra: NDArray[np.intp], modulus: Array, poisson: float):  # type: ignore[no-untyped-def]
    """Stiffness matrix (sparse) of isotropic linear tetrahedra."""
    from scipy.sparse import coo_matrix

    corners = positions[tetrahedra]
    edges = corners[:, 1:] - corners[:, :1]
    volume = np.abs(np.linalg.det(edges)) / 6
    # rows: gradients of the shape functions of corners 1..3
    gradient = np.linalg.inv(edges).transpose(0, 2, 1)
    gradient = np.concatenate([-gradient.sum(1, keepdims=True), gradient], axis=1)
    shear = modulus / (2 * (1 + poisson))
    lame = modulus * poisson / ((1 + poisson) * (1 - 2 * poisson))
    dot = np.einsum("eik,ejk->eij", gradient, gradient)
    block = np.einsum("e,eia,ejb->eiajb", volume * lame, gradient, gradient)
    block += np.einsum("e,eib,eja->eiajb", volume * shear, gradient, gradient)
    block += np.einsum("e,eij,ab->eiajb", volume * shear, dot, np.eye(3))
    dof = (3 * tetrahedra[:, :, None] + np.arange(3)).reshape(len(tetrahedra), 12)
    rows, columns = np.repeat(dof, 12, axis=1).ravel(), np.tile(dof, (1, 12)).ravel()
    size = 3 * len(positions)
    return coo_matrix((block.ravel(), (rows, columns)), shape=(size, size)).tocsr()


def main() -> None:
    """Condense the default skin and report, or write, its file."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {DATA_FILE.name} into the package")
    args = parser.parse_args()
    settings = SkinSettings()
    skin = build_skin(settings)
    print(f"{len(skin.nodes)} free skin nodes, pole compliance {skin.compliance[2, 2]:.4g} m/N")
    if args.write:
        dof = (3 * _sextant(settings.rings)[:, None] + np.arange(3)).ravel()
        DATA_FILE.parent.mkdir(exist_ok=True)
        np.savez_compressed(DATA_FILE, columns=skin.compliance[:, dof])
        print(f"wrote {DATA_FILE} ({DATA_FILE.stat().st_size / 1e6:.2f} MB)")


if __name__ == "__main__":
    main()
