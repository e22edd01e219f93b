"""Shading and blocking: what neighbours take from a mirror, exactly, by their outlines projected onto it.

A neighbour's outline is projected along the sun's direction, and along the mirror's central ray, onto the mirror's
plane; what is lost is the area of the union of all projections within the mirror. The light of a mirror's every point
is taken to leave along its central ray: over the distance to a neighbour it converges by less than a part of that
distance to the receiver's. The sun is a point. The tower is not there.

Neighbours are looked for without a cut-off: seen from the sun, mirrors overlap only if the circles around them do;
along a ray, only if its circle passes them before it has risen above every mirror of the field.
"""

from __future__ import annotations

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchsim.fluxes.heliostat import mirror_axes
from benchsim.plant.model import OUTLINE

Array = NDArray[np.float64]
Index = NDArray[np.intp]

AHEAD = 1e-9
"""In multiples of a mirror's size: corners nearer to its plane than this lie in it."""

AT_ONCE = 200_000
"""Pairs that are projected together: some arrays of 20 MB."""

MIRRORS = 256
"""Whose neighbours are looked for together: along a level ray all mirrors of the field may be."""


def lost(
    position: Array, normal: Array, width: Array, height: Array, sun: Array, ray: Array, reach: Array
) -> tuple[Array, Array]:
    """Parts of mirrors that are shaded, and of the rest of the mirror's area that are blocked alone.

    Parameters
    ----------
    position, normal : (n, 3)
        [mm], unit vectors.
    width, height : (n,) mm
    sun : (3,)
        Unit vector toward it.
    ray : (n, 3)
        Of the reflected light.
    reach : (n,) mm
        To the receiver, behind which nothing blocks.

    Returns
    -------
    shaded, blocked : (n,)
        In the mirror's area: their sum is what is lost.
    """
    n = len(position)
    if n < 2:
        return np.zeros(n), np.zeros(n)
    radius = np.hypot(width, height) / 2
    mirrors = (position, mirror_axes(normal).transpose(1, 0, 2), normal, width, height)
    toward = np.broadcast_to(sun, position.shape)
    shadows = _projected(mirrors, *seen_from(position, radius, sun), toward)
    blocks = _projected(mirrors, *along(position, radius, ray, reach), ray)
    shaded = _covered(n, *shadows)
    both = _covered(n, np.r_[shadows[0], blocks[0]], np.r_[shadows[1], blocks[1]])
    area = width * height
    return shaded / area, np.maximum(both - shaded, 0.0) / area


def seen_from(position: Array, radius: Array, sun: Array) -> tuple[Index, Index]:
    """Pairs (mirror, the one before it) whose circles overlap as the sun sees them."""
    flat = position @ np.linalg.svd(sun[None])[2][1:].T
    deep = position @ sun
    tree = cKDTree(flat)
    pairs = tree.query_pairs(2 * radius.max(), output_type="ndarray")
    i, j = np.r_[pairs[:, 0], pairs[:, 1]], np.r_[pairs[:, 1], pairs[:, 0]]
    reach = radius[i] + radius[j]
    near = (((flat[i] - flat[j]) ** 2).sum(axis=1) < reach**2) & (deep[j] - deep[i] > -reach)
    return i[near], j[near]


def along(position: Array, radius: Array, ray: Array, reach: Array) -> tuple[Index, Index]:
    """Pairs (mirror, another) whose circles meet as the mirror's travels along its ray."""
    top = (position[:, 2] + radius).max()
    with np.errstate(divide="ignore"):
        rise = np.where(ray[:, 2] > 0, (top - position[:, 2] + radius) / np.maximum(ray[:, 2], 1e-300), np.inf)
    way = np.minimum(rise, reach)
    tree = cKDTree(position)
    pairs = [(np.zeros(0, np.intp), np.zeros(0, np.intp))]
    for k in range(0, len(position), MIRRORS):
        some = slice(k, k + MIRRORS)
        middle, wide = position[some] + way[some, None] / 2 * ray[some], way[some] / 2 + radius[some] + radius.max()
        found = tree.query_ball_point(middle, wide, return_sorted=False)
        i = np.repeat(np.arange(k, k + len(found)), [len(f) for f in found])
        j = np.concatenate([np.asarray(f, np.intp) for f in found])
        apart = position[j] - position[i]
        deep = (apart * ray[i]).sum(axis=1)
        aside = (apart**2).sum(axis=1) - deep**2
        size = radius[i] + radius[j]
        keep = (i != j) & (aside < size**2) & (deep > -size) & (deep < way[i] + size)
        pairs.append((i[keep], j[keep]))
    return np.concatenate([i for i, _ in pairs]), np.concatenate([j for _, j in pairs])


def _projected(
    mirrors: tuple[Array, Array, Array, Array, Array], i: Index, j: Index, directions: Array
) -> tuple[Index, NDArray[np.object_]]:
    """Mirrors, and what of others lies before them, projected and cut to their rectangles."""
    index, shapes = [np.zeros(0, np.intp)], [np.zeros(0, object)]
    for k in range(0, len(i), AT_ONCE):
        which, polygons = _some_projected(mirrors, i[k : k + AT_ONCE], j[k : k + AT_ONCE], directions)
        index.append(which)
        shapes.append(polygons)
    return np.concatenate(index), np.concatenate(shapes)


def _some_projected(
    mirrors: tuple[Array, Array, Array, Array, Array], i: Index, j: Index, directions: Array
) -> tuple[Index, NDArray[np.object_]]:
    position, axes, normal, width, height = mirrors
    edges = OUTLINE * np.stack([width[j], height[j]], axis=1)[:, None]
    corners = (position[j] - position[i])[:, None] + edges @ axes[j]
    d = directions[i]
    before = np.einsum("pkc,pc->pk", corners, normal[i])
    flat = corners - (before / np.einsum("pc,pc->p", d, normal[i])[:, None])[..., None] * d[:, None]
    uv = flat @ axes[i].transpose(0, 2, 1)
    half = np.stack([width[i], height[i]], axis=1) / 2
    least = AHEAD * half.max(axis=1)[:, None]
    some = (before > least).any(axis=1) & (uv.max(axis=1) > -half).all(axis=1) & (uv.min(axis=1) < half).all(axis=1)
    whole = some & (before >= -least).all(axis=1)
    cut = some & ~whole
    polygons = np.concatenate(
        [
            shapely.polygons(uv[whole]),
            [shapely.Polygon(_before(p, b)) for p, b in zip(uv[cut], before[cut], strict=True)],
        ]
    )
    which = np.r_[i[whole], i[cut]]
    half = np.r_[half[whole], half[cut]]
    clipped = shapely.intersection(polygons, shapely.box(-half[:, 0], -half[:, 1], half[:, 0], half[:, 1]))
    there = ~shapely.is_empty(clipped)
    return which[there], clipped[there]


def _before(outline: Array, depth: Array) -> Array:
    """The part of an outline before the mirror's plane: depth is linear on it."""
    out = []
    for k in range(4):
        p, q, a, b = outline[k], outline[(k + 1) % 4], depth[k], depth[(k + 1) % 4]
        if a >= 0:
            out.append(p)
        if (a < 0) != (b < 0):
            out.append(p + a / (a - b) * (q - p))
    return np.array(out)


def _covered(n: int, which: Index, polygons: NDArray[np.object_]) -> Array:
    """Areas of the unions of the polygons of each mirror."""
    out = np.zeros(n)
    order = np.argsort(which, kind="stable")
    which, polygons = which[order], polygons[order]
    mirrors, start, count = np.unique(which, return_index=True, return_counts=True)
    single = count == 1
    out[mirrors[single]] = shapely.area(polygons[start[single]])
    for m, s, c in zip(mirrors[~single], start[~single], count[~single], strict=True):
        out[m] = shapely.union_all(polygons[s : s + c]).area
    return out
