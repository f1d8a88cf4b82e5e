"""The one look of our HTML pages: no other file, readable on paper and on a phone, texts of others escaped."""

import base64
from collections.abc import Callable, Mapping
from importlib import resources
from typing import Any

from sb3_abisim.common.extras import needs_extra
from sb3_abisim.common.text import printable

BASE = "base.html"


def render_page(template: str, filters: Mapping[str, Callable[..., Any]], /, **values: Any) -> str:
    """A page.

    :param template: Jinja, which fills the blocks ``title``, ``header`` and ``main`` of ``base.html``
    :param filters: further ones, by name
    :param values: texts are escaped, and their control characters spelled out
    :raises ImportError: without Jinja, naming the extra
    """
    with needs_extra("pages", "a page"):
        import jinja2

    base = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined, finalize=_shown,
        loader=jinja2.DictLoader({BASE: base}),
    )  # fmt: skip
    environment.filters |= dict(filters)
    return environment.from_string(template).render(**values)


def png_source(data: bytes) -> str:
    """What stands in ``src`` of an image that is part of the page.

    :param data: a PNG file
    """
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"


def _shown(value: Any) -> Any:
    """A text as plain text; HTML in it is escaped."""
    return printable(value, "\n") if type(value) is str else value
