"""The levels of decision: from where on something is told apart, said, claimed, or changes the verdict.

All are stated with what they trade. Sigma are of noise as it was estimated, margins are differences of ln Z. How fine a
grid is, how many steps a fit may take and how much is tried stand where they are used: they cost time, or accuracy
that is stated there.
"""

import numpy as np

APART = 3.0
"""Sigma by which hypotheses have to differ to be told apart, and a model to predict better to be said to. Nothing names
right more often than Φ(d/2) at distance d, 93 % here; at 4 sigma, 98 %, twice as many pairs would end as classes."""

COST = 0.5 * APART**2
"""What that distance costs in ln Z."""

AS_WELL = 1.0
"""Sigma within which a simpler model predicts as well: a needless amplitude passes it in one of six cases, one that
stands out by 8 sigma fails it in one of four hundred."""

SURE, LIKELY = 0.99, 0.9
"""Probabilities at which an effect is named, and is probable."""

MISSING = float(np.log(SURE / (1 - SURE)))
"""ln Z at which something shows that something is missing."""

ALARM = 1 - SURE
"""Rate of false alarms at which something is said to be left, and of stretches of a trace where it lies."""

SUSPECTED = 1 / 3
"""Probability of an effect that is not claimed from which on it is an open alternative to nothing."""

UNSURE = 0.05
"""Probability of setting errors from which on nothing is said to be missing: of clean sets whose settings 24 numbers
tell, 0.7 % are left open by it, of those that 12 tell 6 %."""

MARGIN = 3.0
"""ln Z by which a name has to lead over functions, or a term to be worth it, and that a fit may still promise if names
are to rest on it."""

CLAIM = 8.0
"""ln Z over every other element at which one is claimed: how long and how rough functions are is only guessed, which
makes some of it."""

PATCH = 0.4
"""Part of what the best function gains over nothing that names have to add to it to count beside it: less may make up
for what a function of finite resolution, taken to first order, leaves of a large misfit. Of names beside something that
has none it costs about a quarter; at 0.2 a ripple of 64 sigma had a plume in it."""

LEFT = 0.05
"""Part of what the names removed, or of a misfit that is placed, that may be left without changing the verdict: what
stands for nearly all may be right beside a model that is not perfect."""

FURTHER_OFF = 1.3
"""Errors over stated ones from which on a remark is due, and from which on settings are taken to hide an effect, so
that every effect is tried beside them and from the stated ones: a tilt's settings hid a coma of 9 sigma at 1.37."""

MEMBERS = 4
"""Most members of a class, and functions that are weighed about their own settings."""
