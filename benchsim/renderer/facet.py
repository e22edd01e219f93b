"""The reflecting facet as it is: leaning, curved, or glass with its coating behind.

A facet turns about its own middle, C + r n, and not about the axis of rotation. Lean is that of its normal toward the
mirror's axis. A curved facet is a sphere that touches the plane in the middle. Glass: the front face is the facet, with
its edges; the coating lies that much behind and reaches beyond them. What enters through the front face is refracted,
reflected and refracted out, wherever it leaves; what the front face reflects (Fresnel, unpolarised) draws a ghost
beside it. Light that goes to and fro in the glass more than once is left out: it is as faint as the ghost and lies on
its other side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Recording
from benchsim.bench.place import Placement
from benchsim.renderer.effects import MRAD, PER_M, value
from benchsim.renderer.laser import Vec, dot
from benchsim.renderer.tables import Table, table

Array = NDArray[np.float64]

EFFECTS = {
    "pivot-offset": ("dr",),
    "canting": ("pyr",),
    "facet-tilts": ("tilt_rms", "tilt_*"),
    "axis-wobble": ("wob_c", "wob_s"),
    "axis-tilt": ("ped_x", "ped_y"),
    "azimuth-offset": ("az_enc",),
    "second-surface": ("glass",),
    "facet-curvature": ("fcurv",),
}
FIELDS = ("lean",)

GLASS = 1.515
"""Refractive index of the mirror's glass and of windows: BK7 at 633 nm, relative to air (Schott 2017: 1.5151)."""


def draw_tilts(rms: float, facets: int, seed: int) -> Array:
    """Leans of the facets beyond their mean, (facets,), with exactly that rms and zero sum, from a seed."""
    if facets < 2 or rms == 0:
        return np.zeros(facets)
    drawn = np.random.default_rng(seed).standard_normal(facets)
    drawn -= drawn.mean()
    return np.asarray(drawn * (rms / np.sqrt(np.mean(drawn**2))))


def leans(recording: Recording) -> Array:
    """Lean of every facet toward the axis, (facets,) [rad], without the free field's.

    Leans of an rms alone are drawn from ``[render] seed``.
    """
    effects, n = recording.effects, recording.mirror.facets
    k = np.arange(n)
    turn = 2 * np.pi * k / n
    lean = np.full(n, value(effects, "canting", "pyr", MRAD))
    lean += value(effects, "axis-wobble", "wob_c", MRAD) * np.cos(turn)
    lean += value(effects, "axis-wobble", "wob_s", MRAD) * np.sin(turn)
    tilts = effects.get("facet-tilts", {})
    if any(number for key, number in tilts.items() if key != "tilt_rms"):
        if tilts.get("tilt_rms"):
            raise BenchsimError(
                f"{recording.path}: [effects.facet-tilts]: give tilt_rms or the facets' own tilts, not both"
            )
        lean += [MRAD * tilts.get(f"tilt_{i}", 0.0) for i in k]
    else:
        lean += draw_tilts(value(effects, "facet-tilts", "tilt_rms", MRAD), n, recording.render.seed)
    return lean


def disturbed(recording: Recording, placement: Placement) -> tuple[float, Placement]:
    """Distance r of the reflecting surface [mm], and the placement with the mirror's axis and body turned about C."""
    effects = recording.effects
    vector = [value(effects, "axis-tilt", k, MRAD) for k in ("ped_x", "ped_y")]
    vector.append(value(effects, "azimuth-offset", "az_enc", MRAD))
    if any(vector):
        turn = Rotation.from_rotvec(vector).as_matrix()
        placement = replace(placement, axis=turn @ placement.axis, normal=turn @ placement.normal)
    radius = recording.mirror.radius + value(effects, "pivot-offset", "dr")
    if not radius > 0:
        raise BenchsimError(
            f"{recording.path}: [effects.pivot-offset] dr leaves no distance from the axis; give more than "
            f"{-recording.mirror.radius:.3g}"
        )
    return radius, placement


@dataclass(frozen=True)
class Shape:
    """A facet's shape. ``middle`` [rad] is the phase about which δ counts.

    ``lean`` [rad] is that of all facets; ``each`` (facets,) their own beyond it or None; ``field`` the free field's;
    ``curvature`` [1/mm]; ``glass`` [mm].
    """

    middle: Any
    lean: Any
    each: tuple[Any, ...]
    field: Table | None
    curvature: Any
    glass: Any
    coated_behind: bool
    facets: int

    @property
    def differs(self) -> bool:
        """Whether the facets have to be told apart."""
        return bool(self.each) or self.field is not None

    def leaning(self, delta: Any, facet: Any, m: Any) -> Any:
        """Lean of the facet that reflects at a phase [rad]."""
        lean = self.lean + 0.0 * delta
        if self.each:
            # Numbers of facets are whole: one term of the sum is not 0.
            lean = lean + sum(v * m.maximum(0.0, 1.0 - abs(facet - float(k))) for k, v in enumerate(self.each))
        if self.field is not None:
            lean = lean + self.field(self.middle + delta, facet + 0.0 * delta)[0]
        return lean


def shape(recording: Recording, middle: float) -> Shape | None:
    """The facet's shape in a recording; None if it is flat, upright and coated in front."""
    lean = leans(recording)
    glass = value(recording.effects, "second-surface", "glass")
    if glass < 0:
        raise BenchsimError(
            f"{recording.path}: [effects.second-surface] glass = {glass}: give a thickness of 0 or more"
        )
    curvature = value(recording.effects, "facet-curvature", "fcurv", PER_M)
    field = table(recording.fields, "lean")
    mean = float(lean.mean())
    each = tuple((lean - mean).tolist()) if np.ptp(lean) > 0 else ()
    if not lean.any() and not glass and not curvature and field is None:
        return None
    return Shape(middle, mean, each, field, curvature, glass, glass > 0, recording.mirror.facets)


def lift(s: Shape, c1: Any, sine: Any, lean: Any, t: Any, h: Any, m: Any) -> tuple[Vec, Vec, Vec]:
    """A point of the facet less the plane's middle, the change of the normal there, and the facet's own direction of h.

    c1, sine: cos δ − 1 and sin δ. The plane's upright middle normal is (1 + c1, sine, 0); ``lean`` turns it toward
    (0, 0, 1). What is small is kept apart, as everywhere here.
    """
    half = m.sin(0.5 * lean)
    cp1, sp = -2.0 * half * half, m.sin(lean)
    up = (-sp * (1.0 + c1), -sp * sine, 1.0 + cp1)
    change = (cp1 * (1.0 + c1) + c1, (1.0 + cp1) * sine, sp)
    across = (-sine, 1.0 + c1, 0.0)
    # Sphere of curvature c: sag −c (t² + h²)/2 and normal + c (t, h), to the sixth power of c times the facet's side.
    tip = tuple(s.curvature * (t * across[i] + h * up[i]) for i in range(3))
    v2 = dot(tip, tip)
    shrink = v2 * (0.375 * v2 - 0.5)
    normal = (change[0] + 1.0, change[1], change[2])
    sag = -0.5 * s.curvature * (t * t + h * h)
    point = tuple(t * across[i] + h * up[i] + sag * normal[i] for i in range(3))
    tilted = tuple(change[i] + tip[i] + shrink * (normal[i] + tip[i]) for i in range(3))
    return point, tilted, up


def within(g: Vec, normal: Vec) -> tuple[Vec, Any]:
    """How far light goes sideways in glass per depth, as a triple along the face, and the face's reflectance (Snell).

    ``g`` is the direction outside, of any length; ``normal`` unit, against the light.
    """
    length = dot(g, g) ** 0.5
    cosine = -dot(g, normal) / length
    inner = (1.0 - (1.0 - cosine * cosine) / (GLASS * GLASS)) ** 0.5
    scale = 1.0 / (GLASS * inner)
    return tuple(scale * (g[i] / length + cosine * normal[i]) for i in range(3)), fresnel(cosine, inner)


def share(reflected: Any, ghost: Any) -> Any:
    """Part of the light that goes the way in question: twice through the front face, or back from it (ghost 1)."""
    return ghost * reflected + (1.0 - ghost) * (1.0 - reflected) * (1.0 - reflected)


def fresnel(cosine: Any, inner: Any) -> Any:
    """Reflectance of glass for unpolarised light, from the cosines outside and within (Born & Wolf, 1.5.2)."""
    s = (cosine - GLASS * inner) / (cosine + GLASS * inner)
    p = (GLASS * cosine - inner) / (GLASS * cosine + inner)
    return 0.5 * (s * s + p * p)
