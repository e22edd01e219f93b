"""``benchsim board``: the calibrated screen to print, and ``marks.csv`` as the printer made it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchsim.bench.errors import BenchsimError
from benchsim.bench.model import Marks
from benchsim.bench.paths import STAMP
from benchsim.bench.reading import load_json
from benchsim.bench.writing import write_marks
from benchsim.boards import PAPERS, Layout, corrected, draw, lay_out, tiles, whole, write_pdf, write_svg
from benchsim.boards.layout import RULE
from benchsim.jobs.output import output_folder
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.reports.quantities import counted

READING = 0.2
"""Error of a reading on a ruler [mm], 1 sigma: what `summary` translates into the marks' places."""


@dataclass(frozen=True, repr=False)
class BoardResult(Shown):
    """What ``board`` wrote.

    Attributes
    ----------
    folder : Path
    layout : Layout
        As it is meant to be printed.
    paper : str
    pages : (2,) int
        Sheets across and up.
    marks : Marks
        As in ``marks.csv``: measured if that was given.
    measured : (2,) mm, or None
        What the ruler said along y and z.
    over : float
        What was measured, as it was meant [mm].
    """

    folder: Path
    layout: Layout
    paper: str
    pages: int
    marks: Marks
    measured: tuple[float, float] | None
    over: float

    @property
    def size(self) -> tuple[float, float]:
        """The board as printed [mm]: ``size_mm`` of ``[screen]``."""
        w, h = self.layout.size
        y, z = self.measured or (self.over, self.over)
        return w * y / self.over, h * z / self.over

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        return {
            "format": "benchsim-board/1",
            "folder": str(self.folder),
            "size_mm": list(self.size),
            "paper": self.paper,
            "pages": self.pages,
            "marks": len(self.marks.ids),
            "side_mm": self.marks.sides[0],
            "measured_mm": None if self.measured is None else list(self.measured),
            "over_mm": self.over,
        }

    def summary(self) -> str:
        """What to print, and what to measure next."""
        w, h = self.layout.size
        far = max(abs(c) for centre in self.layout.marks.centres for c in centre)
        lines = [
            f"board of {w:g} × {h:g} mm with {len(self.marks.ids)} AprilTags 36h11 in {self.folder}/: board.pdf "
            f"({counted(self.pages, 'page')}, {self.paper}), board.svg, marks.csv"
        ]
        if self.measured is None:
            lines += [
                "marks.csv is what was meant, not what the printer made. Print at 100 % (no fitting to the page), then "
                f"measure both check rules of {RULE:g} mm:",
                f"next: benchsim board -o {self.folder} --measured-mm Y Z",
            ]
        else:
            y, z = (100 * (m / self.over - 1) for m in self.measured)
            lines += [
                f"marks.csv follows the ruler: {y:+.2f} % along y, {z:+.2f} % along z.",
                f"A reading {READING:g} mm wrong moves the outermost marks by {READING * far / self.over:.2f} mm"
                + ("; a longer part of the scales does better: --over-mm 600, say." if self.over < far else "."),
                f"in recording.toml: [screen] size_mm = [{self.size[0]:.2f}, {self.size[1]:.2f}]",
            ]
        return "\n".join(lines)


def board(
    output: Path | str | None = None,
    *,
    size: tuple[float, float] | None = None,
    side: float | None = None,
    paper: str | None = None,
    measured: tuple[float, float] | None = None,
    over: float = RULE,
    progress: Progress = silent,
) -> BoardResult:
    """Draw the calibrated screen; or correct the ``marks.csv`` of one that was drawn, by what was measured on it.

    Parameters
    ----------
    output : path, optional
        Folder to write; default ``./board/``.
    size : (2,) mm, optional
        Along y and z; default 700 × 700.
    side : float, optional
        Of the marks' black squares [mm]; default 36.
    paper : {"sheet", "a4", "a3", "letter"}, optional
        One large sheet (the default), or tiles.
    measured : (2,) mm, optional
        What a ruler reads on the print along y and z. Size, side and paper are then those of the board in ``output``.
    over : float
        Length on the print that was measured, as it was meant [mm].
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    BoardResult

    Raises
    ------
    BenchsimError
        If the board cannot be drawn so, or the folder cannot be used.

    Examples
    --------
    >>> import tempfile
    >>> import benchsim as bs
    >>> made = bs.board(tempfile.mkdtemp() + "/board", paper="a4")
    >>> made.size, made.pages  # mm; sheets across and up
    ((700.0, 700.0), 15)
    """
    folder = Path("board" if output is None else output)
    options = _options(folder, measured is not None, {"size": size, "side": side, "paper": paper})
    layout = lay_out(options["size"], options["side"])
    pages = [whole(layout)] if options["paper"] == "sheet" else tiles(layout, options["paper"])
    marks = layout.marks if measured is None else corrected(layout.marks, measured, over)
    stated = {**options, "measured": measured, "over": over}
    progress("drawing", 0.2)
    with output_folder(folder, "board", [], stated) as staging:
        drawing = draw(layout)
        write_pdf(staging / "board.pdf", drawing, pages)
        write_svg(staging / "board.svg", drawing)
        write_marks(staging / "marks.csv", marks)
    return BoardResult(folder, layout, options["paper"], len(pages), marks, measured, over)


def _options(folder: Path, printed: bool, given: dict[str, Any]) -> dict[str, Any]:
    """Size, side and paper: of a print that was measured they are those of the folder, and no others."""
    options = {"size": (700.0, 700.0), "side": 36.0, "paper": "sheet"}
    if printed:
        try:
            stamp = load_json(folder / STAMP)
            before = {key: stamp["options"][key] for key in options} if stamp["command"] == "board" else None
        except (ValueError, KeyError, TypeError):
            before = None
        if before is not None:
            before["size"] = tuple(before["size"])
            changed = [key for key, value in given.items() if value is not None and value != before[key]]
            if changed:
                flag = {"size": "--size-mm", "side": "--side-mm", "paper": "--paper"}[changed[0]]
                raise BenchsimError(
                    f"{folder}: the board drawn there has another {changed[0]}; leave {flag} out to correct the "
                    "marks of that print, or choose another folder with -o"
                )
            options = before
    options |= {key: value for key, value in given.items() if value is not None}
    if options["paper"] not in ("sheet", *PAPERS):
        raise BenchsimError(f"board: paper '{options['paper']}' is not known; give sheet, {', '.join(PAPERS)}")
    return options
