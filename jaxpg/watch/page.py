"""The page of a run or of a comparison: one self-contained HTML file."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

from jaxpg.watch.bundle import bundle

PARTS = Path(__file__).with_name("page")


def make_page(data: Mapping[str, Any]) -> str:
    """One HTML file that contains its styles, scripts and data.

    Its Content-Security-Policy allows this style and this script, by their digests, and nothing else.

    Args:
      data: data from `jaxpg.watch.run_page` or `jaxpg.watch.comparison`: plain values, finite or None.

    Raises:
      ValueError: a number is not finite.
      TypeError: a value has no JSON form.
    """
    style, script = _read_part("page.css"), bundle(PARTS, "main.js")
    return Template(_read_part("page.html")).substitute(
        policy=_make_policy(style, script), title=_escape(data["title"]), style=style, script=script, data=_embed(data)
    )


def _read_part(name: str) -> str:
    return (PARTS / name).read_text(encoding="utf-8")


def _make_policy(style: str, script: str) -> str:
    """The Content-Security-Policy; digests are of the text between the tags."""
    rules = {
        "default-src": "'none'",
        "style-src": _make_digest(style),
        "script-src": _make_digest(script),
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _make_digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _escape(text: str) -> str:
    """The text as ASCII HTML: lone surrogates, which file names may contain, cannot be encoded."""
    return html.escape(text).encode("ascii", "xmlcharrefreplace").decode()


def _embed(data: Mapping[str, Any]) -> str:
    """JSON that is safe inside a script element: without `</script>` and `<!--`."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
