"""The printed board: are the marks where marks.csv says, in the PDF itself?

Every page of the PDF is rasterised at 300 dpi by other code (PDFium), the marks are found as in a photograph, and their
centres are taken to millimetres by the page's own size. As by a scanner the raster is blurred (1 px) and gets noise of
one count: edges are fitted, and without either there is nothing to fit. Bar: every mark of the board found, all within
0.05 mm of marks.csv. Sheets: one large, and tiles of A4, A3 and Letter; on tiles every mark is whole on one page.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
import pypdfium2

from benchsim import jobs
from benchsim.bench.marks import read_marks
from benchsim.bench.model import Camera, Marks
from benchsim.boards import Layout, Tile, tiles, whole
from benchsim.boards.tiles import MARGIN
from benchsim.trace import Photograph, find_marks

BAR = 0.05
POINT = 25.4 / 72

Place = tuple[float, float]


def centres(pages: Sequence[pypdfium2.PdfPage], sheets: Sequence[Tile], marks: Marks, dpi: float) -> dict[int, Place]:
    """Centres (y, z) mm of the marks on pages that lie side by side, by each page's own size and its tile's window."""
    grey = [page.render(scale=dpi / 72, grayscale=True).to_numpy() for page in pages]
    height, width = grey[0].shape
    row = np.hstack(grey)
    noise = np.random.default_rng(1).normal(0, 1, row.shape).astype(np.float32)
    light = cv2.GaussianBlur(row.astype(np.float32), (0, 0), 1.0) + noise
    full = np.zeros(light.shape, bool)
    picture = Photograph("page", light, full, np.ones((), np.float32), True, False, "mono", "mono", light, full)
    camera = Camera("A", light.shape[::-1], 1e5, (light.shape[1] / 2, height / 2))
    seen = find_marks(picture, marks, camera)
    out = {}
    for tag, (u, v) in zip(seen.ids, seen.corners.mean(axis=1) + 0.5, strict=True):
        k = int(u // width)
        size = np.array(pages[k].get_size()) * POINT
        y, z = (u - k * width) * size[0] / width, size[1] - v * size[1] / height
        out[int(tag)] = (y + sheets[k].low[0] - MARGIN, z + sheets[k].low[1] - MARGIN)
    return out


def worst(folder: Path, layout: Layout, paper: str, dpi: float = 300.0) -> tuple[int, float]:
    """How many of the marks were found, and how far the farthest lies from marks.csv [mm]."""
    marks = read_marks(folder / "marks.csv")
    sheets = [whole(layout)] if paper == "sheet" else tiles(layout, paper)
    document = pypdfium2.PdfDocument(folder / "board.pdf")
    assert len(document) == len(sheets)
    found: dict[int, float] = {}
    for _, row in groupby(range(len(sheets)), key=lambda k: sheets[k].low[1]):
        some = list(row)
        for tag, at in centres([document[k] for k in some], [sheets[k] for k in some], marks, dpi).items():
            found[tag] = float(np.hypot(*np.subtract(at, marks.centres[marks.ids.index(tag)])))
    return len(found), max(found.values())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--papers", nargs="*", default=["sheet", "a4", "a3", "letter"])
    options = parser.parse_args()
    cv2.setNumThreads(1)
    out = csv.writer(sys.stdout)
    out.writerow(["paper", "pages", "marks", "found", "worst_mm"])
    met = True
    for paper in options.papers:
        with tempfile.TemporaryDirectory() as name:
            result = jobs.board(Path(name) / "board", paper=paper)
            found, off = worst(result.folder, result.layout, paper)
        count = len(result.marks.ids)
        met &= found == count and off <= BAR
        out.writerow([paper, result.pages, count, found, f"{off:.4f}"])
    print(f"bar {BAR} mm: {'met' if met else 'NOT MET'}")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
