"""A problem of thirty lines that has everything naming must cope with, and no bench.

A "recording" is a line c(y) on y in [-1, 1] and a width w(y), taken in several settings u. Each setting has an
unknown offset and slope (prior sigma known, times a scale that is not); the width has an unknown gain. Noise: 0.02.
"""

import numpy as np

from benchsim.diagnosis.problem import Effect, Parameter, Problem

Y = np.linspace(-1, 1, 48)
SIGMA = 0.02
SETTINGS = np.array([-1.0, -0.6, -0.1, 0.3, 0.7, 1.0])


def predict(values, block):
    """Lines of one setting: positions, then widths."""
    v, u = (lambda name: values.get(name, 0.0)), SETTINGS[block]
    c = 0.5 * Y**2 + (v(f"s{block}.offset") + v(f"s{block}.slope") * Y) * (1 + 0.1 * v(f"s{block}.offset") * Y)
    c = c + v("bow_1") * Y**2 + v("bow_2") * Y**3
    c = c + v("turn") * u * Y**2 + 0.15 * v("turn") ** 2 * u**2 * Y**3
    c = c + v("glass") * (np.abs(u) * Y**2 - 0.5 * Y**4)
    c = c + v("ripple") * np.sin(2 * np.pi * Y / max(v("period"), 0.1))
    c = c + v(f"tilt_{block % 3}") * np.cos(6 * Y)
    w = np.sqrt((1 + v("gain")) ** 2 * (0.3 + 0.1 * u * Y) ** 2 + v("blur") ** 2 + 0 * Y)
    return np.concatenate([c, w])


NUISANCES = (
    *(Parameter(f"s{b}.{n}", "mm", 0.3, scaled=True, blocks=(b,)) for b in range(6) for n in ("offset", "slope")),
    Parameter("gain", "1", 0.02),
)
CATALOGUE = (
    Effect("bow", "screen", (Parameter("bow_1", "1/m", 0.5), Parameter("bow_2", "1/m", 0.5))),
    Effect("turn", "mirror", (Parameter("turn", "mrad", 0.5),)),
    Effect("glass", "mirror", (Parameter("glass", "mm", 0.5, one_sided=True),)),
    Effect("blur", "time", (Parameter("blur", "mm", 0.2, one_sided=True, power=2),)),
    Effect("ripple", "camera", (Parameter("ripple", "px", 0.3), Parameter("period", "mm", 1, grid=(0.5, 0.7, 0.9)))),
    Effect("tilts", "mirror", tuple(Parameter(f"tilt_{k}", "mrad", 0.3) for k in range(3)), random_field=True),
)
NAMES = tuple(e.name for e in CATALOGUE)


def problem(truth=None, seed=0, sigma=1.0, setting_scale=1.0, correlated=0.0, catalogue=CATALOGUE, predict=predict):
    """A data set and its true values.

    Parameters
    ----------
    truth : mapping
        Values of effects.
    sigma, setting_scale : float
        True over stated.
    correlated : float
        Standard deviation, in stated sigmas, of errors with correlation length 0.2 added to the white ones.
    """
    rng = np.random.default_rng(seed)
    n = len(SETTINGS)
    at = {p.name: rng.normal(0, p.sigma * (setting_scale if p.scaled else 1)) for p in NUISANCES} | dict(truth or {})
    root = np.linalg.cholesky(np.exp(-np.abs(Y[:, None] - Y) / 0.2) + 1e-12 * np.eye(48))
    data = []
    for b in range(n):
        errors = sigma * rng.normal(size=96) + correlated * np.concatenate([root @ rng.normal(size=48) for _ in "cw"])
        data.append(predict(at, b) + SIGMA * errors)
    made = Problem(
        data=np.concatenate(data),
        block=np.repeat(np.arange(n), 96),
        kind=np.tile(np.repeat(["c", "w"], 48), n),
        position=np.tile(np.concatenate([Y, Y]), n),
        stretch=np.tile(np.repeat([0, 1], 48), n),
        covariance=(SIGMA**2 * np.eye(96),) * n,
        names=tuple(f"{b}" for b in range(n)),
        groups=tuple(f"s{b}" for b in range(n)),
        nuisances=NUISANCES,
        catalogue=catalogue,
        predict=predict,
    )
    return made, at
