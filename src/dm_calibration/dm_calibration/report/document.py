"""A page of sections with tables and pictures, written as HTML and as PDF. Knows nothing of mirrors."""

from __future__ import annotations

import base64
import io
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template

from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imread

PNG_DPI = 110
#: Of pictures on paper.
PAPER_DPI = 200
#: A4 upright, inches.
PAGE = (8.27, 11.69)
MARGIN = 0.08
#: Height of a line of body text and of a table row, as a share of a PDF page.
LINE, ROW = 0.0155, 0.019
FOOT = "#444444"
#: Characters on a line of body text of a PDF page.
CHARACTERS = 104


@dataclass(frozen=True)
class Table:
    """Rows under a header; the first column is a name, the others are numbers, set to the right, unless `words`."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: bool = False

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"{self.caption}: a row of {len(row)} cells under {len(self.header)} headings")


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure; `name` is the stem of its file."""

    name: str
    caption: str
    figure: Figure


@dataclass(frozen=True, eq=False)
class Section:
    """A heading with paragraphs, then tables, then pictures."""

    title: str
    paragraphs: Sequence[str]
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()


_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 68rem; margin: 2rem auto;
  padding: 0 1rem; }
p { max-width: 48rem; }
h1 { font-size: 1.6rem; line-height: 1.25; }
h2 { font-size: 1.25rem; margin-top: 2.6rem; border-top: 1px solid #ccc; padding-top: 1rem; }
nav a { margin-right: 1rem; white-space: nowrap; }
.scroll { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding-bottom: 0.4rem; }
th, td { padding: 0.22rem 0.7rem; text-align: right; border-bottom: 1px solid #ddd; }
th:first-child, td:first-child, .words th, .words td { text-align: left; overflow-wrap: anywhere; }
thead th { border-bottom: 2px solid #555; vertical-align: bottom; }
figure { margin: 1.2rem 0; }
figure img { max-width: 100%; height: auto; }
figcaption { font-size: 0.88rem; color: #444; max-width: 48rem; }
@media print {
  body { font-size: 10pt; max-width: none; margin: 0; }
  nav { display: none; }
  tr, figure { break-inside: avoid; }
  h2, caption { break-after: avoid; }
  .scroll { overflow: visible; }
}
</style>
</head>
<body>
<h1>$title</h1>
<nav>$links</nav>
$sections
</body>
</html>
""")


def write_html(folder: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write `index.html` and its pictures into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)

    def place(picture: Picture) -> str:
        file = f"{picture.name}.png"
        (folder / file).write_bytes(_png(picture.figure))
        return file

    page = folder / "index.html"
    page.write_text(_html(title, sections, place))
    return page


def one_html(title: str, sections: Sequence[Section]) -> str:
    """The page as one file, with its pictures inside."""
    return _html(
        title,
        sections,
        lambda picture: f"data:image/png;base64,{base64.b64encode(_png(picture.figure)).decode('ascii')}",
    )


def _png(figure: Figure, dpi: float = PNG_DPI) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    # The layout stands now; finding it again for the PDF would take longer than drawing.
    figure.set_layout_engine("none")
    return stream.getvalue()


def _html(title: str, sections: Sequence[Section], place: Callable[[Picture], str]) -> str:
    """The page; `place` puts a picture somewhere and returns its address."""
    parts, links = [], []
    for number, section in enumerate(sections, start=1):
        links.append(f'<a href="#s{number}">{escape(section.title)}</a>')
        parts.append(f'<section id="s{number}">\n<h2>{escape(section.title)}</h2>')
        parts += [f"<p>{escape(paragraph)}</p>" for paragraph in section.paragraphs]
        parts += [_html_table(table) for table in section.tables]
        for picture in section.pictures:
            caption = escape(picture.caption)
            address = escape(place(picture))
            parts.append(f'<figure><img src="{address}" alt="{caption}"><figcaption>{caption}</figcaption></figure>')
        parts.append("</section>")
    return _PAGE.substitute(title=escape(title), links="\n".join(links), sections="\n".join(parts))


def _html_table(table: Table) -> str:
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.header)
    body = "\n".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in table.rows)
    kind = ' class="words"' if table.words else ""
    return (
        f'<div class="scroll"><table{kind}><caption>{escape(table.caption)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )


def write_pdf(path: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write all sections to a PDF, as :func:`pdf_pages`; returns its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pdf_pages(title, sections))
    return path


def pdf_pages(title: str, sections: Sequence[Section]) -> bytes:
    """All sections as a PDF on A4 pages: text, tables and pictures one below the other."""
    stream = io.BytesIO()
    # Without a date, the same run gives the same file.
    with PdfPages(stream, metadata={"Title": title, "CreationDate": None}) as pages:
        paper = _Paper(pages, title)
        for section in sections:
            paper.text(section.title, size=13, weight="bold", keep=4)
            for paragraph in section.paragraphs:
                paper.text(paragraph)
            for table in section.tables:
                paper.table(table)
            for picture in section.pictures:
                paper.picture(picture)
        paper.end()
    return stream.getvalue()


class _Paper:
    """Text from the top of a page downwards, on as many pages as it takes; title and number at the foot of each."""

    def __init__(self, pages: PdfPages, title: str) -> None:
        self._pages, self._title = pages, title
        self._done: list[Figure] = []
        self._page: Figure | None = None
        self._y = 0.0
        self.text(title, size=15, weight="bold")

    def end(self) -> None:
        """Write all pages: how many there are is known only now."""
        for number, page in enumerate(self._done, start=1):
            page.text(MARGIN, MARGIN / 2, self._title, fontsize=7.5, color=FOOT)
            words = f"page {number} of {len(self._done)}"
            page.text(1.0 - MARGIN, MARGIN / 2, words, fontsize=7.5, color=FOOT, ha="right")
            self._pages.savefig(page)

    def _room(self, height: float) -> Figure:
        """The page, a new one unless `height` is left on it."""
        if self._page is None or self._y - height < MARGIN:
            self._page, self._y = Figure(figsize=PAGE), 1.0 - MARGIN
            self._done.append(self._page)
        return self._page

    def text(self, text: str, size: float = 9.5, weight: str = "normal", keep: int = 0) -> None:
        """A paragraph; `keep` lines must fit below it on the same page."""
        wider = 0.85 if weight == "bold" else 1.0
        rows = textwrap.wrap(text, int(CHARACTERS * wider * 9.5 / size))
        line = LINE * size / 9.5
        self._room(line * (len(rows) + 1) + LINE * keep)
        for row in rows:
            self._room(line).text(MARGIN, self._y, row, fontsize=size, fontweight=weight, va="top")
            self._y -= line
        self._y -= 0.6 * line

    def table(self, table: Table) -> None:
        """A table whose columns are as wide as their longest cell."""
        widths = [max(len(row[k]) for row in (table.header, *table.rows)) for k in range(len(table.header))]
        size = min(8.0, 8.0 * 92 / (sum(widths) + 2 * len(widths)))
        edges = [MARGIN + edge for edge in _edges(widths)]
        if table.words:  # a column begins where the one before ends
            edges = [MARGIN, *(edge + 0.02 for edge in edges[:-1])]
        height = ROW * (len(table.rows) + 3)
        # A table that fits on a page is not torn.
        kept = height if height < 1.0 - 2.5 * MARGIN else 12 * ROW
        self.text(table.caption, size=9.0, weight="bold", keep=round(kept / LINE))
        side = "left" if table.words else "right"
        self._row(table.header, edges, size, side, "bold")
        for row in table.rows:
            if self._page is None or self._y - ROW < MARGIN:
                self._row(table.header, edges, size, side, "bold")  # again on every page
            self._row(row, edges, size, side)
        self._y -= ROW

    def picture(self, picture: Picture) -> None:
        """A picture as wide as the text, or as high as a page, with its caption below it."""
        width, height = picture.figure.get_size_inches()
        share = min((1.0 - 2 * MARGIN) * PAGE[0] / width, (1.0 - 3 * MARGIN) * PAGE[1] / height)
        across, down = width * share / PAGE[0], height * share / PAGE[1]
        page = self._room(down + 3 * LINE)
        self._y -= down
        axes = page.add_axes((MARGIN, self._y, across, down))
        axes.imshow(imread(io.BytesIO(_png(picture.figure, PAPER_DPI * share))), aspect="auto")
        axes.set_axis_off()
        self._y -= 0.4 * LINE
        self.text(picture.caption, size=8.5)

    def _row(
        self, cells: Sequence[str], edges: Sequence[float], size: float, side: str, weight: str = "normal"
    ) -> None:
        page = self._room(ROW)
        for k, cell in enumerate(cells):
            page.text(
                MARGIN if k == 0 else edges[k],
                self._y,
                cell,
                fontsize=size,
                fontweight=weight,
                ha="left" if k == 0 else side,
                va="top",
            )
        self._y -= ROW


def _edges(widths: Sequence[int]) -> list[float]:
    """Right edges of columns of these widths in characters, as shares of the page beyond the margin."""
    total = sum(widths) + 2 * len(widths)
    span = min(1.0 - 2 * MARGIN, total * 0.0093)
    edges, used = [], 0
    for width in widths:
        used += width + 2
        edges.append(span * used / total)
    return edges
