"""Flux along the trace as a photograph shows it behind effects of camera and print, against the diagnosis' prediction.

Scenario: a lens or a print that is not as stated stretches what is measured on the board. Where it stretches a line
across itself, the line's flux (light per area times mm across) is measured larger by as much.

Set-up: Fig. 7(a) by a camera of half the pixels each way, without noise, everything as stated; the same light is
photographed without the effect and with it near its cap. Both photographs are measured, and each is held against
`problem.build`'s prediction of it, given the effect. Expectation: the two differences are the same along the trace,
within 0.15 % of the flux. Nothing is drawn at random but two million rays, which both photographs share.
"""

from dataclasses import replace

import numpy as np
import pytest

from benchsim.bench.files import read
from benchsim.instruments.bench import observables, problem
from benchsim.renderer import recording as rendering
from benchsim.renderer.irradiance import irradiance


@pytest.fixture(scope="module")
def misfit(small_bench, tmp_path_factory):
    """Function (effects) → places along the trace [mm] and log flux less what is predicted with the effects."""
    bench = read(small_bench, images=False)
    light = irradiance(bench, bench.exposures[0], seed=4, rays=1 << 21)

    def of(own):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rendering, "irradiance", lambda *_, **__: light)
            folder = tmp_path_factory.mktemp("measured")
            rendering.render_recording(
                replace(bench, effects=own), folder, noise=False, setting_errors=False, conceal=True
            )
        stated = read(folder, images=True)
        observed, lost = observables.observe(stated)
        assert not lost
        built = problem.build(stated, observed)
        values = {key: value for table in own.values() for key, value in table.items()}
        flux = built.kind == "f"
        return built.position[flux], (built.data - built.predict(values, 0))[flux]

    return of


@pytest.fixture(scope="module")
def plain(misfit):
    return misfit({})


@pytest.mark.parametrize(
    "own",
    [
        {"grid-scale": {"gs": 10.0}},
        {"radial-distortion": {"k1": 0.1}},
    ],
    ids=str,
)
def test_flux_is_measured_as_predicted(misfit, plain, own):
    """A print that is too large by one factor stretches evenly, which the free gain takes."""
    s, with_it = misfit(own)
    change = with_it - np.interp(s, *plain)
    change -= change.mean()
    print(f"{own}: {1e2 * change.min():.2f} … {1e2 * change.max():.2f} %")
    assert np.abs(change).max() < 1.5e-3
