"""benchsim before drjit and mitsuba, whichever test module comes first."""

import benchsim  # noqa: F401
