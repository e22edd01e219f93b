"""A generator and a judge for tests of the trial's machinery: pictures of a few pixels whose level is the effect.

They share no code with each other but the level's meaning, and the judge is wrong where noise makes him so.
"""

import json
import os
import time
from pathlib import Path

import cv2
import numpy as np

from benchsim.trial.hashing import rng_of

LEVELS = {"canting": 3000, "screen-bow": 6000, "drift": 9000, "dent": 12000}
ELEMENT = {"canting": "mirror", "screen-bow": "screen", "drift": "time", "dent": "screen"}


def certificate(plan):
    return {"passed": True, "rays": [1, 2]}


def make(plan, number, folder):
    """Two pictures of noise on the level of what is concealed; noise as `cases.noise`, louder in some cases."""
    rng = rng_of(plan.seed, number, "fake")
    kind, design = plan.kinds[number - 1], plan.designs[number - 1]
    effects, stranger = {}, ""
    if kind == "stranger":
        stranger = "dent"
    elif kind == "removed":
        effects = {plan.withheld[0]: {"size": 1.0}}
    elif not kind.startswith("clean"):
        effects = {str(rng.choice(["canting", "screen-bow", "drift"])): {"size": float(rng.uniform(1, 2))}}
    name = stranger or next(iter(effects), None)
    level = 0 if plan.zero or name is None else LEVELS.get(name, LEVELS["dent"])
    spread = float(rng.uniform(20, 900))
    for k in range(1 + (design == "six")):
        counts = 20000 + level + spread * rng.standard_normal((9, 12))
        cv2.imwrite(str(folder / f"{k + 1:03d}.png"), counts.astype(np.uint16))
    (folder / "recording.toml").write_text('format = "benchsim-recording/1"\n')
    snr = {} if name is None else {name: 0.0 if plan.zero else level / spread}
    return {
        "case": f"{number:03d}", "kind": kind, "design": design, "zero": plan.zero, "effects": effects,
        "stranger": stranger, "fields": {}, "setting_scale": 1.0, "noise": {"spread": spread}, "seed": 0,
        "element": "" if name is None else ELEMENT.get(name, "screen"), "snr": snr,
        "rival": {"effects": ["drift"], "separation_sigma": 9.0} if effects else None,
    }  # fmt: skip


def diagnosis(name=None, *, verdict=None, classes=(), location=None, value=1.5, sigma=0.3, held_out=None, law=None):
    """``diagnosis.json`` with what the score reads."""
    named = [] if name is None else [name]
    return {
        "format": "benchsim-diagnosis/1",
        "verdict": verdict or ("named" if named else "class" if classes else "nothing-missing"),
        "effects": [{"name": n, "parameters": {"size": {"value": value, "sigma": sigma, "unit": "mm"}}} for n in named],
        "classes": [{"members": [list(m) for m in c]} for c in classes],
        "location": location and {"element": location, "claimed": True},
        "law": law,
        "fit": {"held_out": held_out},
        "probability": {n: 0.999 if n in named else 0.001 for n in ("canting", "screen-bow", "drift")},
    }


def diagnose(recording, folder, target, withheld, seconds=0.0, marks=None):
    """Name the nearest level; ``marks``: a folder in which every beginning is noted by the process's number."""
    if marks is not None:
        (Path(marks) / f"{os.getpid()}-{Path(recording).name}-{time.time_ns()}").touch()
    time.sleep(seconds)
    counts = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted(Path(recording).glob("*.png"))]
    level = float(np.mean([c.mean() for c in counts])) - 20000
    name = min({None: 0, **LEVELS}.items(), key=lambda item: abs(item[1] - level))[0]
    found = diagnosis(location="screen", verdict="located") if name == "dent" else diagnosis(name)
    (folder / "diagnosis.json").write_text(json.dumps(found))
