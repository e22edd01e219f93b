"""A diagnosis made by hand: a bowed board that six recordings of three settings show, and what it looks like."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from benchsim.diagnosis.problem import Effect, Parameter, Problem
from benchsim.diagnosis.result import (
    Class,
    Diagnosis,
    Found,
    HeldOut,
    Limit,
    Location,
    Residuals,
    Size,
    SplitBy,
    Stretch,
)

ELEMENT = {
    "canting": "mirror", "pivot-offset": "mirror", "beam-direction": "source", "astigmatism": "source",
    "window": "air", "air-gradient": "air", "screen-tilt": "screen", "screen-bow": "screen",
    "radial-distortion": "camera", "tangential-distortion": "camera", "drift": "time",
}  # fmt: skip

CATALOGUE = tuple(
    Effect(name, element, (Parameter(f"{name[:3]}_1", "mm", 1.0),), f"What {name} does.", f"Mend {name}.")
    for name, element in ELEMENT.items()
)


@dataclass(frozen=True)
class Made:
    """Problem and diagnosis."""

    problem: Problem
    diagnosis: Diagnosis


def _nothing(values, block):
    return np.zeros(0)


@pytest.fixture(scope="session")
def made():
    """Six exposures, two of each setting; centre line, width, flux and marks."""
    rng = np.random.default_rng(5)
    kinds = {"c": (64, 0.03), "w": (16, 0.02), "f": (16, 0.01), "m": (40, 0.05)}
    names = tuple(f"{k + 1:03d}.png" for k in range(6))
    per = sum(n for n, _ in kinds.values())
    block = np.repeat(np.arange(6), per)
    kind = np.tile(np.repeat(list(kinds), [n for n, _ in kinds.values()]), 6)
    s = np.linspace(0, 620, 64)
    position = np.tile(np.concatenate([s, s[::4], s[::4], np.arange(40.0)]), 6)
    sigma = np.tile(np.concatenate([np.full(n, sd) for n, sd in kinds.values()]), 6)
    noise = sigma * rng.standard_normal(len(sigma))
    signal = np.where(kind == "c", 0.25 * ((position - 310) / 310) ** 2 - 0.08, 0.0) * (1 - 0.3 * (block % 2))
    residuals = Residuals(noise + signal, noise, 1.3 * noise + 1.4 * signal, 1.3 * noise, sigma)
    problem = Problem(
        data=noise,
        block=block.astype(np.intp),
        kind=kind,
        position=position,
        stretch=np.where(kind == "m", -1, 0).astype(np.intp),
        covariance=tuple(np.diag(sigma[block == b] ** 2) for b in range(6)),
        names=names,
        groups=("s1", "s1", "s2", "s2", "s3", "s3"),
        nuisances=(),
        catalogue=CATALOGUE,
        predict=_nothing,
    )
    bow = Found(
        "screen-bow", "screen", 0.99996, "named",
        {"bow_y": Size(0.0312, 0.00091, "1/m"), "bow_z": Size(-0.0121, 0.0013, "1/m")},
        "The board is bent: its surface rises from its plane with the square of y or z.",
        "Put a straightedge across the board, and brace it.",
    )  # fmt: skip
    stretches = (Stretch("001.png", 10.0, 120.0, 7.1), Stretch("003.png", 500.0, 620.0, 5.2))
    diagnosis = Diagnosis(
        verdict="named",
        effects=(bow,),
        classes=(),
        location=Location("screen", "board y, z", True, 14.2, stretches),
        law=None,
        rms={"c": (0.131, 0.031), "w": (0.02, 0.02), "m": (0.05, 0.05)},
        held_out=HeldOut(3, 816, 5120.0, 60.0, 41.0),
        pulls={"s1.mirror_axis_1": 0.3, "s2.laser_azimuth": -3.4},
        limits={name: Limit(f"{name[:3]}_1", 0.37 + 0.1 * k, "mm", name != "window") for k, name in enumerate(ELEMENT)},
        next=(SplitBy("recording", "Roll the screen by 180° and repeat setting s1", 9.4),),
        sigma_scale=1.04,
        correlation=0.0,
        setting_scale=1.0,
        probability={name: 0.99996 if name == "screen-bow" else 0.0021 * (k + 1) for k, name in enumerate(ELEMENT)},
        values={"bow_y": 0.0312, "bow_z": -0.0121},
        residuals=residuals,
    )
    return Made(problem, diagnosis)


@pytest.fixture(scope="session")
def verdicts(made):
    """One diagnosis for each verdict."""
    d = made.diagnosis
    rivals = Class(
        (("screen-tilt",), ("tangential-distortion", "drift")), 0.991, SplitBy("observable", "Print marks", 12.0)
    )
    return {
        "named": d,
        "nothing-missing": replace(d, verdict="nothing-missing", effects=(), location=None, held_out=None),
        "class": replace(d, verdict="class", effects=(), classes=(rivals,)),
        "located": replace(d, verdict="located", effects=()),
        "unexplained": replace(d, verdict="unexplained", effects=(), location=None),
    }
