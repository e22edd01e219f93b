"""A heliostat's flux as a product of error functions: Collado, Gómez & Turégano 1986, as Lara-Cerecedo 2016 uses it.

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
dominate at large incidence: they spread light less across the plane of incidence than in it (`benchsim.fluxes.carlo`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import erf

from benchsim.fluxes.heliostat import Heliostat, Target, mirror_axes
from benchsim.instruments.mount.axes import reflected

Array = NDArray[np.float64]

_LEAST = 1e-8
"""Of 1 − cos i: below, the image is a point, and where its edges point is of no consequence."""


def flux(heliostat: Heliostat, target: Target, sun: ArrayLike, normal: ArrayLike, x: ArrayLike, z: ArrayLike) -> Array:
    """Flux on points of the target.

    Parameters
    ----------
    heliostat : Heliostat
    target : Target
    sun : (3,) array
        Unit vector toward the sun.
    normal : (3,) array
        Of the mirror's centre, deviated or ideal.
    x, z : arrays that broadcast
        Along the target's width and up, from its centre [mm].

    Returns
    -------
    array
        As a multiple of the irradiance on a plane that faces the sun. 0 where the target or the mirror is seen from
        behind.
    """
    s, n = np.asarray(sun, float), np.asarray(normal, float)
    r = reflected(n, s)
    cosine, oblique = float(n @ s), float(-(r @ np.array(target.normal)))
    across, up = target.axes
    x, z = np.broadcast_arrays(np.asarray(x, float), np.asarray(z, float))
    if cosine <= 0 or oblique <= 0:
        return np.zeros(x.shape)
    place = np.array(target.centre) + x[..., None] * across + z[..., None] * up - np.array(heliostat.position)
    distance = float((np.array(target.centre) - np.array(heliostat.position)) @ r)
    frame = mirror_axes(n)
    shrink = max(1 - cosine, _LEAST)
    on_image = frame - np.outer(frame @ r, r)
    if 1 - cosine > _LEAST:
        # Rows: where the mirror's edges point on the image plane; lengths 1, at right angles.
        on_image = (on_image - np.outer(frame @ s, n - cosine * r) - cosine * on_image) / shrink
    width = np.sqrt(2) * heliostat.total * distance
    along = place @ on_image.T / width
    sizes = np.array([heliostat.width, heliostat.height]) * shrink / 2 / width
    h = 0.5 * (erf(along + sizes) - erf(along - sizes))
    return np.asarray(heliostat.reflectance * cosine * oblique / shrink**2 * h[..., 0] * h[..., 1])
