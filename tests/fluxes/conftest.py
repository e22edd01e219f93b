"""benchsim before drjit and mitsuba, whichever test module comes first; `carlo` can be imported by name."""

import sys
from pathlib import Path

import benchsim  # noqa: F401

sys.path.insert(0, str(Path(__file__).parent))
