"""benchsim before drjit and mitsuba, whichever test module comes first; and this folder on the path."""

import sys
from pathlib import Path

import benchsim  # noqa: F401

sys.path.insert(0, str(Path(__file__).parent))
