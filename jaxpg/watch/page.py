"""The page of a run or of a comparison: one HTML file that loads nothing."""

from __future__ import annotations

import base64
import hashlib
import html
import json
from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

PARTS = Path(__file__).with_name("page")
SCRIPTS = (  # in the order in which they are read: one module
    "dom",
    "theme",
    "numbers",
    "palette",
    "axes",
    "rollout",
    "outline",
    "stage",
    "player",
    "keys",
    "panels",
    "contours",
    "portrait",
    "workspace",
    "curves",
    "tables",
    "main",
)


def page(data: Mapping[str, Any]) -> str:
    """One HTML file, with its styles, its scripts and the data in it.

    Its Content-Security-Policy lets the browser run this style and this script, by their digests, and load nothing.

    Args:
      data: of a run (`jaxpg.watch.report`) or of a comparison (`jaxpg.watch.comparison`): plain values, finite or None.

    Raises:
      ValueError: a number that is not finite.
      TypeError: a value that JSON does not know.
    """
    style, script = _part("page.css"), "\n".join(_part(f"{name}.js") for name in SCRIPTS)
    return Template(_part("page.html")).substitute(
        policy=_policy(style, script), title=_text(data["title"]), style=style, script=script, data=_embedded(data)
    )


def _part(name: str) -> str:
    return (PARTS / name).read_text(encoding="utf-8")


def _policy(style: str, script: str) -> str:
    """Nothing is allowed but what is named; the digests are of the text between the tags."""
    rules = {
        "default-src": "'none'",
        "style-src": _digest(style),
        "script-src": _digest(script),
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _text(text: str) -> str:
    """As HTML, in ASCII: half characters, as names of files can have them, would not go into a file."""
    return html.escape(text).encode("ascii", "xmlcharrefreplace").decode()


def _embedded(data: Mapping[str, Any]) -> str:
    """JSON that can stand inside of a script element: no `</script>` and no `<!--` in it."""
    return json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
