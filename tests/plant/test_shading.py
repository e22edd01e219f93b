"""Shading and blocking against another exact method that shares nothing with it.

The other: a point of a mirror is dark if its ray meets a neighbour's rectangle ahead. The conditions are linear in the
point's place, so that each neighbour darkens a convex polygon of five half-planes; along a line of the mirror each
darkens an interval, and between the heights at which any two edges cross, the length of the intervals' union is linear.
"""

import itertools

import numpy as np
import pytest

from benchsim.fluxes.heliostat import mirror_axes, unit
from benchsim.plant import shading
from benchsim.plant.shading import along, lost, seen_from


def half_planes(k, j, position, normal, width, height, direction):
    """Rows (a, b, c) with a u + b v + c ≥ 0 where neighbour j darkens point (u, v) of mirror k."""
    e = mirror_axes(normal[k])
    f = mirror_axes(normal[j])
    n = normal[j]
    speed = n @ direction
    # Way to j's plane: n · (p_j − p_k − u e0 − v e1) / (n · d), and where the ray is then, both linear in u and v.
    way = np.array([-(n @ e[0]), -(n @ e[1]), n @ (position[j] - position[k])]) / speed
    start = np.stack([e[0], e[1], position[k] - position[j]], axis=1)
    at = start + np.outer(direction, way)
    rows = [way]
    for axis, half in zip(f, (width[j] / 2, height[j] / 2), strict=True):
        for sign in (1, -1):
            rows.append(sign * (axis @ at) + np.array([0, 0, half]))
    return np.array(rows)


def darkened(polygons, width, height):
    """Area of the union of convex polygons (J, 5, 3) within a rectangle, by lines of it."""
    edges = np.concatenate([np.reshape(polygons, (-1, 3)), [[1, 0, width / 2], [-1, 0, width / 2]]])
    edges = edges / np.linalg.norm(edges[:, :2], axis=1, keepdims=True)
    a, b, c = edges.T
    turn = np.outer(a, b) - np.outer(b, a)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = (np.outer(c, a) - np.outer(a, c)) / turn
    heights = np.r_[crossing[np.abs(turn) > 1e-12], -c[np.abs(a) < 1e-12] / b[np.abs(a) < 1e-12]]
    heights = np.unique(np.clip(np.r_[heights, -height / 2, height / 2], -height / 2, height / 2))
    v = (heights[1:] + heights[:-1]) / 2
    slope, offset = polygons[..., 0], polygons[..., 1] * v[:, None, None] + polygons[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -offset / slope
    left = np.where(slope > 0, at, -np.inf).max(axis=-1).clip(-width / 2, width / 2)
    right = np.where(slope < 0, at, np.inf).min(axis=-1).clip(-width / 2, width / 2)
    right = np.where(((slope == 0) & (offset < 0)).any(axis=-1), left, np.maximum(left, right))
    order = np.argsort(left, axis=1)
    left, right = np.take_along_axis(left, order, 1), np.take_along_axis(right, order, 1)
    reached = np.maximum.accumulate(np.c_[np.full(len(v), -width / 2), right], axis=1)[:, :-1]
    return float(np.maximum(right - np.maximum(left, reached), 0).sum(axis=1) @ np.diff(heights))


def neighbourhood(seed):
    """Two to a dozen mirrors close together, each its own size and normal; sun and rays at any height."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 13))
    position = rng.uniform([-9e3, -9e3, 0], [9e3, 9e3, 1500], (n, 3))
    position[:, :2] += 4e3 * np.stack(np.divmod(np.arange(n), 4), axis=1)
    width, height = rng.uniform(2e3, 6e3, n), rng.uniform(2e3, 6e3, n)

    def high(low):
        a, e = rng.uniform(0, 2 * np.pi), rng.uniform(low, 1.4)
        return np.array([np.cos(e) * np.sin(a), np.cos(e) * np.cos(a), np.sin(e)])

    sun, aim = high(0.05), rng.uniform([-2e4, -2e4, 2e4], [2e4, 2e4, 6e4])
    ray = unit(aim - position)
    normal = unit(ray + sun + rng.normal(0, 0.05, (n, 3)))
    ray = 2 * normal * (normal @ sun)[:, None] - sun
    keep = (normal @ sun > 0.05) & (ray[:, 2] > 0.02)
    return position[keep], normal[keep], width[keep], height[keep], sun, ray[keep], np.full(keep.sum(), 1e6)


def differences(seed):
    """Largest differences of shaded and blocked parts in a neighbourhood, and how much is lost in it."""
    position, normal, width, height, sun, ray, _ = field = neighbourhood(seed)
    shaded, blocked = lost(*field)
    worst = 0.0
    for k in range(len(position)):
        others = [j for j in range(len(position)) if j != k]
        if not others:
            continue
        by_sun, by_ray = (
            np.array([half_planes(k, j, position, normal, width, height, d) for j in others]) for d in (sun, ray[k])
        )
        area = width[k] * height[k]
        dark = darkened(by_sun, width[k], height[k]) / area
        both = darkened(np.concatenate([by_sun, by_ray]), width[k], height[k]) / area
        worst = max(worst, abs(shaded[k] - dark), abs(shaded[k] + blocked[k] - both))
    return worst, float(np.sum(shaded + blocked))


@pytest.mark.parametrize("seed", range(50))
def test_what_is_lost_is_the_area_of_the_union(seed):
    assert differences(seed)[0] < 1e-6


@pytest.mark.slow
def test_a_thousand_neighbourhoods():
    found = np.array([differences(seed) for seed in range(1000, 2000)])
    print(f"largest difference {found[:, 0].max():.1e}, {np.mean(found[:, 1] > 0):.0%} lose something")
    assert found[:, 0].max() < 1e-6
    assert np.mean(found[:, 1] > 0) > 0.8


def test_neighbourhoods_do_lose_light():
    """Else the fifty above would compare nothing with nothing."""
    some = [lost(*neighbourhood(seed)) for seed in range(50)]
    assert sum(s.max() > 0.05 for s, _ in some) > 30 and sum(b.max() > 0.05 for _, b in some) > 15


@pytest.mark.parametrize("seed", range(20))
def test_no_pair_that_meets_is_overlooked(seed):
    """The search among neighbours against all pairs, on fields that are larger than its reach."""
    rng = np.random.default_rng(seed)
    n = 60
    position = np.c_[rng.uniform(-1e5, 1e5, (n, 2)), rng.uniform(0, 5e3, n)]
    radius = rng.uniform(1e3, 6e3, n)
    sun = unit(rng.normal(0, 1, 3) * [1, 1, 0.2] + [0, 0, 0.25])
    ray = unit(np.array([0, 0, 6e4]) - position)
    reach = rng.uniform(5e4, 2e5, n)
    for direction, found, limit in (
        (np.broadcast_to(sun, (n, 3)), seen_from(position, radius, sun), np.full(n, np.inf)),
        (ray, along(position, radius, ray, reach), reach),
    ):
        pairs = set(zip(*found, strict=True))
        for i, j in itertools.permutations(range(n), 2):
            apart = position[j] - position[i]
            deep = apart @ direction[i]
            aside = np.linalg.norm(apart - deep * direction[i])
            if aside < radius[i] + radius[j] and 0 < deep < limit[i]:
                assert (i, j) in pairs


def test_one_mirror_before_another_takes_what_it_hides():
    """The sun in the north, 30° high, both mirrors upright to it: the one before hides half, all, or nothing."""
    sun = np.array([0, np.cos(0.5), np.sin(0.5)])
    across, up = mirror_axes(sun)
    for shift, part in ((0.5, 0.5), (0.0, 1.0), (1.01, 0.0)):
        position = np.array([[0.0, 0, 0], 9e3 * sun + shift * 4e3 * across + 0 * up])
        normal, size = np.array([sun, sun]), np.full(2, 4e3)
        shaded, blocked = lost(position, normal, size, size, sun, normal, np.full(2, 1e6))
        assert shaded == pytest.approx([part, 0], abs=1e-9) and blocked == pytest.approx([0, 0], abs=1e-9)


def test_a_mirror_behind_the_receiver_blocks_nothing():
    sun = np.array([0.0, 0.0, 1.0])
    ray = np.array([[0, 0.6, 0.8], [0, 0.6, 0.8]])
    normal, size = unit(ray + sun), np.full(2, 4e3)
    position = np.array([[0.0, 0, 0], [0, 1.2e4, 1.6e4]])
    for reach, lossy in ((1e6, True), (1e4, False)):
        assert (lost(position, normal, size, size, sun, ray, np.full(2, reach))[1][0] > 0.5) == lossy


def test_pairs_may_be_looked_at_a_few_at_a_time(monkeypatch):
    whole = lost(*neighbourhood(3))
    monkeypatch.setattr(shading, "AT_ONCE", 5)
    np.testing.assert_array_equal(lost(*neighbourhood(3)), whole)
