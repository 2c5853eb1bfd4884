"""The report as one HTML file: template, style, script, plotly and the content."""

from __future__ import annotations

import base64
import gzip
import html
import json
from importlib import resources
from typing import Any

from plotly.offline import get_plotlyjs


def page(title: str, content: dict[str, Any]) -> str:
    """The page for a report's content.

    Nothing in the content becomes HTML: it is compressed, and the script inserts it as text. The
    page's content security policy forbids the browser to load anything.
    """
    templates = resources.files("nsm.results.report")
    parts = {
        "title": html.escape(title),
        "style": (templates / "page.css").read_text(encoding="utf-8"),
        "script": (templates / "page.js").read_text(encoding="utf-8"),
        "library": _compressed(get_plotlyjs()),
        "content": _compressed(json.dumps(content, allow_nan=False, separators=(",", ":"))),
    }
    text = (templates / "page.html").read_text(encoding="utf-8")
    for name, part in parts.items():
        text = text.replace(f"<!--{name}-->", part, 1)
    return text


def _compressed(text: str) -> str:
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()
