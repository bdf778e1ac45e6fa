"""Self-contained HTML pages: one file with embedded pictures, without network requests.

Pages extend ``templates/base.html`` and use the macros of ``templates/parts.html``. The content
security policy allows embedded pictures, inline styles, and the one script of this package, so that
text from files cannot add a script, even if unescaped.
"""

import base64
import hashlib
import io
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from svu_mi.capture.image_io import quantized
from svu_mi.core.io.files import write_text
from svu_mi.errors import OutputError
from svu_mi.output.style import PNG_LEVEL, css, css_gradient

TEMPLATES = Path(__file__).parent / "templates"
STYLE, SCRIPT = "page.css", "page.js"
THUMBNAIL = 240  # pixels of a photograph's longer side; 60 thumbnails take about a megabyte
JPEG_QUALITY = 82
NARROW_SPACE = "\u202f"  # without line break


@dataclass(frozen=True)
class PageImage:
    """Picture embedded in a page: ``data:`` URI of the file, and its size in pixels."""

    uri: str
    width: int
    height: int


def embedded_png(image: np.ndarray, side: int | None = None) -> PageImage:
    """Embed screen values (H, W, 3), or (H, W, 4) with opacity, in [0, 1] as PNG.

    The longer side is reduced to ``side`` pixels. NaN and infinity raise an ``OutputError``.
    """
    return _embedded(image, side, "png", compress_level=PNG_LEVEL)


def embedded_jpeg(image: np.ndarray, side: int | None = THUMBNAIL) -> PageImage:
    """Embed a photograph (H, W, 3) as JPEG (see ``embedded_png``)."""
    return _embedded(image, side, "jpeg", quality=JPEG_QUALITY)


def write_page(path: str | Path, template: str, **context: Any) -> None:
    """Render a template to a file, atomically; text is escaped."""
    write_text(path, page_of(template, **context))


def page_of(template: str, **context: Any) -> str:
    """Render a template to a string (see ``write_page``)."""
    page = _environment().get_template(template).render(context)
    # File names may contain lone surrogates, which UTF-8 cannot encode.
    return page.encode("utf-8", "replace").decode("utf-8")


def grouped(number: float) -> str:
    """Format a whole number with narrow spaces between thousands."""
    return f"{number:,.0f}".replace(",", NARROW_SPACE)


def percent(part: float) -> str:
    """Format a fraction as percent; only exact 0 and 1 become 0 % and 100 %."""
    if 0 < part <= 0.005:  # 0.5 % would be rounded to the even 0 %
        return f"under 1{NARROW_SPACE}%"
    if 0.995 <= part < 1:
        return f"over 99{NARROW_SPACE}%"
    return f"{100 * part:.0f}{NARROW_SPACE}%"


def _embedded(image: np.ndarray, side: int | None, kind: str, **options: Any) -> PageImage:
    if not (image.size and np.isfinite(image).all()):
        raise OutputError(f"A picture of a page is empty or contains NaN: shape {image.shape}.")
    picture = Image.fromarray(quantized(image))
    if side is not None:
        picture.thumbnail((side, side), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    picture.save(file, kind, **options)
    data = base64.b64encode(file.getvalue()).decode("ascii")
    return PageImage(f"data:image/{kind};base64,{data}", *picture.size)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    script = (TEMPLATES / SCRIPT).read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    environment.globals |= {
        "policy": f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{digest}'; base-uri 'none'; form-action 'none'",
        "style": Markup((TEMPLATES / STYLE).read_text(encoding="utf-8")),
        "script": Markup(script),
    }
    environment.filters |= {
        "css": css, "gradient": css_gradient, "grouped": grouped, "percent": percent,
    }  # fmt: skip
    return environment
