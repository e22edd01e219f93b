"""The data of one exposure: what the prediction needs of it, and what it makes of a trace as it is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchsim.bench.curve import Curve, signed_distances
from benchsim.instruments.bench.observed import Observed

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Response:
    """How an adaptive width behind the camera's blur follows the one that `rays` works out behind one ``blur`` [mm].

    w² = at + slope (w_rays² − near) + by_blur (b² − b₀²); (k,) each, mm² or 1; (0,) where there are no widths. The blur
    is part of what `rays` works out because lines that part, stretch or shake change a sharp profile's adaptive width
    otherwise than a blurred one's; the slopes are for what differs along the trace. The centre lies
    a_rays + aside + aside_by_blur (b² − b₀²) to the left of the mean of the light; (n,) each, mm or 1/mm, and
    ``blurred`` is b₀² there [mm²].
    """

    blur: float
    at: Array
    near: Array
    slope: Array
    by_blur: Array
    aside: Array
    aside_by_blur: Array
    blurred: Array


@dataclass(frozen=True)
class Block:
    """One exposure as the prediction needs it.

    Attributes
    ----------
    observed : Observed
    setting : 13 str
        Names of its setting errors among the nuisances, in the order of `settings.NAMES`; "": free of error.
    response : Response or None
        None where lines part: their parting is in the place of width and flux, and their mean is that of all light.
    level : (samples,)
        Peak brightness along the stated trace, 1 at the brightest measured.
    kept : (m,) bool
        Marks whose residuals are data.
    offset : (n,) mm
        c₀: signed distance of the reference points from the stated bench's curve.
    """

    observed: Observed
    setting: tuple[str, ...]
    response: Response | None
    level: Array
    kept: NDArray[np.bool_]
    offset: Array

    @property
    def camera(self) -> str:
        return self.observed.view.camera.name

    @property
    def shaped(self) -> bool:
        """Whether width and flux are data."""
        return len(self.observed.width2) > 0


class Seen(NamedTuple):
    """A trace as it is measured: (samples, 2) mm, the marks' residuals (m, 2) px, the curve on the true board, and by
    what it is stretched across."""

    values: Mapping[str, float]
    block: Block
    points: Array
    residual: Array
    curve: Curve
    stretch: Array | float


def across(curve: Curve, b: Block, stretch: Array | float) -> Array:
    """Square of a curve's width behind the blur, as the marks have it stretched [mm²]."""
    assert b.response is not None and curve.width is not None
    # The camera's blur is not on the board: it is as wide as it was.
    own = b.response.blur**2
    return np.asarray((curve.width**2 - own) * np.square(stretch) + own)


def size(b: Block) -> int:
    """Number of data of a block."""
    o = b.observed
    return len(o.points) + len(o.width2) + len(o.log_flux) + len(o.parting) + 2 * int(b.kept.sum())


def data(seen: Sequence[Seen]) -> list[Array]:
    """The data of measured curves of equal length, held against as many points each, of blocks with a response each or
    none."""
    points = np.stack([s.points for s in seen])
    marks = [s.residual[s.block.kept].ravel() for s in seen]
    targets = np.stack([s.block.observed.points for s in seen])
    if len(seen[0].block.observed.parting):
        apart = np.stack(
            [
                np.zeros(len(p)) if s.curve.parting is None else s.curve.parting
                for s, p in zip(seen, points, strict=True)
            ]
        )
        distance, _, at = signed_distances(points, targets, apart[..., None])
        assert at is not None
        return [
            np.concatenate([s.block.offset - d, here[:, 0], m])
            for s, d, here, m in zip(seen, distance, at, marks, strict=True)
        ]
    light: Array = np.zeros((*points.shape[:2], 3))
    for row, s in zip(light, seen, strict=True):
        assert s.curve.flux is not None
        if s.curve.aside is not None:
            row[:, 0] = s.curve.aside * s.stretch
        if s.block.shaped:
            row[:, 1] = across(s.curve, s.block, s.stretch)
            row[:, 2] = np.log(np.maximum(s.curve.flux * s.stretch, 1e-30))
    profiles = np.stack([s.block.observed.profile_points for s in seen])
    distance, _, at = signed_distances(points, np.concatenate([targets, profiles], axis=1), light)
    assert at is not None
    n = targets.shape[1]
    out = []
    for s, d, here, m in zip(seen, distance, at, marks, strict=True):
        o, r = s.block.observed, s.block.response
        assert r is not None
        blur = s.values.get(f"{s.block.camera}.blur", 0.0)
        more = (1 + blur) ** 2 - 1
        centre = s.block.offset - d[:n] + here[:n, 0] + r.aside + r.aside_by_blur * (more * r.blurred)
        if not s.block.shaped:
            out.append(np.concatenate([centre, m]))
            continue
        wide = r.at + r.slope * (here[n:, 1] - r.near) + r.by_blur * (more * (o.blur * o.mm_per_px) ** 2)
        # Its level is the gain's alone: whatever of it geometry could change, quadratically, would only be undone.
        flux = here[n:, 2]
        flux = flux - flux.mean() + s.values.get(f"{o.name}.gain", 0.0)
        out.append(np.concatenate([centre, wide, flux, m]))
    return out
