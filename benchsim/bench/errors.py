"""The one exception that a user's input can raise."""

from benchsim.bench.names import printable


class BenchsimError(ValueError):
    """The input cannot be used; the message is one sentence that names file, key or image, and the mend."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))
