"""Each test process computes with one thread: several share the cores, and small matrices gain from no second."""

import os

for _key in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_key, "1")  # read once, when numpy is first imported

from hypothesis import settings  # noqa: E402 -- after the threads are set

# A deadline would measure what else the machine is doing.
settings.register_profile("benchsim", deadline=None)
settings.load_profile("benchsim")
