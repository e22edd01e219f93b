"""Where rendered light lies across a trace that first principles predict: per stretch its mean, spread and amount."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from first_principles import Tracer
from holding import STATED, setting_errors
from scipy.interpolate import CubicSpline
from scipy.spatial import cKDTree

from benchsim.bench.place import place
from benchsim.renderer import irradiance

STRETCHES = 12
SEEDS = range(71, 76)
CHANCE = 5.5  # sigma of 48 degrees of freedom: of 36 numbers one lies beyond by chance in one test of 20,000
FLOAT32 = 2e-4  # mm, of hits in single precision, where they do not average
RELATIVE = 2e-4  # of variance and light, likewise
PITCH = 0.5  # mm


def expectation(tracer, samples=37):
    """Line (spline in arc length), its length, profiles' spread, and variance and light per mm as functions of s."""
    points, tangent = tracer.line(samples)
    s = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))]
    q, light = (x.swapaxes(0, 1).reshape(samples, -1) for x in tracer.profiles(points, tangent, along=20, across=8))
    flux = light.sum(1)
    mean = (q * light).sum(1) / flux
    variance = ((q - mean[:, None]) ** 2 * light).sum(1) / flux
    return CubicSpline(s, points), s[-1], np.abs(q).max(), CubicSpline(s, variance), CubicSpline(s, flux)


def offsets(light, line, length, reach, about=None):
    """Arc length and offset of a map's bins nearer to the line than ``reach``, and their light over normals of it."""
    fine = np.linspace(0.0, length, 4 * int(length))
    rows, columns = np.nonzero(light.values > 0.0)
    at = np.column_stack([light.y[columns], light.z[rows]])
    if about is not None:  # only bins within 50 mm of that place
        keep = np.abs(at - line(about)).max(1) < 50.0
        at, rows, columns = at[keep], rows[keep], columns[keep]
    near, nearest = cKDTree(line(fine)).query(at, distance_upper_bound=reach + 2.0)
    keep = np.isfinite(near)
    at, s, value = at[keep], fine[nearest[keep]], light.values[rows[keep], columns[keep]]
    for _ in range(2):  # onto the foot
        along = line(s, 1)
        s = s + ((at - line(s)) * along).sum(1)
    along = line(s, 1)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    bend = line(s, 2)
    off = at - line(s)
    q = off[:, 1] * along[:, 0] - off[:, 0] * along[:, 1]
    curvature = -bend[:, 0] * along[:, 1] + bend[:, 1] * along[:, 0]
    weight = (value * light.pitch**2 / (1.0 - curvature * q))[np.abs(q) < reach]  # area between neighbouring normals
    return s[np.abs(q) < reach], q[np.abs(q) < reach], weight


def stretches(light, line, length, reach):
    """Mean offset, variance [mm, mm²] and light per mm of a map in each stretch."""
    s, q, weight = offsets(light, line, length, reach)
    share = weight * windows(s, length)
    amount = share.sum(1)
    mean = share @ q / amount
    variance = share @ (q * q) / amount - mean**2 - light.pitch**2 / 6.0  # less that of the tents
    return mean, variance, amount


def across(light, line, length, reach):
    """Gaussian-weighted shares and first moments of a map's profile about the middle of the line."""
    s, q, weight = offsets(light, line, length, reach, about=0.5 * length)
    weight = weight * np.exp(-0.5 * ((s - 0.5 * length) / 8.0) ** 2)
    windows_ = [np.exp(-0.5 * (q / w) ** 2) for w in (0.5, 1.0, 2.0)]
    return np.array([(weight * w).sum() for w in windows_] + [(weight * w * q).sum() for w in windows_]) / weight.sum()


def windows(s, length):
    """Smooth stretches (STRETCHES, n) that overlap by half, of integral 1 each; sharp ones would cut bins."""
    width = 0.92 * length / (STRETCHES + 1)
    middle = 0.04 * length + width * np.arange(1, STRETCHES + 1)
    x = (s - middle[:, None]) / width
    return np.where(np.abs(x) < 1.0, np.cos(0.5 * np.pi * x) ** 2, 0.0) / width


def land(recording, effects=None, *, errors=STATED, index=0, rays=1_000_000, amount=True, samples=37, truth=None):
    """`renderer`'s light against first principles, by a z-test of every stretch; what it differs by."""
    effects = effects or {}
    bent = replace(recording, effects=effects)
    exposure = recording.exposures[index]
    flat = {key: value for table in effects.values() for key, value in table.items()}
    line, length, reach, variance, flux = expectation(Tracer(truth or recording, exposure, errors, flat), samples)
    placed = place(recording.mirror, exposure, setting_errors(errors))
    found = np.array(
        [
            stretches(
                irradiance(bent, exposure, placement=placed, seed=seed, rays=rays, pitch=PITCH),
                line,
                length,
                reach + 2.0 * PITCH,
            )
            for seed in SEEDS
        ]
    )  # (seed, what, stretch)
    fine = np.linspace(0.0, length, 4001)
    window = windows(fine, length) * (fine[1] - fine[0])
    amounts = window @ flux(fine)
    expected = np.array([np.zeros(STRETCHES), window @ (variance(fine) * flux(fine)) / amounts, amounts])
    error = np.sqrt(found.var(0, ddof=1).mean(1, keepdims=True) / len(SEEDS))  # pooled over the stretches
    off = found.mean(0) - expected
    allowed = CHANCE * error + [[FLOAT32], [RELATIVE * expected[1].mean()], [RELATIVE * expected[2].mean()]]
    assert np.abs(off[0]).max() < allowed[0], f"{1e3 * np.abs(off[0]).max():.1f} µm off, σ {1e3 * error[0, 0]:.2f} µm"
    assert np.abs(off[1]).max() < allowed[1]
    if amount:
        assert np.abs(off[2]).max() < allowed[2]
    return off, error
