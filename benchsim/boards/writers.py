"""The drawing of a board as PDF, page by page at true scale, and as SVG for a plotter."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas

from benchsim.bench.writing import write_bytes, write_text
from benchsim.boards.drawing import Drawing, Line, Words
from benchsim.boards.tiles import MARGIN, Tile

CAP_HEIGHT = 0.718
"""Height of Helvetica's capitals in units of its size."""


def write_pdf(path: Path, drawing: Drawing, pages: Sequence[Tile]) -> None:
    """Write the pages; viewers are told not to scale them when printing.

    The file holds no date: the same board gives the same bytes.
    """
    buffer = io.BytesIO()
    canvas = Canvas(buffer, invariant=1, pageCompression=1)
    canvas.setTitle(f"benchsim board {drawing.size[0]:g} x {drawing.size[1]:g} mm")
    canvas.setViewerPreference("PrintScaling", "None")
    for page in pages:
        canvas.setPageSize((page.paper[0] * mm, page.paper[1] * mm))
        canvas.scale(mm, mm)
        canvas.translate(MARGIN - page.low[0], MARGIN - page.low[1])
        for words in page.words:
            _say(canvas, words)
        canvas.saveState()
        window = canvas.beginPath()
        # A hair more than the board: its outline is to be seen whole.
        window.rect(
            page.low[0] - 0.1, page.low[1] - 0.1, page.high[0] - page.low[0] + 0.2, page.high[1] - page.low[1] + 0.2
        )
        canvas.clipPath(window, stroke=0, fill=0)
        _fill(canvas, drawing, page)
        for line in (*drawing.lines, *page.lines):
            if _shown(page, line.start, line.end):
                _stroke(canvas, line)
        for words in drawing.words:
            # Longer than a sheet is wide at most for the title: drawn on every page of its row and clipped.
            if page.low[1] - 60 < words.place[1] < page.high[1] + 60:
                _say(canvas, words)
        canvas.restoreState()
        canvas.showPage()
    canvas.save()
    write_bytes(path, buffer.getvalue())


def _shown(page: Tile, *points: tuple[float, float]) -> bool:
    """Whether the box around some points meets the page's window."""
    return all(
        min(p[a] for p in points) <= page.high[a] + 1 and max(p[a] for p in points) >= page.low[a] - 1 for a in (0, 1)
    )


def _fill(canvas: Canvas, drawing: Drawing, page: Tile) -> None:
    for shape in drawing.shapes:
        if not _shown(page, *shape.rings[0]):
            continue
        path = canvas.beginPath()
        for ring in shape.rings:
            path.moveTo(*ring[0])
            for point in ring[1:]:
                path.lineTo(*point)
            path.close()
        canvas.drawPath(path, stroke=0, fill=1, fillMode=1)


def _stroke(canvas: Canvas, line: Line) -> None:
    canvas.setLineWidth(line.width)
    canvas.line(*line.start, *line.end)


def _say(canvas: Canvas, words: Words) -> None:
    canvas.saveState()
    canvas.translate(*words.place)
    canvas.rotate(words.turn)
    canvas.setFont("Helvetica", words.height / CAP_HEIGHT)
    put = {"left": canvas.drawString, "middle": canvas.drawCentredString, "right": canvas.drawRightString}
    put[words.anchor](0, 0, words.words)
    canvas.restoreState()


def write_svg(path: Path, drawing: Drawing) -> None:
    """Write the whole board in millimetres, one closed path per mark."""
    w, h = drawing.size
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" '
        f'viewBox="{-w / 2:g} {-h / 2:g} {w:g} {h:g}">',
        f"<title>benchsim board {w:g} × {h:g} mm</title>",
        '<g id="marks" fill="black" stroke="none" fill-rule="nonzero">',
    ]
    for shape in drawing.shapes:
        rings = " ".join("M" + " L".join(f"{y:.10g},{-z:.10g}" for y, z in ring) + " Z" for ring in shape.rings)
        out.append(f'<path d="{rings}"/>')
    out += ["</g>", '<g id="lines" fill="none" stroke="black">']
    for line in drawing.lines:
        (y0, z0), (y1, z1) = line.start, line.end
        out.append(f'<path d="M{y0:.10g},{-z0:.10g} L{y1:.10g},{-z1:.10g}" stroke-width="{line.width:g}"/>')
    out += ["</g>", '<g id="words" font-family="Helvetica, Arial, sans-serif">']
    anchor = {"left": "start", "middle": "middle", "right": "end"}
    for words in drawing.words:
        y, z = words.place
        turn = f' transform="rotate({-words.turn:g} {y:g} {-z:g})"' if words.turn else ""
        out.append(
            f'<text x="{y:g}" y="{-z:g}" font-size="{words.height / CAP_HEIGHT:.3g}" '
            f'text-anchor="{anchor[words.anchor]}"{turn}>{escape(words.words)}</text>'
        )
    out += ["</g>", "</svg>", ""]
    write_text(path, "\n".join(out))
