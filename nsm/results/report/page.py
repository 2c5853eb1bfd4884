"""The report as HTML: template, style, script, viewer library and content in one file."""

from __future__ import annotations

import base64
import gzip
import html
import json
from importlib import resources
from typing import Any

from plotly.offline import get_plotlyjs


def page(title: str, content: dict[str, Any]) -> str:
    """The page on a report's content.

    No word of the content becomes HTML: it is packed, and the script puts it in as text. The
    page's content security policy forbids the browser to load anything.
    """
    place = resources.files("nsm.results.report")
    parts = {
        "title": html.escape(title),
        "style": (place / "page.css").read_text(encoding="utf-8"),
        "script": (place / "page.js").read_text(encoding="utf-8"),
        "library": _packed(get_plotlyjs()),
        "content": _packed(json.dumps(content, allow_nan=False, separators=(",", ":"))),
    }
    text = (place / "page.html").read_text(encoding="utf-8")
    for name, part in parts.items():
        text = text.replace(f"<!--{name}-->", part, 1)
    return text


def _packed(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()
