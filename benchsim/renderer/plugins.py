"""Mitsuba plugins of the bench: the emitter ``benchsim_laser`` and the integrator ``benchsim_spinning_mirror``.

Mitsuba binds a plugin's class to the variant that is set while the class is made and forgets it when the variant
changes, so they are made in `register`, which runs whenever a variant is set. Lengths are in mm, as everywhere.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchsim.bench.errors import BenchsimError

STANDOFF = 50.0
"""How far before its reference plane a ray of the laser starts [mm]: outside the mirror, near enough to be precise."""


def _to_world(props: Any) -> Any:
    if "to_world" not in props:
        return mi.Transform4f()
    return mi.Transform4f(np.array(props["to_world"].matrix, dtype=np.float32))


def _laser() -> type:
    class Laser(mi.Emitter):
        """Homocentric Gaussian beam of unit power.

        Parameters of the plugin: ``to_world`` (its origin is where the diameter holds, its z axis the direction of
        travel), ``beam_diameter`` (1/e², mm), ``curvature`` (of the wavefront there, 1/mm, > 0 diverging),
        ``incoherent_divergence`` (full 1/e² angle, rad).
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.sigma = float(props.get("beam_diameter", 10.0)) / 4
            self.curvature = float(props.get("curvature", 0.0))
            self.blur = float(props.get("incoherent_divergence", 0.0)) / 4
            self.frame = _to_world(props)
            self.m_flags = mi.EmitterFlags.DeltaDirection | mi.EmitterFlags.SpatiallyVarying
            self.m_needs_sample_2 = self.m_needs_sample_3 = True

        def sample_ray(self, time: Any, sample1: Any, sample2: Any, sample3: Any, active: Any = True) -> Any:
            # The density exp(-2 ρ²/w²) has the standard deviation w/2 in one direction, and w is half the diameter.
            rho = self.sigma * mi.warp.square_to_std_normal(sample2)
            slope = self.curvature * rho + self.blur * mi.warp.square_to_std_normal(sample3)
            origin = mi.Point3f(rho.x - STANDOFF * slope.x, rho.y - STANDOFF * slope.y, -STANDOFF)
            direction = mi.Vector3f(slope.x, slope.y, 1.0)
            ray = mi.Ray3f(self.frame @ origin, dr.normalize(self.frame @ direction), time)
            return ray, dr.select(active, mi.Spectrum(1.0), 0.0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Spectrum(0.0)

        def bbox(self) -> Any:
            return mi.ScalarBoundingBox3f()

        def to_string(self) -> str:
            return f"benchsim_laser[sigma={self.sigma}, curvature={self.curvature}]"

    return Laser


def _spinning_mirror() -> type:
    class SpinningMirror(mi.AdjointIntegrator):
        """Particle tracer in which every ray meets the mirror at a phase of its own, and then the scene and the camera.

        The shapes nested in the integrator are the rotor, in its own frame: the axis of rotation is z. They make a
        scene of their own, which a ray enters turned back by the phase. What misses the rotor is dropped; what it
        reflects falls on the scene's surfaces, of which one diffuse scattering is seen by the camera.

        Parameters of the plugin: ``to_world`` (of the rotor at phase 0), ``phase_min`` and ``phase_max`` (rad; the
        phases sampled) and ``weight`` (power of all rays: the fraction of a revolution that the phases stand for).
        """

        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.frame = _to_world(props)
            self.inverse = self.frame.inverse()
            self.phase_min = float(props.get("phase_min", 0.0))
            self.phase_max = float(props.get("phase_max", 2 * dr.pi))
            self.weight = float(props.get("weight", 1.0))
            shapes = {k: v for k, v in props.objects() if isinstance(v, mi.Shape)}
            if not shapes:
                raise BenchsimError("benchsim_spinning_mirror holds no shape; nest the rotor's shapes in <integrator>")
            self.rotor = mi.load_dict({"type": "scene", **shapes})

        def sample(self, scene: Any, sensor: Any, sampler: Any, block: Any, sample_scale: Any) -> None:
            phase = dr.lerp(self.phase_min, self.phase_max, sampler.next_1d())
            ray, power, _ = scene.sample_emitter_ray(
                0.0, sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), mi.Bool(True)
            )
            sine, cosine = dr.sincos(phase)

            def turn(v: Any, s: Any) -> Any:
                return type(v)(cosine * v.x - s * v.y, s * v.x + cosine * v.y, v.z)

            into = mi.Ray3f(turn(self.inverse @ ray.o, -sine), turn(self.inverse @ ray.d, -sine))
            mirror = self.rotor.ray_intersect(into)
            active = mirror.is_valid()
            context = mi.BSDFContext(mi.TransportMode.Importance)
            reflected, share = mirror.bsdf().sample(
                context, mirror, sampler.next_1d(active), sampler.next_2d(active), active
            )
            power = power * share * self.weight
            active &= dr.max(power) > 0
            out = mirror.spawn_ray(mirror.to_world(reflected.wo))
            out = mi.Ray3f(self.frame @ turn(out.o, sine), self.frame @ turn(out.d, sine))

            hit = scene.ray_intersect(out, active)
            active &= hit.is_valid()
            view, importance = sensor.sample_direction(hit, sampler.next_2d(active), active)
            active &= view.pdf > 0
            active &= ~scene.ray_test(hit.spawn_ray_to(view.p), active)
            scattered = hit.bsdf().eval(context, hit, hit.to_local(view.d), active)
            block.put(
                pos=view.uv + block.offset(),
                wavelengths=out.wavelengths,
                value=sample_scale * power * importance * scattered,
                alpha=1.0,
                weight=0.0,
                active=active,
            )

        def to_string(self) -> str:
            return f"benchsim_spinning_mirror[{self.rotor}]"

    return SpinningMirror


def register(_previous: str | None = None, variant: str | None = None) -> None:
    """Make and register the plugins for the variant that is set."""
    name = variant or mi.variant()
    if name is not None and name.startswith(("llvm_", "cuda_")):
        mi.register_emitter("benchsim_laser", _laser())
        mi.register_integrator("benchsim_spinning_mirror", _spinning_mirror())


register()
mi.detail.add_variant_callback(register)
