"""Evidence against the integral that it stands for, by importance sampling with exact predictions.

Scenario: lines are bent, or blurred by so little that half of the posterior of the blur's square lies where there is
none. Sampling knows neither Laplace's method nor the closed form at a boundary.
"""

import pytest
from toy import toy

from benchsim.diagnosis import naming


@pytest.mark.parametrize("truth", [{}, {"bow": 0.05}, {"blur": 0.5}, {"bow": 0.3, "blur": 0.9}])
def test_every_converged_fit_has_the_evidence_that_sampling_gives(script, truth):
    study_search = script("study_search")
    problem = toy(truth, 4)
    found = naming.name(problem)
    fits = [f for f in found.fits if f.converged]
    best = max(f.log_evidence for f in fits)
    asked = [f for f in fits if f.log_evidence > best - 6]
    assert any(set(truth) <= set(f.effects) for f in asked)
    for fit in asked:
        off, count = study_search.sampled(problem, found, fit)
        assert count > 50
        assert abs(off) < 3 / count**0.5, fit.effects
