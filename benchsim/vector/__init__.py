"""The vector model of Carretero et al. 2019, Eqs (1)-(18), in float64.

In the order of the equations: :func:`solar_vector` and :func:`to_tower` (1)-(6); the mirror turning about a line, one
function per source of error (7)-(10); :func:`reflect` (11); :func:`project` (12); the aim (13)-(18) is
:func:`benchsim.bench.place.ideal_normal`.
On the bench: :func:`trace`, the curve on the board, and :func:`trace_conic`, the exact conic of r = 0.

One ray per misalignment, a parallel pencil, no facets, no beam, no diffraction: for those use ``benchsim.rays``.
"""

from benchsim.vector.cone import Cone, TraceConic, bench_cone, cone, section, trace_conic
from benchsim.vector.curve import on_board, trace
from benchsim.vector.cylinder import (
    Cylinder,
    bench_cylinder,
    encoder_offset,
    heliostat_tilt,
    mirror_misalignment,
    positions,
)
from benchsim.vector.reflect import deviation, project, reflect
from benchsim.vector.sun import solar_vector, sun_angles, to_tower, turn_y, turn_z

__all__ = [
    "Cone",
    "Cylinder",
    "TraceConic",
    "bench_cone",
    "bench_cylinder",
    "cone",
    "deviation",
    "encoder_offset",
    "heliostat_tilt",
    "mirror_misalignment",
    "on_board",
    "positions",
    "project",
    "reflect",
    "section",
    "solar_vector",
    "sun_angles",
    "to_tower",
    "trace",
    "trace_conic",
    "turn_y",
    "turn_z",
]
