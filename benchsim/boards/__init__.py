"""The calibrated screen to print: where its marks lie, and the same drawing as PDF at true scale and as SVG.

>>> layout = lay_out((700.0, 700.0), 36.0)
>>> len(layout.marks.ids)
40

``write_pdf`` and ``write_svg`` take ``draw(layout)``, and ``whole(layout)`` or ``tiles(layout, paper)`` as pages.
"""

from benchsim.boards.drawing import Drawing, draw
from benchsim.boards.layout import Layout, corrected, lay_out
from benchsim.boards.tiles import PAPERS, Tile, tiles, whole
from benchsim.boards.writers import write_pdf, write_svg

__all__ = [
    "PAPERS",
    "Drawing",
    "Layout",
    "Tile",
    "corrected",
    "draw",
    "lay_out",
    "tiles",
    "whole",
    "write_pdf",
    "write_svg",
]
