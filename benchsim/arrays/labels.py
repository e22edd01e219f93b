"""The labels told apart: least squares in frequency.

The converter passes the fundamentals alone, so that a prism is one line at its label f_k, of complex amplitude z_ki at
detector i: y_i(t) = Σ_k Re(z_ki e^{2πi f_k t}) + what is not light of prisms. All z are found at once, by ordinary
least squares of the *differences* of successive samples. Differencing takes away the steady background and makes
flicker, which falls as 1/f², nearly white; between two lines the noise is even, where least squares loses nothing
(Grenander).

Lines closer than 1/T are one line to a record of length T (Rayleigh): their amplitudes are found only to be
taken out, and :attr:`Lines.resolved` is False for them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchsim.arrays.plant import Plant
from benchsim.bench.errors import BenchsimError

Array = NDArray[np.float64]


STRONG = 100.0
"""Power of a line, all detectors together, over its noise's, above which its rate is tracked: its phase is then known
to 0.1 rad, and a weaker one hides below the noise what its rate's error does."""


@dataclass(frozen=True, eq=False)
class Lines:
    """Amplitudes of the labels.

    Attributes
    ----------
    amplitude : (n, 2, m) ndarray of complex
        z of each prism at each detector [the samples' unit].
    gain : (n, 2) ndarray
        Variance of Re z and of Im z over the noise's one-sided density at the label [Hz]: 1/T for a line that stands
        alone.
    resolved : (n, 2) ndarray of bool
    steady : (m,) ndarray
        Mean of each detector's samples.
    remainder : (m, samples − 1) ndarray
        Differences of the samples less those of all lines.
    """

    amplitude: NDArray[np.complex128]
    gain: Array
    resolved: NDArray[np.bool_]
    steady: Array
    remainder: Array


def uneven(lines: Lines, plant: Plant, heliostat: int, kind: int) -> Array:
    """What the detectors' uneven responsivities add to the noise's density (m,) at a label [(W/m²)²/Hz].

    They make a line larger or smaller, in phase with itself, which is how the trace's place shows; in quadrature they
    do nothing, where this is too careful.
    """
    amplitude = np.abs(lines.amplitude[heliostat, kind])
    return np.asarray((plant.gain_spread * amplitude) ** 2 / lines.gain[heliostat, kind])


def differencing(rates: Array, sample_rate: float) -> Array:
    """Power by which differencing multiplies a density at frequencies (...)."""
    return 4 * np.sin(np.pi * rates / sample_rate) ** 2


def separate(samples: Array, plant: Plant) -> Lines:
    """Amplitudes of all labels at all detectors.

    Parameters
    ----------
    samples : (m, samples) array
    plant : Plant

    Raises
    ------
    BenchsimError
        If the samples are not the plant's in number, or not finite.
    """
    if samples.shape != (len(plant.detectors), plant.samples):
        raise BenchsimError(
            f"samples: {samples.shape} are not {len(plant.detectors)} detectors × {plant.samples}; give a whole record"
        )
    if not np.isfinite(samples).all():
        raise BenchsimError("samples: some are not finite; leave out the detector that failed")
    f = plant.rates.ravel()
    angle = 2 * np.pi * f * (np.arange(plant.samples) / plant.sample_rate)[:, None]
    basis = np.diff(np.concatenate([np.cos(angle), -np.sin(angle)], axis=1), axis=0)
    data = np.diff(samples, axis=1)
    # labels that coincide make the matrix singular: the pseudo-inverse shares their light, and they are not resolved
    inverse = np.linalg.pinv(basis.T @ basis, rcond=1e-9, hermitian=True)
    found = inverse @ (basis.T @ data.T)
    remainder = data - (basis @ found).T
    re, im = found[: len(f)], found[len(f) :]
    variances = 0.5 * np.diag(inverse).reshape(2, -1).sum(axis=0)
    gain = variances * differencing(f, plant.sample_rate) * plant.sample_rate / 2
    n = len(plant.heliostats)
    return Lines(
        (re + 1j * im).reshape(n, 2, -1),
        gain.reshape(n, 2),
        _resolved(f, plant.duration).reshape(n, 2),
        samples.mean(axis=1),
        remainder,
    )


def tracked(samples: Array, plant: Plant) -> Plant:
    """The plant with the rates at which its prisms really turned, from how their phases move between a record's halves.

    A quartz errs by 1e-6, which turns a line by 0.01 rad in 20 s: of near heliostats that is far above the noise, in
    their own lines and in their neighbours'. Rates move by a tenth of a line width at most; weak lines keep theirs.

    Parameters
    ----------
    samples : (m, samples) array
    plant : Plant
    """
    half = plant.samples // 2
    part = replace(plant, samples=half)
    early, late = (separate(x, part) for x in (samples[:, :half], samples[:, half : 2 * half]))
    start = half / plant.sample_rate
    moved = late.amplitude * np.exp(-2j * np.pi * plant.rates * start)[..., None]
    joint = np.sum(early.amplitude.conj() * moved, axis=2)
    # Its scatter, from what the lines leave: the density of the differences' remainder, undone at the label.
    density = 2 * np.mean(early.remainder**2, axis=1).sum() / plant.sample_rate
    noise = density * early.gain / differencing(plant.rates, plant.sample_rate)
    found = np.angle(joint) / (2 * np.pi * start)
    sure = (np.abs(joint) > STRONG * noise) & (np.abs(found) * plant.duration < 0.1) & early.resolved
    return replace(plant, rates=plant.rates + np.where(sure, found, 0.0))


def _resolved(rates: Array, duration: float) -> NDArray[np.bool_]:
    """Which labels stand at least 1/T from every other one."""
    order = np.argsort(rates)
    gaps = np.diff(rates[order], prepend=-np.inf, append=np.inf)
    out = np.empty(len(rates), bool)
    out[order] = np.minimum(gaps[:-1], gaps[1:]) * duration >= 1 - 1e-9
    return out
