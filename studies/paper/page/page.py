"""The page: all sections in the order of the paper, as HTML with pictures and as PDF."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from dm_calibration.report.document import Picture, Section
from dm_calibration.report.html_page import html_page
from dm_calibration.report.pdf_pages import pdf_pages
from studies.paper.page import content, content_coefficients, content_control, content_regressions, content_sampling
from studies.paper.results import Results

TITLE = "Flexible spherical/aspherical surface control: the paper's tables and figures on the virtual bench"


class Written(NamedTuple):
    """The files of a page."""

    html: Path
    pdf: Path
    pictures: list[Path]


def sections(results: Results) -> list[Section]:
    """All sections, in the order of the paper."""
    return [
        content.introduction(results),
        content.table_1(results),
        content_sampling.sampling(results),
        content.figure_4(results),
        content.figure_5(results),
        content.weights(results),
        content_regressions.table_2(results),
        content_regressions.table_3(results),
        content_control.controlled_surfaces(results),
        content_coefficients.coefficient_errors(results),
        content_control.conics(results),
        content_control.readings(results),
        content_control.claims(results),
    ]


def write_html(folder: Path, title: str, sections: Sequence[Section]) -> Path:
    """Write `index.html` and its pictures into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)

    def place(picture: Picture) -> str:
        file = f"{picture.name}.png"
        (folder / file).write_bytes(picture.png)
        return file

    page = folder / "index.html"
    page.write_text(html_page(title, sections, place))
    return page


def write_page(results: Results, folder: Path) -> Written:
    """Write the page into `folder`.

    Raises:
        OSError: the folder cannot be written to.
    """
    made = sections(results)
    pictures = [folder / f"{picture.name}.png" for section in made for picture in section.pictures]
    html, pdf = write_html(folder, TITLE, made), folder / "paper.pdf"
    pdf.write_bytes(pdf_pages(TITLE, made))
    return Written(html, pdf, pictures)
