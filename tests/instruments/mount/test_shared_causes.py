"""What heliostats share: by integration where that can be done, and in fields that other code made.

Rationale: a mirror and a target that stand elsewhere look alike to one heliostat; a field tells them apart, and must
not be led by one whose days went wrong.
"""

import numpy as np
import pytest
from scipy.special import logsumexp

from benchsim.diagnosis.evidence import log_prior
from benchsim.diagnosis.problem import Parameter
from benchsim.instruments.mount import paint, shared_causes
from benchsim.instruments.mount.field_likelihood import OWN, Witness
from benchsim.instruments.mount.shared_causes import Cause, joint

CLOCK = Cause("clock", "A clock.", (("dt", "clock", "dt", 1.0),))
SECOND = (Parameter("dt", "s", 10.0),)


def witness(name, value, sigma, *, z=0.0, own=None):
    """A heliostat that measures a shared number, in prior sigmas, with one set of effects of its own."""
    precision = sigma**-2.0
    # What the cause would explain of it alone: the integral over the unit prior, in closed form.
    alone = 0.5 * (precision * value) ** 2 / (1 + precision) - 0.5 * np.log1p(precision)
    return Witness(
        name, ((),), np.array([z]), np.array([[precision * value]]), np.array([[[precision]]]),
        max(alone, 0.0) + z if own is None else own,
    )  # fmt: skip


def test_the_evidence_of_a_cause_is_the_integral_over_it():
    """Five heliostats that agree and one that does not, integrated on a fine grid over the cause."""
    many = [witness(str(k), 0.8 + 0.05 * k, 0.2) for k in range(5)] + [witness("astray", -2.0, 0.1)]
    found = joint(many, (CLOCK,), SECOND)
    s = np.linspace(-6, 6, 200_001)
    log = -0.5 * s**2 - 0.5 * np.log(2 * np.pi)
    for w in many:
        own = w.log_z[0] + w.projection[0, 0] * s - 0.5 * w.gram[0, 0, 0] * s**2
        log = log + np.logaddexp(np.log1p(-OWN) + own, np.log(OWN) + w.own)
    with_it = logsumexp(log) + np.log(s[1] - s[0]) + log_prior(("clock",), ["clock"])
    without = sum(np.logaddexp(np.log1p(-OWN) + w.log_z[0], np.log(OWN) + w.own) for w in many)
    without += log_prior((), ["clock"])
    probability = np.exp(with_it - np.logaddexp(with_it, without))
    assert found.shared[0].probability == pytest.approx(probability, abs=0.01)
    weight = np.exp(log - logsumexp(log))
    assert found.shared[0].values["dt"] == pytest.approx(10 * (weight @ s), abs=0.2)
    assert found.shared[0].sigma["dt"] == pytest.approx(10 * np.sqrt(weight @ (s - weight @ s) ** 2), rel=0.1)
    assert found.shared[0].witnesses == 5


def test_no_heliostat_outvotes_the_others():
    """One that is sure beyond measure of something else moves ln of the likelihood by 3 at most: so it changes nothing
    that five others say."""
    five = [witness(str(k), 0.8, 0.2) for k in range(5)]
    alone = joint(five, (CLOCK,), SECOND).shared[0]
    beside = joint([*five, witness("sure", -3.0, 1e-3)], (CLOCK,), SECOND).shared[0]
    assert beside.values["dt"] == pytest.approx(alone.values["dt"], abs=0.01)
    assert beside.witnesses == alone.witnesses == 5


def test_two_heliostats_say_nothing_of_a_field():
    assert joint([witness("a", 0.8, 0.01), witness("b", 0.8, 0.01)], (CLOCK,), SECOND).shared == ()


def test_what_each_has_for_itself_is_not_shared():
    """Twelve that are each sure of another number: of those, three or four agree by chance in every second field."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        scattered = [witness(str(k), float(rng.normal()), 0.02) for k in range(12)]
        assert joint(scattered, (CLOCK,), SECOND).shared == ()


@pytest.mark.parametrize(("size", "said"), [(0.4, False), (2.0, True)])
def test_what_no_heliostat_feels_is_not_said_of_a_thousand(size, said):
    """All agree on a number that each knows to one prior sigma; four tenths of one would stand out by twelve sigma."""
    rng = np.random.default_rng(9)
    many = [witness(str(k), float(rng.normal(size)), 1.0) for k in range(1000)]
    assert bool(joint(many, (CLOCK,), SECOND).shared) == said


@pytest.mark.parametrize("what", ["target", "tower", "clock", "refraction", "camera"])
def test_a_shared_cause_is_found_in_a_field_that_other_code_made(script, tmp_path, what):
    """Fourteen heliostats with errors of their own, records off by 1 mrad, days by 0.3; the sizes within 4 sigma
    (a false alarm in 3000 for six numbers), and nothing beside what was concealed."""
    script("field_made").make(tmp_path, 14, 24, 21, [what])
    found, truth = script("field_study").joined(tmp_path)
    assert [s.cause.name.split()[0] for s in found.shared] == [what]
    (one,) = found.shared
    assert one.probability > 0.99 and one.witnesses >= 7
    for name, value in one.values.items():
        # The targets of a tower that moved all moved alike; to the north nothing did.
        true = truth.get(name, truth.get(f"target_{name[-1]}_1", 0.0) if what == "tower" else 0.0)
        assert abs(value - true * (1e3 if one.units[name] == "mm" else 1.0)) < 4 * one.sigma[name]


def test_a_field_that_shares_nothing_has_no_shared_cause(script, tmp_path):
    script("field_made").make(tmp_path, 14, 24, 22, ["none"])
    assert script("field_study").joined(tmp_path)[0].shared == ()


def test_what_is_shared_is_stated_for_every_heliostat(script, tmp_path):
    script("field_made").make(tmp_path, 1, 6, 3, ["none"])
    session = paint.read(next(p for p in tmp_path.iterdir() if p.is_dir()))
    tower = next(c for c in shared_causes.causes(session.mount, session.records) if c.name == "tower")
    shared = shared_causes.Shared(
        tower, 1.0, {"tower_e": 100.0, "tower_n": 0.0, "tower_u": -50.0}, {}, dict.fromkeys(("tower_e",), "mm"), 9
    )
    effects = shared_causes.applied(session, [shared]).effects
    assert effects == {"mirror-position": {"mirror_e": -100.0, "mirror_n": 0.0, "mirror_u": 50.0}}
