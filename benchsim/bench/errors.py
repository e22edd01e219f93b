"""The one exception that a user's input can raise."""

from benchsim.bench.names import printable

MOST_SAID = 1000
"""Characters of a sentence: a field of a thousand may be quoted in it."""


class BenchsimError(ValueError):
    """The input cannot be used; the message is one sentence that names file, key or image, and the mend."""

    def __init__(self, message: str) -> None:
        said = printable(message)
        if len(said) > MOST_SAID:
            said = f"{said[: MOST_SAID * 2 // 3]} … {said[-MOST_SAID // 4 :]}"
        super().__init__(said)
