"""A document as PDF on A4 pages, made with ReportLab."""

import io
from collections.abc import Sequence
from functools import cache
from html import escape
from itertools import chain
from pathlib import Path
from typing import Any

import matplotlib
from reportlab import rl_config
from reportlab.lib.colors import HexColor
from reportlab.lib.enums import TA_LEFT, TA_RIGHT
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.utils import simpleSplit
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    Flowable,
    Image,
    KeepInFrame,
    KeepTogether,
    LongTable,
    PageBreak,
    Paragraph,
    SimpleDocTemplate,
    Spacer,
    TableStyle,
)

from dm_calibration.report.document import Picture, Section, Table

#: Margin and text width of a page; lengths in points, 1/72 inch.
MARGIN = 48.0
WIDTH = A4[0] - 2 * MARGIN
#: Tallest picture: the page less margins and room for a caption.
HEIGHT = A4[1] - 2 * MARGIN - 60.0
#: Room for text on a page, less the frame's own padding.
PAGE = A4[1] - 2 * MARGIN - 12.0
#: Padding around the text of a cell.
PADDING = 4.0
#: Largest width of a column, as a share of the page, before its text is broken over lines.
COLUMN_MAX = 0.38
TABLE_SIZE = 8.0
#: Room for the number at the foot of a page.
NUMBER = 70.0
FOOT = HexColor("#444444")
RULE = HexColor("#dddddd")
#: The fonts of the figures: they have the Greek letters and symbols of the text, which the standard PDF fonts lack.
REGULAR, BOLD = "DejaVuSans", "DejaVuSans-Bold"

TITLE = ParagraphStyle("title", fontName=BOLD, fontSize=15, leading=19, spaceAfter=10)
HEADING = ParagraphStyle(
    "heading", fontName=BOLD, fontSize=12, leading=15, spaceBefore=12, spaceAfter=6, keepWithNext=1
)
BODY = ParagraphStyle("body", fontName=REGULAR, fontSize=9, leading=12.5, spaceAfter=6)
LEAD = ParagraphStyle("lead", fontName=REGULAR, fontSize=12, leading=16, spaceAfter=9)
CAPTION = ParagraphStyle("caption", fontName=REGULAR, fontSize=8, leading=10.5, spaceAfter=8, textColor=FOOT)
TABLE_TITLE = ParagraphStyle("table", fontName=BOLD, fontSize=8.5, leading=11, spaceBefore=6, spaceAfter=3)


def pdf_pages(title: str, sections: Sequence[Section]) -> bytes:
    """All sections as a PDF: text, tables and pictures one below the other, with title and page number at the foot."""
    _register_fonts()
    rl_config.useA85 = 0  # pictures as binary: as text (ASCII 85) they are a quarter larger and slower to encode
    stream = io.BytesIO()
    # Invariant: the file contains no date, so that the same content gives the same file.
    margins = dict.fromkeys(("leftMargin", "rightMargin", "topMargin", "bottomMargin"), MARGIN)
    document = SimpleDocTemplate(stream, pagesize=A4, title=title, invariant=1, **margins)
    story: list[Flowable] = []
    for section in sections:
        style = LEAD if section.sheet else BODY
        text = [_paragraph(section.title, HEADING), *(_paragraph(text, style) for text in section.paragraphs)]
        if not story:
            text.insert(0, _paragraph(title, TITLE))
        shown = [*map(_table, section.tables), *map(_picture, section.pictures)]
        if section.sheet:
            story += [KeepInFrame(WIDTH, PAGE, [*text, *chain(*shown)], mode="shrink"), PageBreak()]
        elif shown:  # together with the heading, if necessary on the next page
            story += [KeepTogether([*text, *shown[0]]), *map(KeepTogether, shown[1:])]
        else:
            story += text
    document.build(story, canvasmaker=_numbered(title))
    return stream.getvalue()


@cache
def _register_fonts() -> None:
    for name in (REGULAR, BOLD):
        pdfmetrics.registerFont(TTFont(name, str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / f"{name}.ttf")))


def _paragraph(text: str, style: ParagraphStyle) -> Paragraph:
    return Paragraph(escape(text), style)


def _picture(picture: Picture) -> list[Flowable]:
    """A picture with its caption below, as wide as the text or as high as the page."""
    width, height = (72.0 * length for length in picture.figure.get_size_inches())
    scale = min(WIDTH / width, HEIGHT / height)
    return [Image(io.BytesIO(picture.png), width * scale, height * scale), _paragraph(picture.caption, CAPTION)]


def _table(table: Table) -> list[Flowable]:
    """A table with columns as wide as their longest cell, in a smaller type if they are wider than the page."""
    widths = _column_widths(table)
    scale = min(1.0, WIDTH / sum(widths))
    size, padding = scale * TABLE_SIZE, scale * PADDING

    def cells(row: Sequence[str], font: str) -> list[Any]:
        made: list[Any] = []
        for column, (cell, width) in enumerate(zip(row, widths, strict=True)):
            side = TA_LEFT if table.textual or column == 0 else TA_RIGHT
            style = ParagraphStyle("cell", fontName=font, fontSize=size, leading=1.25 * size, alignment=side)
            broken = _cell_width(cell, font) > width + 0.1
            made.append(_paragraph(cell, style) if broken else cell)
        return made

    rows = [cells(table.header, BOLD), *(cells(row, REGULAR) for row in table.rows)]
    style = TableStyle(
        [
            ("FONT", (0, 0), (-1, 0), BOLD, size),
            ("FONT", (0, 1), (-1, -1), REGULAR, size),
            ("ALIGN", (0 if table.textual else 1, 0), (-1, -1), "LEFT" if table.textual else "RIGHT"),
            ("VALIGN", (0, 0), (-1, 0), "BOTTOM"),
            ("VALIGN", (0, 1), (-1, -1), "TOP"),
            ("LEFTPADDING", (0, 0), (-1, -1), padding),
            ("RIGHTPADDING", (0, 0), (-1, -1), padding),
            ("TOPPADDING", (0, 0), (-1, -1), 1.5),
            ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
            ("LINEBELOW", (0, 0), (-1, 0), 0.8, FOOT),
            ("LINEBELOW", (0, 1), (-1, -1), 0.3, RULE),
        ]
    )
    scaled = [scale * width for width in widths]
    made = LongTable(rows, colWidths=scaled, repeatRows=1, splitInRow=1, style=style, hAlign="LEFT")
    return [_paragraph(table.caption, TABLE_TITLE), made, Spacer(0, 10)]


def _column_widths(table: Table) -> list[float]:
    """Widths of the columns at full type size, points: that of the longest cell if all columns fit on the page.

    Otherwise headings are broken over lines, then long texts as well, but never numbers.
    """
    longest = [max(_cell_width(row[k], REGULAR) for row in table.rows) for k in range(len(table.header))]
    headings = [_cell_width(heading, BOLD) for heading in table.header]
    widths = [max(pair) for pair in zip(longest, headings, strict=True)]
    if sum(widths) > WIDTH:
        narrow = [max(_cell_width(word, BOLD) for word in heading.split(" ")) for heading in table.header]
        widths = [max(pair) for pair in zip(longest, narrow, strict=True)]
    if sum(widths) > WIDTH:
        widths = [min(width, COLUMN_MAX * WIDTH) for width in widths]
        if table.textual:  # the last column has the longest texts, which may be broken
            widths[-1] = max(widths[-1], WIDTH - sum(widths[:-1]))
    return widths


def _cell_width(text: str, font: str) -> float:
    return float(pdfmetrics.stringWidth(text, font, TABLE_SIZE)) + 2 * PADDING


def _numbered(title: str) -> type[Canvas]:
    """A canvas that writes the title and "page 2 of 7" at the foot of each page, once all pages are finished."""

    class NumberedCanvas(Canvas):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self._finished: list[dict[str, Any]] = []

        def showPage(self) -> None:
            self._finished.append(dict(self.__dict__))
            self._startPage()

        def save(self) -> None:
            for number, page in enumerate(self._finished, start=1):
                self.__dict__.update(page)
                self.setFont(REGULAR, 7.0)
                self.setFillColor(FOOT)
                shown = "".join(simpleSplit(title, REGULAR, 7.0, WIDTH - NUMBER)[:1])
                self.drawString(MARGIN, 0.5 * MARGIN, shown)
                self.drawRightString(A4[0] - MARGIN, 0.5 * MARGIN, f"page {number} of {len(self._finished)}")
                super().showPage()
            super().save()

    return NumberedCanvas
