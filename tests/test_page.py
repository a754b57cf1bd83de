"""The page of a run: one file with its data in it, that asks for nothing (in a browser: test_page_in_browser.py)."""

import base64
import hashlib
import json
import math
import re
from html.parser import HTMLParser

import pages
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxpg.watch.bundle import IMPORT, TOP
from jaxpg.watch.page import PARTS, make_page


class Document(HTMLParser):
    """The texts of a page's elements and what its attributes ask a browser to fetch."""

    def __init__(self, text):
        super().__init__()
        self.texts, self.opened, self.fetched, self.policy = {}, [None], [], None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.opened.append((tag, attrs.get("type")))
        self.fetched += [attrs[name] for name in ("src", "href", "srcset", "action", "data") if name in attrs]
        if attrs.get("http-equiv") == "Content-Security-Policy":
            self.policy = dict(rule.strip().split(" ", 1) for rule in attrs["content"].split(";"))

    def handle_endtag(self, tag):
        self.opened.append(None)

    def handle_data(self, data):
        self.texts[self.opened[-1]] = self.texts.get(self.opened[-1], "") + data


def test_the_page_asks_for_nothing():
    text = make_page(pages.pendulum())
    assert [link for link in Document(text).fetched if link != "data:,"] == []
    assert not re.search(r"@import|url\((?!#)|\bfetch\(|XMLHttpRequest|WebSocket|EventSource|sendBeacon|import\(", text)


def test_the_policy_allows_this_style_and_this_script_and_nothing_else():
    document = Document(make_page(pages.pendulum()))
    assert document.policy["default-src"] == "'none'"
    for rule, element in [("style-src", ("style", None)), ("script-src", ("script", "module"))]:
        digest = base64.b64encode(hashlib.sha256(document.texts[element].encode()).digest()).decode()
        assert document.policy[rule] == f"'sha256-{digest}'"


def test_every_script_is_in_the_page_once_and_none_is_long():
    """Each begins with a comment that says what it is for."""
    script = Document(make_page(pages.pendulum())).texts["script", "module"].splitlines()
    assert not [line for line in script if re.match(r"\s*(import|export)\b", line)]
    for path in PARTS.glob("*.js"):
        lines = path.read_text(encoding="utf-8").splitlines()
        assert lines[0].startswith("// ")
        assert script.count(lines[0]) == 1, path
        assert len(lines) < 250, path
        assert max(map(len, lines)) <= 120, path


def test_scripts_export_what_others_import_and_nothing_else():
    texts = {path.name: path.read_text(encoding="utf-8") for path in PARTS.glob("*.js")}
    exported = {(name, top) for name, text in texts.items() for export, top in TOP.findall(text) if export}
    imported = [(file, names.split(",")) for text in texts.values() for names, file in IMPORT.findall(text)]
    assert exported == {(file, name.strip()) for file, names in imported for name in names}


@given(st.text(), st.lists(st.tuples(st.text(), st.text())))
def test_the_page_embeds_exactly_the_data(title, facts):
    data = pages.document("run", title + pages.NASTY, facts=[list(pair) for pair in facts])
    document = Document(make_page(data))
    assert json.loads(document.texts["script", "application/json"]) == data
    assert make_page(data).count("<script") == 2


def test_a_number_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="JSON"):
        make_page(pages.document("run", "a run", tables=[{"title": "", "columns": ["x"], "rows": [[math.nan]]}]))
