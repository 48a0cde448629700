"""A document of sections with paragraphs, tables and pictures. Independent of mirrors, HTML and PDF."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from matplotlib.figure import Figure

#: Colours that colour-blind readers can distinguish [28].
BLUE, ORANGE, GREEN, VERMILION, PURPLE, GREY = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#666666"
SKY_BLUE, YELLOW = "#56B4E9", "#F0E442"
#: Colour map for sag about zero: dark at both ends, light in the middle, safe for colour-blind readers.
DIVERGING = "RdBu_r"
#: Resolution of pictures on the screen, dots per inch; on paper, where they are smaller, it is about 200.
DPI = 130


@dataclass(frozen=True)
class Table:
    """Rows under a header; the first column holds names, the others right-aligned numbers, or texts if `textual`."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    textual: bool = False


@dataclass(frozen=True, eq=False)
class Picture:
    """A figure; `name` is the stem of its file."""

    name: str
    caption: str
    figure: Figure

    @cached_property
    def png(self) -> bytes:
        """The figure as PNG, drawn once for all formats of the document."""
        stream = io.BytesIO()
        self.figure.savefig(stream, format="png", dpi=DPI)
        return stream.getvalue()


@dataclass(frozen=True, eq=False)
class Section:
    """A heading with paragraphs, then tables, then pictures; a `sheet` is printed on a page of its own, and fits it."""

    title: str
    paragraphs: Sequence[str]
    tables: Sequence[Table] = ()
    pictures: Sequence[Picture] = ()
    sheet: bool = False
