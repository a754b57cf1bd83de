"""A headless browser for tests, and what is done with the page in it."""

import shutil
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any, NamedTuple

import pytest

from jaxpg.watch.bundle import bundle
from jaxpg.watch.page import PARTS

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ("no-sandbox", "disable-gpu", "disable-background-networking", "disable-component-update", "disable-sync")


@contextmanager
def launched():
    """A browser; skips where there is none, or no playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("needs a browser: apt-get install chromium")
    with playwright.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=found, args=[f"--{flag}" for flag in (*FLAGS, "no-first-run")])
        yield browser
        browser.close()


class Tab(NamedTuple):
    """A tab of its own context, and what happened in it that should not, and all that it has asked for."""

    page: Any
    wrong: list[str]
    asked: list[str]


def new_tab(browser, clock=False, **options):
    """A tab with the options of a context; with a clock that stands still until it is told to run, if asked for."""
    tab = Tab(browser.new_context(**options).new_page(), [], [])
    tab.page.set_default_timeout(10_000)
    tab.page.on("console", lambda message: tab.wrong.append(message.text))
    tab.page.on("pageerror", lambda error: tab.wrong.append(str(error)))
    tab.page.on("request", lambda request: tab.asked.append(request.url))
    if clock:
        tab.page.clock.install(time=0)
        tab.page.clock.pause_at(1000)
    return tab


def scrub(tab, frame):
    tab.eval_on_selector("#scrub", "(e, frame) => { e.value = frame; e.dispatchEvent(new Event('input')); }", frame)


def frame_of(tab):
    return int(tab.input_value("#scrub"))


def seen(tab, selector=".views"):
    """The picture of a part of the page."""
    return tab.locator(selector).first.screenshot()


def pixel(tab, canvas, x, y):
    """Red, green, blue of a canvas at fractions of its width and height, from the left and from the top."""
    code = """(c, [x, y]) => {
      const copy = new OffscreenCanvas(1, 1).getContext("2d"); // reading the canvas itself would slow it down
      copy.drawImage(c, -Math.floor(x * c.width), -Math.floor(y * c.height));
      return [...copy.getImageData(0, 0, 1, 1).data].slice(0, 3);
    }"""
    return tuple(tab.eval_on_selector(canvas, code, [x, y]))


def stage_pixel(tab, data, x, y):
    """Of the stage, at metres of the plane, y up; the stage is as wide and as high as the view."""
    left, low, right, high = data["player"]["view"]
    return pixel(tab, "#stage", (x - left) / (right - left), (high - y) / (high - low))


def computed(tab, names, expression, argument=None):
    """The value of JavaScript that uses the functions of some of the page's modules."""
    code = bundle(PARTS, *(f"{name}.js" for name in names))
    return tab.evaluate(f"(argument) => {{ {code}; return {expression}; }}", argument)


class Server(ThreadingHTTPServer):
    """Serves one page, and counts what else is asked for."""

    def __init__(self, text):
        super().__init__(("127.0.0.1", 0), Handler)
        self.text, self.asked = text.encode(), set()
        self.url = f"http://127.0.0.1:{self.server_port}/"
        Thread(target=self.serve_forever, daemon=True).start()


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        if self.path == "/":
            self.wfile.write(self.server.text)
        else:
            self.server.asked.add(self.path)

    do_POST = do_GET

    def log_message(self, *_):
        pass


EVERY_WAY = """async () => {
  const make = (name, attributes) => Object.assign(document.createElement(name), attributes);
  const add = (name, attributes) => document.body.appendChild(make(name, attributes));
  for (const name of ["img", "script", "iframe", "embed", "video"]) add(name, { src: `/${name}` });
  add("link", { rel: "stylesheet", href: "/style" });
  add("iframe", { name: "frame" });
  add("form", { action: "/form", method: "post", target: "frame" }).submit();
  navigator.sendBeacon("/beacon");
  return fetch("/fetch").then(() => "sent", () => "refused");
}"""
