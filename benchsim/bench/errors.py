"""The one exception that a user's input can raise."""


class BenchsimError(ValueError):
    """The input cannot be used; the message is one sentence that names file, key or image, and the mend."""
