"""A document as HTML: one file with embedded pictures, or a page with picture files beside it."""

import base64
from collections.abc import Callable, Sequence
from html import escape
from string import Template

from dm_calibration.report.document import Picture, Section, Table

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
th:first-child, td:first-child, .textual th, .textual td { text-align: left; overflow-wrap: anywhere; }
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


def _as_data(picture: Picture) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture.png).decode('ascii')}"


def html_page(title: str, sections: Sequence[Section], place: Callable[[Picture], str] = _as_data) -> str:
    """The HTML page; `place` stores a picture and returns its address. By default pictures are embedded in the page."""
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
    kind = ' class="textual"' if table.textual else ""
    return (
        f'<div class="scroll"><table{kind}><caption>{escape(table.caption)}</caption>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
    )
