"""What could be recorded next on the bench, as what it would measure.

Each candidate is simulated like a recording without photographs (`simulation`) and linearised at its stated setting.
What is left untouched keeps its nuisances, which is what makes a repeat or a rolled screen worth more than a new
setting. Where the facets' lines part, they would part in an ungated recording too.

Gated to one facet and then to the opposite one, exposures show how each leans against the mean of all, and how wide a
single line is. By how much a facet leans nobody knows before; what is weighed is what is typical: under facets that
differ at random both lean by one rms, as likely to the same side as not, under a wobble to opposite sides by its
amplitude over √2. Signals are linear in the square of these here, in truth in themselves: for 1 mrad they agree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Recording
from benchsim.diagnosis import linear
from benchsim.diagnosis.problem import Effect, NextRecording, Problem
from benchsim.instruments.bench.facet_lines import as_parted
from benchsim.instruments.bench.observed import Observed

LATER = 2 * 3600.0
"""Time after the last exposure at which a setting is repeated [s]."""

MOVE = 100.0
"""Distance by which the screen is moved toward the mirror [mm]."""

SUNS_DEG = ((101.0, 50.0), (150.0, 30.0), (210.0, 65.0), (260.0, 35.0))
"""Azimuth and elevation of the laser for new settings [deg]."""

OF_MANY = {"tilt_rms": (1.0, 1.0), "wob_c": (0.7, -0.7)}
"""How ungated facets differ: lean of a facet and of the opposite one per mrad, typically."""

ELSEWHERE_DEG = 15.0
"""A sun nearer than this to one that was recorded is nothing new."""


@dataclass(frozen=True)
class Candidate:
    """What could be taken: a sentence, the exposures, the cameras with them, and the kinds that count."""

    kind: str
    what: str
    exposures: tuple[Exposure, ...]
    cameras: dict[str, Camera]
    kinds: str = "cwfgm"


@dataclass(frozen=True)
class Next:
    """``Problem.next_recordings`` of a recording.

    Attributes
    ----------
    recording : Recording
    against : str
    catalogue : tuple of Effect
        Whose amplitudes are wanted.
    build : callable
        `problem.build`.
    simulate : callable
        `simulation.simulate_one`.
    parted : tuple of Observed
        Exposures in which the facets' lines part.
    spread : callable
        ``map`` or a pool's, as `Problem.spread`.
    """

    recording: Recording
    against: str
    catalogue: tuple[Effect, ...]
    build: Callable[..., Problem]
    simulate: Callable[..., Any]
    parted: tuple[Observed, ...] = ()
    spread: Callable[..., Iterable[Any]] = map

    def __call__(self) -> tuple[NextRecording, ...]:
        """All candidates whose trace would meet the board in view of the camera."""
        out = []
        for candidate in candidates(self.recording):
            try:
                out.append(self._one(candidate))
            except BenchsimError:
                # The trace would miss the board, or the camera would not see it: no candidate.
                continue
        return tuple(out)

    def _one(self, c: Candidate) -> NextRecording:
        recording = replace(
            self.recording,
            exposures=(*self.recording.exposures, *c.exposures),
            cameras={**self.recording.cameras, **c.cameras},
        )
        first = len(self.recording.exposures)
        observed = tuple(self.simulate(recording, first + k) for k in range(len(c.exposures)))
        gated = c.exposures[0].facet is not None
        if self.parted and not gated:
            observed = tuple(as_parted(o, self.parted) for o in observed)
        problem = self.build(recording, observed, against=self.against, attached=False)
        problem = replace(problem, spread=self.spread)
        amplitudes = tuple(p for e in self.catalogue for p in e.parameters if not p.grid)
        shapes = {p.name: p.grid[len(p.grid) // 2] for e in self.catalogue for p in e.parameters if p.grid}
        whole = tuple(replace(p, blocks=None) for p in (*problem.nuisances, *amplitudes))
        columns = linear.columns(problem, shapes, whole)
        rows = np.flatnonzero(np.isin(problem.kind, list(c.kinds)))
        n = len(problem.nuisances)
        place = {p.name: n + i for i, p in enumerate(amplitudes)}
        for name, leans in OF_MANY.items() if gated else ():
            if name in place:
                typical = np.array(leans)[problem.block] * (problem.kind == "c")
                columns[:, place[name]] = typical * columns[:, place["pyr"]]
        return NextRecording(
            c.kind,
            c.what,
            block_diag(*problem.covariance)[np.ix_(rows, rows)],
            {p.name: columns[rows, i] for i, p in enumerate(problem.nuisances)},
            {p.name: p for p in problem.nuisances},
            {p.name: columns[rows, n + i] for i, p in enumerate(amplitudes)},
        )


def candidates(recording: Recording) -> tuple[Candidate, ...]:
    """What could be recorded next: repeats, moves of screen and camera, a single facet, new suns."""
    last = max(recording.exposures, key=lambda e: e.time)
    base = replace(last, image=None, dark=None, time=last.time + 60.0)
    out = [
        Candidate(
            "recording",
            f"repeat setting {last.setting} untouched, {LATER / 3600:g} hours later",
            (replace(base, time=last.time + LATER),),
            {},
        ),
        Candidate(
            "recording",
            f"roll the screen by 180° and record setting {last.setting} again, mirror and laser untouched",
            (replace(base, screen_roll=last.screen_roll + np.pi),),
            {},
        ),
        Candidate(
            "recording",
            f"move the screen by {MOVE:g} mm toward the mirror and record setting {last.setting} again, mirror and "
            "laser untouched",
            (replace(base, screen_shift=last.screen_shift + MOVE),),
            {},
        ),
    ]
    if recording.mirror.shape == "polygon" and all(e.facet is None for e in recording.exposures):
        out.append(
            Candidate(
                "recording",
                f"record setting {last.setting} again gated to one facet and then to the opposite one, mirror and "
                "laser untouched",
                (replace(base, facet=0), replace(base, facet=recording.mirror.facets // 2)),
                {},
            )
        )
    name, moved = _moved(recording.cameras[last.camera])
    where = ", ".join(f"{x:.0f}" for x in moved.position)
    out.append(
        Candidate(
            "recording",
            f"photograph setting {last.setting} again with camera {last.camera} moved to ({where}) mm, all else "
            "untouched",
            (replace(base, camera=name),),
            {name: moved},
        )
    )
    out.append(
        Candidate(
            "observable",
            f"photograph the board's marks, laser off, with camera {last.camera} moved to ({where}) mm",
            (replace(base, camera=name),),
            {name: moved},
            "m",
        )
    )
    taken = np.array([[e.laser_azimuth, e.laser_elevation] for e in recording.exposures])
    for azimuth, elevation in np.radians(SUNS_DEG):
        apart = np.hypot(np.cos(elevation) * np.angle(np.exp(1j * (taken[:, 0] - azimuth))), taken[:, 1] - elevation)
        if apart.min() < np.radians(ELSEWHERE_DEG):
            continue
        out.append(
            Candidate(
                "recording",
                f"record a new setting, laser at azimuth {np.degrees(azimuth):.0f}°, elevation "
                f"{np.degrees(elevation):.0f}°, mirror where setting {last.setting} has it",
                (replace(base, setting="next", laser_azimuth=float(azimuth), laser_elevation=float(elevation)),),
                {},
            )
        )
    return tuple(out)


def _moved(camera: Camera) -> tuple[str, Camera]:
    """The camera on the other side of the board's normal, and somewhat higher or lower."""
    x, y, z = camera.position
    name = f"{camera.name} moved"
    position = (x, -y if abs(y) > 50 else y + 400.0, z + (300.0 if z < 0 else -300.0))
    return name, replace(camera, name=name, position=position)
