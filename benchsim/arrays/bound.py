"""The Cramér–Rao bound of a heliostat's misalignment, from the raw samples of the truth's own simulation.

Nothing of the measurement enters: the derivatives are differences of :func:`benchsim.arrays.signals.clean`, samples
in time, and the noise is what :func:`benchsim.arrays.signals.record` adds. With J the derivatives by (ε, φ) and by
each prism's power and phase, Fisher's information is Σ_f 4 J(f)^H Σ(f)⁻¹ J(f) / (samples · rate), over the frequencies
that the converter passes, Σ(f) the noise's one-sided density over the detectors (Whittle: the record long against the
noise's memory at the labels). Known without error in it: the other heliostats' light, the steady background, the rates
and the noise; the flicker of a beam itself, a thousandth of it, is left out. All that makes the bound lower than what
any estimator has to go by.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchsim.arrays.plant import Assumptions, Plant
from benchsim.arrays.signals import Truth, clean, flicker_density, white_level

Array = NDArray[np.float64]

ANGLE_STEP, PHASE_STEP = 5e-5, 3e-4
"""Of the differences [rad]: a fifth of the beam's blur at its rim; a hundredth of a radian of the label's cycle."""


def bound(plant: Plant, assumptions: Assumptions, truth: Truth, steady: Array, heliostat: int) -> Array:
    """Least covariance (2, 2) of an unbiased estimate of a heliostat's (ε, φ) from one record [rad²].

    Parameters
    ----------
    plant, assumptions, truth
    steady : (m,) array
        Background of the detectors [W/m²].
    heliostat : int

    Returns
    -------
    (2, 2) ndarray
        Infinite if the record says nothing of one of the angles.
    """
    k = heliostat

    def light(**changes: Array) -> Array:
        return clean(plant, assumptions, replace(truth, **changes), [k])

    def change(of: Array, at: tuple[int, int], by: float) -> Array:
        out = of.copy()
        out[at] += by
        return out

    columns = []
    for c in range(2):
        up, down = (light(misalignment=change(truth.misalignment, (k, c), s * ANGLE_STEP)) for s in (1, -1))
        columns.append((up - down) / (2 * ANGLE_STEP))
    for kind in range(2):
        alone = truth.transmission.copy()
        alone[k, 1 - kind] = 0.0
        columns.append(light(transmission=alone))
        up, down = (light(transmission=alone, phase=change(truth.phase, (k, kind), s * PHASE_STEP)) for s in (1, -1))
        columns.append((up - down) / (2 * PHASE_STEP))
    f = np.fft.rfftfreq(plant.samples, 1 / plant.sample_rate)
    band = (f > 0.5 * assumptions.rate_low) & (f < 0.4 * plant.sample_rate)
    spectra = np.array([np.fft.rfft(c, axis=1)[:, band] for c in columns])
    kept = np.asarray(f[band], float)
    information = _information(spectra, kept, assumptions, steady) * 4 / (plant.samples * plant.sample_rate)
    lit = np.diag(information) > 0
    if not lit[:2].all():
        return np.full((2, 2), np.inf)
    scale = np.sqrt(np.diag(information)[lit])
    covariance = np.linalg.inv(information[np.ix_(lit, lit)] / np.outer(scale, scale)) / np.outer(scale, scale)
    return np.asarray(covariance[:2, :2])


def _information(spectra: Array, f: Array, assumptions: Assumptions, steady: Array) -> Array:
    """Σ_f J^H Σ⁻¹ J of spectra (q, m, frequencies), with Σ diagonal but for the common flicker."""
    own = white_level(assumptions, steady)[:, None] + steady[:, None] ** 2 * flicker_density(
        assumptions, assumptions.flicker_local, f
    )
    common = flicker_density(assumptions, assumptions.flicker_common, f)
    plain = np.einsum("amf,bmf->ab", spectra.conj() / own, spectra).real
    across = np.einsum("mf,amf->af", steady[:, None] / own, spectra)
    share = common / (1 + common * np.sum(steady[:, None] ** 2 / own, axis=0))
    return np.asarray(plain - np.einsum("af,bf,f->ab", across.conj(), across, share).real)
