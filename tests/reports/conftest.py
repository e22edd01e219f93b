"""A diagnosis and a trial made by hand: a bowed board that six recordings of three settings show, and nine cases."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from chromium import browser  # noqa: F401 -- a fixture of several modules
from PIL import Image

import benchsim as bs
from benchsim.bench.model import Camera
from benchsim.bench.writing import write_text
from benchsim.calibration.record import write_camera
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
from benchsim.reports import page, page_drone, page_trial

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
    """Problem and diagnosis, and the files that the page is made of."""

    problem: Problem
    diagnosis: Diagnosis

    def plain(self, d):
        """``diagnosis.json`` of a diagnosis."""
        more = {"against": "bench", "lost": [], "remarks": [], "defaults_used": []}
        return json.loads(json.dumps({**d.as_dict(), **more}, allow_nan=False))

    def beside(self, d=None, photographs=True):
        """``page.json`` of the diagnosis made by hand: traces that slant through a picture of 400 × 300 px."""
        d = d or self.diagnosis
        r, rows = d.residuals, []
        for b, name in enumerate(self.problem.names):
            at = np.flatnonzero((self.problem.block == b) & (self.problem.kind == "c"))
            s = self.problem.position[at]
            line = np.stack([60 + 0.4 * s, 250 - 0.3 * s], axis=1)
            normal = np.array([0.6, 0.8])
            rows.append(
                {
                    "exposure": name, "setting": self.problem.groups[b], "size_px": [400, 300],
                    "photograph": f"photographs/{b + 1}.jpg" if photographs else None,
                    "same": d.verdict == "nothing-missing",
                    "measured_px": line.tolist(),
                    "before_px": (line - r.before[at, None] * normal).tolist(),
                    "after_px": (line - r.after[at, None] * normal).tolist(),
                    "s_mm": s.tolist(),
                    "residual_mm": {
                        "before": r.before[at].tolist(), "after": r.after[at].tolist(),
                        "held_out_before": r.held_out_before[at].tolist(),
                        "held_out_after": r.held_out_after[at].tolist(),
                    },
                    "sigma_mm": r.sigma[at].tolist(), "sigma_alone_mm": (0.8 * r.sigma[at]).tolist(),
                }
            )  # fmt: skip
        catalogue = [{"name": e.name, "element": e.element, "says": e.says} for e in self.problem.catalogue]
        states = {"before": "as stated", "after": "with what was found"}
        return {
            "format": page.FORMAT, "title": "six", "settings": 3, "states": states,
            "catalogue": catalogue, "exposures": rows,
        }  # fmt: skip


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
    stretches = (Stretch("001.png", 10.0, 120.0, 7.1, "f"), Stretch("003.png", 500.0, 620.0, 5.2, "c"))
    diagnosis = Diagnosis(
        verdict="named",
        effects=(bow,),
        classes=(),
        location=Location("screen", "board y, z", True, 14.2, stretches, {"c": 11.3, "m": 21.4, "w": 0.4}),
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
        (("screen-tilt",), ("tangential-distortion", "drift")),
        0.991,
        SplitBy("observable", "Print marks", 12.0),
        ({"st_y": Size(2.0, 0.1, "mrad"), "IA": Size(-1.0, 0.2, "mrad")}, {}),
        stated=True,
    )
    return {
        "named": d,
        "nothing-missing": replace(d, verdict="nothing-missing", effects=(), location=None, held_out=None),
        "class": replace(d, verdict="class", effects=(), classes=(rivals,)),
        "located": replace(d, verdict="located", effects=()),
        "unexplained": replace(d, verdict="unexplained", effects=(), location=None),
    }


@pytest.fixture(scope="session")
def trial():
    """A trial's score made by hand: three effects, nine cases, a miss and a wrong name among them."""
    effects = ["screen-bow", "canting", "drift"]
    outcomes = ["right", "right", "class", "missed", "wrong", "right", "right", "right", ""]
    cases = [
        {"case": f"c{k:03d}", "kind": "one effect" if o else "clean", "concealed": effects[k % 3] if o else "nothing",
         "said": "nothing missing" if o in ("missed", "") else f"named: {effects[k % 3]}", "cause": o, "size": "",
         "prediction": "right" if o == "right" else "", "snr": 4.0 + 6 * k if o else None, "rival_sigma": None,
         "note": "judged twice" if k == 2 else ""}
        for k, o in enumerate(outcomes)
    ]  # fmt: skip
    said = [*effects, "nothing"]
    return {
        "format": page_trial.FORMAT, "title": "2026-a", "headline": "5 of 8 concealed causes were named.",
        "cases": cases,
        "confusion": {"concealed": said, "said": said, "counts": np.diag([2, 2, 1, 1]).tolist()},
        "reliability": [{"stated": 0.05, "right": 1, "of": 20, "low95": 0.01, "high95": 0.24},
                        {"stated": 0.99, "right": 7, "of": 8, "low95": 0.53, "high95": 0.98}],
        "power": [{"effect": e, "points": [{"snr": 5.0, "named": 1, "of": 3, "low95": 0.06, "high95": 0.79},
                                           {"snr": 40.0, "named": 3, "of": 3, "low95": 0.44, "high95": 1.0}]}
                  for e in effects],
        "bars": [{"quantity": "named on clean cases", "bar": "≤ 2 %", "value": "0 %", "interval": "0 … 30 %", "n": 9,
                  "state": "open"}],
        "ledger": [{"line": k, "time": "2026-01-02T03:04:05+00:00", "what": f"commitment c{k:03d}", "hash": f"{k:064x}"}
                   for k in range(1, 10)],
        "verified": True, "commands": ["benchsim trial run --cases 9 --seed 7"],
    }  # fmt: skip


@pytest.fixture(scope="session")
def plant_pages(tmp_path_factory):
    """Pages of a plant of four by what they are of: as commands write them, and axes read of pictures made by hand."""
    folder = tmp_path_factory.mktemp("plant")
    (folder / "photos").mkdir()
    (folder / "plant.toml").write_text(PLANT, encoding="utf-8")
    rows = [f"H{k},{e},{n},2" for k, (e, n) in enumerate(((0, 150), (10, 151), (-9, 154), (1, 160)), 1)]
    (folder / "heliostats.csv").write_text("\n".join(["id,east_m,north_m,up_m", *rows]))
    places = ["name,east_m,north_m,up_m"]
    for k in range(3):
        Image.fromarray(np.full((48, 64), 90, np.uint8)).save(folder / "photos" / f"{k}.jpg")
        places.append(f"{k}.jpg,{k},400,90")
    (folder / "p.csv").write_text("\n".join(places))
    camera = Camera("A", (64, 48), 100.0, (31.5, 23.5), bit_depth=8, gamma="srgb", saturation_level=255.0)
    lens = folder / "camera.toml"
    write_camera(lens, camera, (1e-4, 0.1, 1e-3), 1e-4 * np.eye(8), photographs=12, marks=300, rms=0.05, board="m.csv")
    names = ("detectors", "record", "drone", "axes", "nothing", "flux", "engines")
    noon, out = "2026-03-21T12:00", {n: folder / n for n in names}
    bs.detectors(folder, out["detectors"], day="2026-03-21", step=3.0, record=noon)
    bs.detectors_read(out["detectors"] / "record.wav", folder, out["record"], at=noon)
    bs.drone(folder, out["drone"], virtual=True)
    bs.drone_read(folder / "photos", folder, out["nothing"], camera=lens, positions=folder / "p.csv")
    bs.flux(folder, out["flux"], day="2026-03-21", step=4.0, cells=10, errors="drawn", rank=True)
    rays = {"engine": "both", "variant": "llvm_ad_mono", "accuracy": 20, "cells": 10}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("benchsim.fluxes.traced.BATCH", 2**12)
        bs.flux(folder, out["engines"], at=noon, **rays)
    out["axes"].mkdir()
    known = {
        "glints": 41, "not_found_in": 2, "outliers": 1, "azimuth_off_mrad": -0.4, "sigma_azimuth_off_mrad": 0.25,
        "elevation_off_mrad": 1.2, "sigma_elevation_off_mrad": 0.21, "sigma_ad_mrad": 0.8,
        "sigma_ad_expected_mrad": 0.7, "sigma_mean_mrad": 0.12, "sigma_sys_mrad": 0.17, "sigma_mrad": 0.21,
        "p_normal": 0.4, "says": "",
    }  # fmt: skip
    lacking = dict.fromkeys(known) | {
        "glints": 2,
        "says": "the heliostat shows 2 glints, fewer than 3: fly finer",
    }
    plain = {
        "heliostats": [{"id": "H1"} | known, {"id": "H2"} | lacking, {"id": "H3"} | known | {"glints": 7}],
        "remarks": ["2 of 9 pictures lie beside the planned pattern."],
    }
    text = "cluster 1: 9 pictures, axes of 2 of 3 heliostats\n" + plain["remarks"][0]
    pictures = {"axes": (out["nothing"] / "axes.png").read_bytes()}
    write_text(out["axes"] / "report.html", page.plant_page(page_drone.read(plain, "Four", text, pictures)))
    return {n: f / "report.html" for n, f in out.items()}


PLANT = """\
format = "benchsim-plant/1"
title = "Four: <b>bold</b>"
[site]
latitude_deg = 37.0
longitude_deg = -2.0
time_zone = "Europe/Madrid"
[[receiver]]
name = "receiver"
centre_m = [0.0, 0.0, 40.0]
width_m = 2.0
height_m = 2.0
[optics]
slope_mrad = 1.0
reflectance = 0.9
[heliostats]
width_m = 3.2
height_m = 2.6
facets = [2, 2]
[errors]
IA_sigma_mrad = 1.0
IE_sigma_mrad = 1.0
[drone]
pitch_m = 0.7
"""
