"""Property tests here take microseconds; a deadline would only measure what else the machine is doing."""

from hypothesis import settings

settings.register_profile("vector", deadline=None)
settings.load_profile("vector")
