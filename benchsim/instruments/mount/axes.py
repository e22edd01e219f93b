"""From readings to where a mount's normal (or tube) points, with every error of the mount as a parameter.

All errors act as the parts do, so that nothing is taken to first order except the flexures. In an ``az-el`` mount they
agree to first order with TPOINT's terms (true less raw, A from north through east)::

    ΔA = IA + CA sec E + NPAE tan E + AN sin A tan E − AW cos A tan E
    ΔE = IE + AN cos A + AW sin A − TF cos E − TX cot E

and with the drift model of Lara-Cerecedo et al. 2016, https://doi.org/10.1155/2016/3158091, Eqs (5)-(7); see `drift`.
In an ``east-west`` mount the normal is R_east(θ₁) R_north(NPAE) R_up(θ₂) (0, −cos CA, sin CA): IE and IA are offsets of
the first and of the second axis, and the first axis is tilted about up and about north. What its file states beside
that, `Mount.tilts` and `Mount.normal`, comes in where ARTIST's rigid body has it (artist-csp 2.0, RigidBody).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from benchsim.instruments.mount.records import Actuator, Array, Mount, toward

Inside = Mapping[str, Array]
"""Parameter name → (T,) values in radians and millimetres; what is left out is 0."""

_ZERO = np.zeros(1)


def turned(vectors: Array, about: tuple[Array, Array, Array]) -> Array:
    """Vectors (..., T, 3) turned by rotation vectors given by components (T,) or (1,) [rad]."""
    some = [k for k, angle in enumerate(about) if angle is not _ZERO and np.count_nonzero(angle)]
    if not some:
        return vectors
    if len(some) == 1:
        # Most turns are about one axis, and a thousand times a fit's step.
        (k,) = some
        i, j, c, s = (k + 1) % 3, (k + 2) % 3, np.cos(about[k]), np.sin(about[k])
        x, y = vectors[..., i], vectors[..., j]
        out = np.empty((*np.broadcast_shapes(x.shape, c.shape), 3))
        out[..., i], out[..., j], out[..., k] = c * x - s * y, s * x + c * y, vectors[..., k]
        return out
    rotation = np.stack(np.broadcast_arrays(*about), axis=-1)
    rotation, flat = (np.array(np.broadcast_to(v, vectors.shape)).reshape(-1, 3) for v in (rotation, vectors))
    return np.asarray(Rotation.from_rotvec(rotation).apply(flat)).reshape(vectors.shape)


def actuator_angle(actuator: Actuator, steps: Array, length: Array, offset: Array, radius: Array) -> Array:
    """Angle of an axis [rad], (T,); errors of the actuator's constants in mm, (T,).

    The angle between the sides of the triangle, acos((o² + r² − L²)/(2 o r)), counts from its value at step 0, where
    the axis stands at its initial angle. nan where no triangle closes.
    """
    o, r = actuator.offset + offset, actuator.radius + radius

    def corner(side: Array) -> Array:
        return np.asarray(np.arccos((o**2 + r**2 - side**2) / (2 * o * r)))

    with np.errstate(invalid="ignore", divide="ignore"):
        now = corner(actuator.stroke + length + steps / actuator.increment)
        start = corner(actuator.stroke + length)
    return actuator.initial_angle + (start - now if actuator.clockwise else now - start)


def pointing(mount: Mount, reading: Array, x: Inside) -> tuple[Array, Array]:
    """Where the normal points, and where the mirror's centre is.

    Parameters
    ----------
    mount : Mount
    reading : (T, 2) array
    x : mapping
        Errors inside: rad and mm.

    Returns
    -------
    normal : (T, 3) array
        Unit vectors.
    centre : (T, 3) array
        [mm]
    """
    return _east_west(mount, reading, x) if mount.axes == "east-west" else _az_el(mount, reading, x)


def _az_el(mount: Mount, reading: Array, x: Inside) -> tuple[Array, Array]:
    azimuth = reading[:, 0] + mount.zero[0] + _of(x, "IA")
    elevation = reading[:, 1] + mount.zero[1] + _of(x, "IE")
    across = toward(azimuth + np.pi / 2, _ZERO * azimuth)
    ahead = toward(azimuth, _ZERO * azimuth)
    normal = toward(azimuth, elevation)
    ca = np.broadcast_to(_of(x, "CA"), azimuth.shape)[:, None]
    normal = normal * np.cos(ca) + across * np.sin(ca)
    npae = _of(x, "NPAE")
    normal = _sagged(turned(normal, tuple(npae * k for k in ahead.T)), x)  # type: ignore[arg-type]
    tilt = (_of(x, "AN"), -_of(x, "AW"), _ZERO)
    arm = mount.joints[2]
    up = np.cross(across, toward(azimuth, elevation))
    reach = mount.joints[:2].sum(axis=0) + arm[0] * across + arm[1] * normal + arm[2] * up
    normal = turned(normal, tilt)
    return normal, mount.position + turned(reach, tilt) + _of(x, "dn")[:, None] * normal


def _east_west(mount: Mount, reading: Array, x: Inside) -> tuple[Array, Array]:
    first, second = (
        (
            actuator_angle(
                a,
                reading[:, k] / (1 + _of(x, f"increment_{k + 1}")) + a.increment * _of(x, f"grown_{k + 1}"),
                *(_of(x, f"{n}_{k + 1}") for n in ("length", "offset", "radius")),
            )
            for k, a in enumerate(mount.actuators)
        )
        if mount.actuators
        else reading.T
    )
    # The second joint's tilt about east adds to the first angle, which turns about east, too.
    first = first + mount.zero[0] + _of(x, "IE") + mount.tilts[2]
    second = second + mount.zero[1] + _of(x, "IA")
    # The normal, and the way from the first joint to the mirror's centre, from the mirror down to the ground.
    both = np.empty((2, len(first), 3))
    both[0] = turned(mount.normal[None], (-_of(x, "CA"), _ZERO, _ZERO))
    # The mirror lies in front of its axes: the arm along "north" is measured against the normal, which is −north.
    both[1] = mount.joints[2] * [1.0, -1.0, 1.0]
    both = turned(both, (_ZERO, _ZERO, second))
    both[1] += mount.joints[1]
    both = turned(both, (_ZERO, _of(x, "NPAE") + mount.tilts[3], _ZERO))
    both = turned(both, (first, _ZERO, _ZERO))
    both[0], both[1] = _sagged(both[0], x), both[1] + mount.joints[0]
    both = turned(both, (_ZERO, _ZERO, mount.tilts[1:2]))
    both = turned(both, (_ZERO, mount.tilts[:1], _ZERO))
    normal, reach = turned(both, (_ZERO, _of(x, "tilt_n"), _of(x, "tilt_u")))
    return normal, mount.position + reach + _of(x, "dn")[:, None] * normal


def _sagged(normal: Array, x: Inside) -> Array:
    """A normal lowered by TF cos E + TX cot E, to first order."""
    tf, tx = _of(x, "TF"), _of(x, "TX")
    if not (tf.any() or tx.any()):
        return normal
    sine = normal[:, 2:]
    toward_zenith = np.array([0.0, 0.0, 1.0]) - normal * sine
    low = np.maximum(np.abs(sine), 0.02) * np.where(sine < 0, -1.0, 1.0)
    bent = normal - (tf[:, None] + tx[:, None] / low) * toward_zenith
    return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True))


def reflected(normal: ArrayLike, source: ArrayLike) -> Array:
    """Direction of travel of light from ``source``, r = −s + 2 n (n · s) (Lara-Cerecedo 2016, Eq. (4)), (..., 3)."""
    n, s = np.asarray(normal, float), np.asarray(source, float)
    return np.asarray(2 * n * np.sum(n * s, axis=-1, keepdims=True) - s)


def _of(x: Inside, name: str) -> NDArray[np.float64]:
    return x.get(name, _ZERO)
