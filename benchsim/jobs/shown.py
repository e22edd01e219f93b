"""How a result shows itself: in one line at a prompt, whole in a notebook."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from benchsim.diagnosis.problem import Effect
    from benchsim.diagnosis.result import Class, Diagnosis, Found


class Shown:
    """A result with a ``summary`` for a person and a figure for each of its pictures."""

    def summary(self) -> str:
        """What a person wants to know, in plain sentences."""
        raise NotImplementedError

    def figures(self) -> list[Figure]:
        """Its pictures, made anew."""
        return []

    def __repr__(self) -> str:
        lines = self.summary().splitlines()
        return f"<{type(self).__name__}: {lines[0].strip()}{' …' if len(lines) > 1 else ''}>"

    def _repr_html_(self) -> str:
        pictures = []
        for figure in self.figures():
            png = BytesIO()
            figure.savefig(png, format="png", dpi=90, facecolor="white")
            pictures.append(f'<img alt="" src="data:image/png;base64,{b64encode(png.getvalue()).decode()}">')
        return f'<pre style="white-space: pre-wrap; font-size: 85%">{escape(self.summary())}</pre>' + "".join(pictures)


class Diagnosed(Shown):
    """What diagnoses of benches and of mounts have in common."""

    diagnosis: Diagnosis

    @property
    def title(self) -> str:
        """What the person calls the recordings."""
        raise NotImplementedError

    @property
    def catalogue(self) -> tuple[Effect, ...]:
        """The effects that were looked for."""
        raise NotImplementedError

    @property
    def verdict(self) -> str:
        """One of `diagnosis.result.VERDICTS`."""
        return self.diagnosis.verdict

    @property
    def effects(self) -> tuple[Found, ...]:
        """What was found."""
        return self.diagnosis.effects

    @property
    def classes(self) -> tuple[Class, ...]:
        """Alternatives that the data cannot tell apart."""
        return self.diagnosis.classes

    def plot_probability(self) -> Figure:
        """Probability that an effect is there, of every effect of the catalogue."""
        from benchsim.reports import diagnosis_pictures

        return diagnosis_pictures.probability(self.diagnosis, self.catalogue, self.title)

    def figures(self) -> list[Figure]:
        """Its pictures, made anew."""
        return [self.plot_probability()]
