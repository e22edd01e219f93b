"""The bench as a plain Mitsuba scene with a spinning mirror: slower than `irradiance` and independent of it.

Geometric optics only, and a pinhole camera without distortion. Every ray is traced on its own through the beam, the
facets at a phase of its own, the board and the camera, by Mitsuba's own shapes and materials; the scene is a file that
plain ``mi.load_file`` and ``mi.render`` can use after ``import benchsim.renderer`` and ``mi.set_variant``.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Camera, Exposure, Mirror, Recording
from benchsim.bench.place import Placement, camera_pose, place
from benchsim.renderer import backend, plugins
from benchsim.renderer.facet import leans
from benchsim.renderer.laser import perpendicular
from benchsim.renderer.mirror import bench
from benchsim.renderer.sweep import sweep

__all__ = ["facet_shapes", "plugins", "render", "rotor_frame", "scene_xml"]

Array = NDArray[np.float64]


DRAWN = frozenset(
    "pivot-offset canting axis-tilt azimuth-offset beam-direction beam-offset "
    "wavefront-curvature screen-distance screen-tilt screen-rotation stage".split()
)
"""Effects and fields of which a scene is made: those that place, turn and focus its shapes. Facets that differ are not
among them, since a scene's phases run over one facet's turn only."""


def _matrix(rotation: Array, origin: Array) -> str:
    full = np.eye(4)
    full[:3, :3], full[:3, 3] = rotation, origin
    return " ".join(f"{x:.12g}" for x in np.round(full, 12).ravel() + 0.0)


def _transform(rotation: Array, origin: Array) -> str:
    return f'<transform name="to_world"><matrix value="{_matrix(rotation, origin)}"/></transform>'


def facet_shapes(mirror: Mirror, radius: float | None = None, lean: float = 0.0) -> list[Array]:
    """Facets in the rotor's frame: 4×4 matrices that take Mitsuba's rectangle, [-1, 1]² facing +z, onto each.

    The axis of rotation is z, facet 0 faces +x. ``radius`` is the facets' distance from it [mm], ``lean`` [rad]
    their normals' lean toward it. Only the facets: what enters by the open ends meets their backs, which
    are black.
    """
    shapes = []
    for k in range(mirror.facets):
        phi = 2 * np.pi * k / mirror.facets
        n = np.array([np.cos(phi), np.sin(phi), 0.0])
        b = np.array([-np.sin(phi), np.cos(phi), 0.0])
        a = np.array([0.0, 0.0, np.cos(lean)]) - np.sin(lean) * n
        shape = np.eye(4)
        shape[:3, 3] = (mirror.radius if radius is None else radius) * n
        n = np.cos(lean) * n + np.array([0.0, 0.0, np.sin(lean)])
        shape[:3, :3] = np.stack([b * mirror.facet_width / 2, a * mirror.height / 2, n], axis=1)
        shapes.append(shape)
    return shapes


def rotor_frame(placement: Placement) -> tuple[Array, Array]:
    """Rotation and origin that take the rotor at phase 0 into the world: z the axis, x facet 0's normal."""
    a, n = placement.axis, placement.normal
    return np.stack([n, np.cross(a, n), a], axis=1), placement.centre


def _laser(recording: Recording, placement: Placement) -> str:
    d = placement.laser_direction
    u, v = perpendicular(d)
    laser = recording.laser
    return f"""  <emitter type="benchsim_laser">
    {_transform(np.stack([u, v, d], axis=1), placement.laser_point)}
    <float name="beam_diameter" value="{laser.beam_diameter:.12g}"/>
    <float name="curvature" value="{laser.curvature:.12g}"/>
    <float name="incoherent_divergence" value="{laser.incoherent_divergence:.12g}"/>
  </emitter>"""


def _sensor(camera: Camera) -> str:
    rotation, t = camera_pose(camera)
    # Mitsuba's camera has x to the left, y up, z forward.
    frame = (np.diag([-1.0, -1.0, 1.0]) @ rotation).T
    width, height = camera.resolution
    fov = np.degrees(2 * np.arctan(width / 2 / camera.focal))
    cx, cy = ((p + 0.5) / size - 0.5 for p, size in zip(camera.principal_point, camera.resolution, strict=True))
    return f"""  <sensor type="perspective">
    {_transform(frame, -rotation.T @ t)}
    <string name="fov_axis" value="x"/>
    <float name="fov" value="{fov:.12g}"/>
    <float name="principal_point_offset_x" value="{cx + 0.0:.12g}"/>
    <float name="principal_point_offset_y" value="{cy + 0.0:.12g}"/>
    <float name="near_clip" value="10"/>
    <float name="far_clip" value="100000"/>
    <sampler type="independent"><integer name="sample_count" value="64"/></sampler>
    <film type="hdrfilm">
      <integer name="width" value="{width}"/>
      <integer name="height" value="{height}"/>
      <string name="pixel_format" value="luminance"/>
      <string name="component_format" value="float32"/>
      <rfilter type="box"/>
    </film>
  </sensor>"""


def _board(recording: Recording, placement: Placement) -> str:
    w, h = recording.screen.size
    front, ey, ez = placement.screen_rotation.T
    frame = np.stack([ey * w / 2, ez * h / 2, front], axis=1)
    return f"""  <shape type="rectangle">
    {_transform(frame, placement.screen_origin)}
    <bsdf type="diffuse"><spectrum name="reflectance" value="{recording.screen.reflectance:.12g}"/></bsdf>
  </shape>"""


def scene_xml(recording: Recording, exposure: Exposure) -> str:
    """One exposure of a bench as a Mitsuba scene file.

    The picture is the board's radiance per unit of laser power [1/(mm² sr)], averaged over one revolution, in the dark
    and without the board's marks.

    Parameters
    ----------
    recording : Recording
    exposure : Exposure

    Returns
    -------
    str
        XML. ``mi.load_string`` takes it as it stands.

    Raises
    ------
    BenchsimError
        If the recording has effects or fields beyond ``DRAWN``, or no facets, or no light reaches the board.
    """
    mirror = recording.mirror
    if mirror.shape != "polygon" or not recording.physics.facets or not recording.physics.beam:
        raise BenchsimError(f"{recording.path}: a Mitsuba scene needs a polygon, facets = true and beam = true")
    where = place(mirror, exposure)
    for name in (*recording.effects, *recording.fields):
        if name not in DRAWN:
            raise BenchsimError(f"{recording.path}: {name} is not drawn as a Mitsuba scene; take it out of the file")
    s = sweep(recording, exposure, where)
    stands = bench(recording, exposure, where)
    recording, where = stands.recording, stands.placement
    reach = s.half_range + abs(s.shear) * mirror.facet_width / 2
    pitch = 2 * np.pi / mirror.facets
    half = min(reach, pitch / 2)
    # Within one pitch of phases one facet at a time is where facet 0 is here; the others are there in their turn.
    weight = 2 * half / pitch / (1 if exposure.facet is None else mirror.facets)
    facets = "\n".join(
        f"""    <shape type="rectangle">
      {_transform(m[:3, :3], m[:3, 3])}
      <bsdf type="conductor"><string name="material" value="none"/></bsdf>
    </shape>"""
        for m in facet_shapes(mirror, stands.radius, float(leans(recording).mean()))
    )
    return f"""<!-- {recording.title}: written by benchsim.renderer.reference.scene_xml; lengths in mm -->
<scene version="3.0.0">
  <integrator type="benchsim_spinning_mirror">
    {_transform(*rotor_frame(where))}
    <float name="phase_min" value="{s.middle - half:.12g}"/>
    <float name="phase_max" value="{s.middle + half:.12g}"/>
    <float name="weight" value="{weight:.12g}"/>
{facets}
  </integrator>
{_sensor(recording.cameras[exposure.camera])}
{_laser(recording, where)}
{_board(recording, where)}
</scene>
"""


def render(xml: str, *, samples: int, seed: int) -> Array:
    """Render a scene of `scene_xml`: (rows, columns) ndarray."""
    backend.use()
    scene: Any = mi.load_string(xml)
    picture = mi.render(scene, spp=samples, seed=mi.UInt32(seed))
    return np.array(picture, dtype=float).reshape(picture.shape[:2])
