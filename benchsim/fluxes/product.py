"""Flux as a product of error functions: Collado, Gómez & Turégano 1986, as Lara-Cerecedo 2016 uses it.

A spherical mirror of radius 2 d, seen from the sun at incidence i and looked at from its target at distance d, sends
its point q to the image plane (perpendicular to the central ray) at q⊥ − [(q·s) n + (n·s) q]⊥: in the plane of
incidence q (cos i − 1), across it q (1 − cos i). That is a reflection times 1 − cos i, a conformal map: the image of a
rectangle is a rectangle, turned and evenly lit, and its convolution with a circular Gaussian of σ_r = σ d is a product
of error functions,

    F = ρ I cos i / (1 − cos i)² · H(ζ, a₁) H(η, a₂),   H(w, a) = ½ [erf(w + a) − erf(w − a)],

with ζ, η the coordinates along the image's edges over √2 σ_r and a₁, a₂ its *half* edges, (1 − cos i) L/2, over √2 σ_r.
(The paper prints a plus in Eq. (9) and whole edges in Eq. (11), and refers to Collado for the angles φ − τ of Eq. (10):
here they are those of the map itself.) On a target that is not the image plane F is multiplied by the cosine of
incidence there, and points are carried to the image plane along the central ray.

Not for mirrors of another focal length than their distance, where the map is not conformal, nor for slope errors that
dominate at large incidence: they spread light less across the plane of incidence than in it (`benchsim.fluxes.traced`).

Of many heliostats at once, on any points of a receiver: those of a curved one are carried to each heliostat's image
plane along its central ray like those of a plane, and each point has its own obliquity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from benchsim.fluxes.heliostat import mirror_axes
from benchsim.instruments.mount.axes import reflected

Array = NDArray[np.float64]

LEAST = 1e-8
"""Of 1 − cos i: below, the image is a point, and where its edges point is of no consequence."""

AT_ONCE = 2**19
"""Values of flux that are worked on at once: some arrays of 4 MB."""


@dataclass(frozen=True)
class Beams:
    """What heliostats send.

    Attributes
    ----------
    position, normal : (n, 3)
        [mm], unit vectors.
    width, height : (n,) mm
    spread : (n,)
        Standard deviation of the light in one direction [rad].
    share, parts : (m,), (m, n)
        Weights and standard deviations [rad] of the circular Gaussians whose sum the light is; default that one alone.
    distance : (n,)
        To the image plane, at which the mirrors are focused [mm].
    sun : (3,)
    """

    position: Array
    normal: Array
    width: Array
    height: Array
    spread: Array
    distance: Array
    sun: Array
    share: Array = field(default_factory=lambda: np.ones(1))
    parts: Array | None = None

    @property
    def cosine(self) -> Array:
        """Of incidence, (n,)."""
        return np.asarray(self.normal @ self.sun)

    @property
    def ray(self) -> Array:
        """Directions of the central rays, (n, 3)."""
        return reflected(self.normal, self.sun)

    @property
    def image_rms(self) -> Array:
        """Of the distance of the light from the central ray on the image plane, (n,) mm: image and Gaussian."""
        shrink = 1 - self.cosine
        return np.asarray(
            np.sqrt(2 * (self.spread * self.distance) ** 2 + shrink**2 * (self.width**2 + self.height**2) / 12)
        )

    def chosen(self, index: NDArray[np.intp]) -> Beams:
        """Some of the heliostats."""
        return Beams(
            self.position[index], self.normal[index], self.width[index], self.height[index], self.spread[index],
            self.distance[index], self.sun, self.share, None if self.parts is None else self.parts[:, index],
        )  # fmt: skip


def flux(beams: Beams, points: Array, normals: Array) -> Array:
    """Flux of each heliostat at each point, (n, M), as a multiple of the irradiance on a plane that faces the sun.

    Parameters
    ----------
    beams : Beams
    points : (M, 3) mm
    normals : (M, 3) or (1, 3)
        Of the receiver's lit side.
    """
    s, n, r, cosine = beams.sun, beams.normal, beams.ray, beams.cosine
    shrink = np.maximum(1 - cosine, LEAST)
    parts = beams.spread[None] if beams.parts is None else beams.parts
    density = np.maximum(cosine, 0) / shrink**2
    oblique = np.maximum(-(r @ normals.T), 0)
    out = density[:, None] * oblique * 0.25
    if out.shape[1] != len(points):
        out = np.repeat(out, len(points), axis=1)
    edges = []
    for edge, length in zip(mirror_axes(n), (beams.width, beams.height), strict=True):
        on_image = edge - (edge * r).sum(axis=1, keepdims=True) * r
        turned = on_image - (edge @ s)[:, None] * (n - cosine[:, None] * r) - cosine[:, None] * on_image
        turned /= shrink[:, None]
        on_image = np.where((1 - cosine > LEAST)[:, None], turned, on_image)
        along = on_image @ points.T - (on_image * beams.position).sum(axis=1, keepdims=True)
        edges.append((along, (length * shrink / 2)[:, None]))
    total = np.zeros_like(out)
    for share, spread in zip(beams.share, parts, strict=True):
        scale = 1 / (np.sqrt(2) * spread * beams.distance)[:, None]
        one, other = (erf((along + half) * scale) - erf((along - half) * scale) for along, half in edges)
        total += share * one * other
    return np.asarray(out * total)


def batches(beams: Beams, points: Array, normals: Array) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Array]]:
    """`flux` of a few heliostats at a time: their index, that of the points which one of them lights, and the flux.

    Heliostats go by azimuth, so that those of one batch light the same side of a receiver.
    """
    count = max(1, AT_ONCE // len(points))
    ray = beams.ray
    order = np.argsort(np.arctan2(ray[:, 0], ray[:, 1]))
    every = np.arange(len(points))
    for start in range(0, len(order), count):
        some = order[start : start + count]
        lit = every if len(normals) == 1 else np.flatnonzero((ray[some] @ normals.T < 0).any(axis=0))
        if len(lit):
            yield some, lit, flux(beams.chosen(some), points[lit], normals if len(normals) == 1 else normals[lit])
