"""The front face of a second-surface mirror: the faint ridge that it draws, and its pull on the coating's trace."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchsim.bench.centre import influence
from benchsim.bench.curve import Curve, signed_distance
from benchsim.bench.errors import BenchsimError
from benchsim.rays.bench import Bench, nodes_needed
from benchsim.rays.curve import tangents, together
from benchsim.rays.interpolated_trace import FAINT, left_of
from benchsim.rays.phases import axis_points, sample_phases
from benchsim.rays.sweep import cuts
from benchsim.rays.width import widths


def pulled(curve: Curve, ghost: Curve | None) -> Curve:
    """The coating's trace with the pull of the front face's ghost.

    Of two profiles a distance D apart, the second with a share f of the first's light, the mean lies f D/(1 + f) off
    the first's; the centre, which forgets light that is widths away, is pulled as Gaussians of the trace's width would.
    """
    if ghost is None or ghost.flux is None:
        return curve
    assert curve.flux is not None
    d, s = signed_distance(ghost, curve.points)
    way = ghost.arc_length()
    share = np.interp(s, way, ghost.flux) / curve.flux
    share = np.where((s >= 0) & (s <= way[-1]), share, 0.0)
    pull = -d * share / (1 + share)
    points = curve.points + pull[:, None] * left_of(tangents(curve.points))
    if curve.width is None or curve.aside is None:
        return replace(curve, points=points)
    felt = share * curve.width * influence(-d / curve.width, 1.0)[0] / influence(np.zeros(1), 1.0)[1]
    return replace(curve, points=points, aside=curve.aside + felt - pull)


def ghosts(benches: Sequence[Bench], samples: int) -> list[Curve | None]:
    """Ghosts, without widths, of benches that are `batch.alike`; None where they do not meet the board.

    Light that the front face reflects, as if the glass were not there, with Fresnel's reflectance.
    """
    bare = [_bare(bench) for bench in benches]
    out, left = together(bare, samples, width=False, front=True)
    for i in left:
        out[i] = _whole(bare[i], samples, width=False)
    return out


def ghost_of(bench: Bench, samples: int) -> Curve | None:
    """The ghost of one bench with its width, over the part of the board where it has light."""
    return _whole(_bare(bench), samples, width=True)


def _bare(bench: Bench) -> Bench:
    return replace(bench, parts=replace(bench.parts, polygon=replace(bench.parts.polygon, glass=0.0)))


def _whole(bare: Bench, samples: int, *, width: bool) -> Curve | None:
    """From rays at all nodes, wherever along the trace there is light."""
    try:
        phase = sample_phases(bare, samples)
    except BenchsimError:
        return None
    points = axis_points(bare, phase)
    across, along = nodes_needed(bare) if bare.physics.beam else (1, 1)
    start = phase[:, None, None]
    for h in (1, along):
        tangent = tangents(points)
        nodes = cuts(bare, points, tangent, start, across, h, front=True)
        flux = nodes.flux
        bright = flux > FAINT * np.nanmax(flux, initial=0.0)
        if bright.sum() < 4:
            return None
        nodes, points, tangent = nodes.only(bright), points[bright], tangent[bright]
        centre = nodes.mean(nodes.q)
        points, start = points + centre[:, None] * left_of(tangent), nodes.phase
    nodes = nodes._replace(q=nodes.q - centre[:, None, None])
    wide = aside = None
    if width and bare.physics.beam:
        wide, aside = widths(bare, nodes).T
    elif width:
        wide = np.full(len(points), bare.parts.timing.shake)
    return Curve(points, wide, nodes.flux, nodes.mean(nodes.phase), None, aside)
