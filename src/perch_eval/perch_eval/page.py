"""HTML of the reports: self-contained pages with common style, tables and pictures."""

from __future__ import annotations

import base64
import html
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 640  # of a picture in a grid, at most [px]
UNITS = {"per_s": "per s", "s": "s", "ms": "ms", "hz": "Hz", "deg": "deg", "percent": "%", "m": "m", "px": "px"}  # in names of figures
_UNIT = re.compile(rf"_({'|'.join(UNITS)})(?=_| |$)")
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em; color: #222; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; border-bottom: 1px solid #ddd; }
table { border-collapse: collapse; } td, th { padding: 3px 16px 3px 0; text-align: left; vertical-align: top; }
td { overflow-wrap: anywhere; } th { font-weight: 600; white-space: nowrap; } img { max-width: 100%; }
.good, .ok { color: #17692b; } .warning { color: #9a6700; } .bad, .fails { color: #a11; }
.images { display: grid; grid-template-columns: repeat(auto-fill, minmax(240px, 1fr)); gap: 10px; }
figure { margin: 0; } figcaption { font-size: 12px; color: #555; } .bar { background: #c92a2a; height: 11px; }
"""


class Html(str):
    """Text that is HTML already and is not escaped."""


def text(value: Any) -> str:
    """Return the HTML of a value: escaped, unless it is `Html`."""
    return value if isinstance(value, Html) else html.escape(str(value))


def page(title: str, *parts: str, heading: str | None = None) -> str:
    """Return a whole document.

    Args:
        title: of the window, and the heading if none is given.
        parts: HTML.
        heading: HTML of the heading; None: the title.
    """
    return (f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{text(title)}</title><style>{_STYLE}</style>'
            f"<h1>{text(title) if heading is None else heading}</h1>{''.join(parts)}</html>\n")


def section(title: str, body: str, absent: str = "") -> str:
    """Return a heading and its body, or `absent` if the body is empty; nothing if both are empty."""
    return f"<h2>{text(title)}</h2>{body or f'<p>{text(absent)}</p>'}" if body or absent else ""


def table(rows: Iterable[Sequence[Any]], head: Sequence[Any] = (), classes: Sequence[str] = ()) -> str:
    """Return a table whose rows begin with a heading cell; empty without rows.

    Args:
        rows: cells, escaped unless they are `Html`.
        head: titles of the columns.
        classes: CSS class of each row's first cell.
    """
    lines = [f"<tr><th{f' class={classes[k]}' if classes else ''}>{text(row[0])}</th>"
             + "".join(f"<td>{text(cell)}</td>" for cell in row[1:]) + "</tr>" for k, row in enumerate(rows)]
    first = f"<tr>{''.join(f'<th>{text(cell)}</th>' for cell in head)}</tr>" if head else ""
    return f"<table>{first}{''.join(lines)}</table>" if lines else ""


def in_words(key: str, value: float) -> tuple[str, str]:
    """Return name and value of a figure, the latter with the unit that is part of its key, as in `path_m`."""
    unit, whole = _UNIT.search(key), float(value).is_integer()
    return _UNIT.sub("", key).replace("_", " "), f"{f'{value:.0f}' if whole else f'{value:.4g}'}{f' {UNITS[unit[1]]}' if unit else ''}"


def figure_rows(figures: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return figures, also those in mappings, as rows of a table: finite numbers, and texts (one or a list) that are not empty."""
    rows: list[tuple[str, str]] = []
    for key, value in figures.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            rows += figure_rows(value, f"{name} ")
        elif isinstance(value, (str, list)):
            rows += [(name.replace("_", " "), one) for one in ([value] if isinstance(value, str) else value) if one]
        elif math.isfinite(value):
            rows.append(in_words(name, value))
    return rows


def image(figure: Figure | None, title: str = "") -> str:
    """Return a figure as an image; empty for None. Without `savefig`, which draws twice, the first time only for the layout."""
    if figure is None:
        return ""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    png = io.BytesIO()
    figure.set_dpi(95)
    FigureCanvasAgg(figure).print_png(png)
    return f'<img alt="{text(title)}" src="data:image/png;base64,{base64.b64encode(png.getvalue()).decode()}">'


def images(pictures: Iterable[tuple[str, np.ndarray]]) -> str:
    """Return a grid of pictures (caption; pixels, uint8, grey or bgr); those wider than `WIDTH` are scaled down."""
    figures = []
    for caption, pixels in pictures:
        if (scale := WIDTH / pixels.shape[1]) < 1.0:
            pixels = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        data = base64.b64encode(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()).decode()
        figures.append(f'<figure><img src="data:image/jpeg;base64,{data}"><figcaption>{text(caption)}</figcaption></figure>')
    return f'<div class="images">{"".join(figures)}</div>' if figures else ""
