"""Detector arrays around the receiver: heliostats told apart by the rates at which their prisms turn.

Carretero 2019, sections 2 and 4.3: every heliostat carries a turning prism per axis, whose light runs over two arrays
of detectors outside the receiver, at a rate of its own; where a trace crosses the arrays tells how the heliostat is
misaligned. In the order of the light and of the measurement:

1. ``plant``: heliostats, prisms, arrays, and everything that the paper does not print (:class:`Assumptions`);
2. ``signals``: the truth, samples in time from facets that pass;
3. ``labels``, ``noise``: all lines at once by least squares in frequency, and what lies between them;
4. ``response``: a prism's line at every detector by the vector model;
5. ``crossings``, ``misalignment``: where each trace crosses, and the two angles with covariance;
6. ``loop``: corrected and measured again; ``bound``: the least variance that the samples allow.

Derivation, in one screen. Let a misalignment δ turn the heliostat with its prisms. A prism's axis a goes to a + δ × a,
and its light lies on the cone R·a = −S·a. A turn about a itself leaves the cone as it is; a turn by φ about the other
axis moves it, seen from the heliostat, by du = 2 φ cos θ / sin α across the trace, θ the angle of incidence and α the
cone's half-angle. So each trace tells one angle, the other prism's, and tells it wherever it meets an array. The beam
across a trace is the sun's disc: half-width ρ = 4.65 mrad, whatever the distance. A line of amplitude A with noise of
density Σ at n detectors under the beam, each z = a F(u − du) known to √(Σ/T), gives

    σ(φ) ≈ sin α / (2 cos θ) · √(Σ/T) / (A √(Σ_i F'(u_i)²))      (F normalised to 1, F' ~ 1/ρ)

which is what ``misalignment`` reaches and ``bound`` computes from the samples themselves. Far heliostats light more
detectors (n ~ D) with less light (A ~ 1/D²): σ grows as D^1.5.

Where it cannot work is an outcome of its own (``misalignment.OUTCOMES``): labels closer than 1/T; no light, from a
heliostat that would give some wherever it is in range, or from one that may just miss; light of one prism
only; light at the arrays' ends only. What would be noticed by none of these: a beam profile or a tower geometry that is
not as stated.
"""

from benchsim.arrays.bound import bound
from benchsim.arrays.crossings import STATES, Crossing, crossings_of
from benchsim.arrays.labels import Lines, separate, tracked
from benchsim.arrays.loop import Step, close_loop, correction
from benchsim.arrays.misalignment import OUTCOMES, Measurement, from_crossings, measure
from benchsim.arrays.noise import Noise, fit_noise
from benchsim.arrays.plant import ARRAYS, KINDS, Assumptions, Beam, Plant, build, prism, sector
from benchsim.arrays.response import response, sight
from benchsim.arrays.signals import Truth, background, clean, draw_truth, record

__all__ = [
    "ARRAYS",
    "KINDS",
    "OUTCOMES",
    "STATES",
    "Assumptions",
    "Beam",
    "Crossing",
    "Lines",
    "Measurement",
    "Noise",
    "Plant",
    "Step",
    "Truth",
    "background",
    "bound",
    "build",
    "clean",
    "close_loop",
    "correction",
    "crossings_of",
    "draw_truth",
    "fit_noise",
    "from_crossings",
    "measure",
    "prism",
    "record",
    "response",
    "sector",
    "separate",
    "sight",
    "tracked",
]
