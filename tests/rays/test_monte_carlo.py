"""The predicted trace against rays drawn at random in plain NumPy: a whole polygon or cylinder, no quadrature."""

from itertools import pairwise

import numpy as np
import pytest

from benchsim.bench.curve import signed_distance
from benchsim.bench.model import Exposure, Laser, Mirror, Physics, Screen
from benchsim.bench.place import SettingErrors, place
from benchsim.rays import trace_curve
from benchsim.rays.profile import adaptive

FIG7A = Exposure("A", "7a", np.radians(101.0), np.radians(50.0), (1500.0, -160.0, -1430.0))
OFF = SettingErrors(np.array([0.7, -0.9, 0.5]), np.array([1e-3, -2e-3]), np.array([-1e-3, 1.5e-3]))


def rotate(v, axis, angle):
    """Rodrigues' formula for one vector and many angles."""
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return c * v + s * np.cross(axis, v) + (1 - c) * (axis @ v) * axis


def shoot(laser, mirror, placement, n, rng, facets=True, blur=0.0):
    """Board points of n rays at random phases; rays that miss are left out. Each of the n carries power 1/n."""
    d = placement.laser_direction
    u = np.cross(d, [0.0, 0.0, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(d, u)
    a, b = rng.normal(0, laser.waist / 2, (2, n))
    origin = placement.laser_point + a[:, None] * u + b[:, None] * v
    direction = d + laser.curvature * (a[:, None] * u + b[:, None] * v)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if facets:
        hits = [
            _facet(mirror, placement, origin, direction, turn + 2 * np.pi * k / mirror.facets)
            for turn in [rng.uniform(0, 2 * np.pi, n)]
            for k in range(mirror.facets)
        ]
    else:
        hits = [_cylinder(mirror, placement, origin, direction)]
    board = []
    for ok, x, normal in hits:
        out = direction[ok] - 2 * (direction[ok] * normal[ok]).sum(1)[:, None] * normal[ok]
        if blur:
            out = out + blur * rng.normal(size=out.shape)
        front = placement.screen_rotation[:, 0]
        path = (placement.screen_origin - x[ok]) @ front / (out @ front)
        arrive = (path > 0) & (out @ front < 0)
        there = x[ok][arrive] + path[arrive][:, None] * out[arrive] - placement.screen_origin
        board.append(there @ placement.screen_rotation[:, 1:])
    return np.concatenate(board)


def _facet(mirror, placement, origin, direction, angle):
    normal = rotate(placement.normal, placement.axis, angle)
    falling = (direction * normal).sum(1)
    s = (mirror.radius - ((origin - placement.centre) * normal).sum(1)) / falling
    x = origin + s[:, None] * direction
    rest = x - placement.centre
    h = rest @ placement.axis
    t = (rest * np.cross(placement.axis, normal)).sum(1)
    ok = (falling < 0) & (np.abs(h) <= mirror.height / 2) & (np.abs(t) <= mirror.facet_width / 2)
    return ok, x, normal


def _cylinder(mirror, placement, origin, direction):
    a = placement.axis
    o, d = origin - placement.centre, direction
    o_flat, d_flat = o - (o @ a)[:, None] * a, d - (d @ a)[:, None] * a
    aa, bb = (d_flat**2).sum(1), (o_flat * d_flat).sum(1)
    disc = bb**2 - aa * ((o_flat**2).sum(1) - mirror.radius**2)
    s = (-bb - np.sqrt(np.maximum(disc, 0))) / aa
    x = origin + s[:, None] * direction
    normal = (o_flat + s[:, None] * d_flat) / mirror.radius
    return (disc > 0) & (np.abs((x - placement.centre) @ a) <= mirror.height / 2), x, normal


@pytest.mark.parametrize("batches", [2, pytest.param(6, marks=pytest.mark.slow)])
@pytest.mark.parametrize("facets, blur", [(True, 0.0), (False, 0.0), (True, 1.2e-3)])
def test_monte_carlo(facets, blur, batches):
    """Centre, flux and width against rays drawn at random.

    Set-up: one or three million rays, whole polygon or cylinder, 6 stretches of the curve; setting errors that skew the
    profile.
    Expectation: z of centre, flux and width below 4 in each of the 18 (false alarm 1.1e-3 at fixed seed).
    """
    rng = np.random.default_rng(20240)
    physics = Physics(facets, True, False)
    laser = Laser(incoherent_divergence=4 * blur)
    p = place(Mirror(), FIG7A, OFF)
    n = batches * 500_000
    board = np.concatenate([shoot(laser, Mirror(), p, 500_000, rng, facets, blur) for _ in range(batches)])
    board = board[np.abs(board).max(axis=1) < 450]
    curve = trace_curve(laser, Mirror(), physics, Screen(), p)
    q, s = signed_distance(curve, board)
    along = curve.arc_length()
    edges = np.linspace(30, along[-1] - 30, 7)
    for lo, hi in pairwise(edges):
        here = (s > lo) & (s < hi) & (np.abs(q) < 20)
        count = here.sum()
        mid = (along > lo) & (along < hi)
        expected = n * np.trapezoid(np.interp(f := np.linspace(lo, hi, 200), along, curve.flux), f)
        assert abs(count - expected) < 4 * np.sqrt(expected)
        assert abs(q[here].mean()) < 4 * q[here].std() / np.sqrt(count) + 2e-4
        # Its spread in units of width/√count, from 200 resamplings: 0.61 for the box-like profile, 1.03 blurred.
        spread = 1.03 if blur else 0.61
        _, width = adaptive(q[here][None], np.ones((1, count)), np.zeros(1))
        assert abs(width[0] - curve.width[mid].mean()) < 4 * spread * width[0] / np.sqrt(count)
