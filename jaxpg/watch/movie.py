"""Writes images as a video: MP4 (H.264) with PyAV, GIF with Pillow.

Both keep exact time: MP4 at any frame rate; GIF, whose clock ticks every 1/100 s, with delays that differ by a tick, so
that no error accumulates.
"""

from __future__ import annotations

import contextlib
import importlib.util
import itertools
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envs.hints import pip_install
from jaxpg.errors import UserError
from jaxpg.store.run_files import replace

TICK = Fraction(1, 100)  # of a GIF's clock [s]
MIN_TICKS = 2  # per picture: browsers slow down a GIF with 1
QUALITY = "18"  # H.264's constant rate factor: 0 loses nothing, 51 is the worst


class Format(NamedTuple):
    """A video format.

    Attributes:
      write: `write(path, images, seconds)`: images `[H, W, 3]`, H and W even, each shown for `seconds`.
      fastest: the highest frame rate, in images per second.
      package: the package it needs, or None.
    """

    write: Callable[[Path, Iterable[np.ndarray], Fraction], None]
    fastest: int
    package: str | None


def find_format(out: Path) -> Format:
    """The format for a file's ending.

    Raises:
      UserError: the ending is unknown, a folder has that name, or the format's package is not installed.
    """
    form = FORMATS.get(out.suffix.lower())
    if form is None:
        raise UserError(f"out={out}: must end in {' or '.join(FORMATS)}")
    if out.is_dir():
        raise UserError(f"out={out}: a folder has that name")
    if form.package and importlib.util.find_spec(form.package) is None:
        remedy = f"{pip_install(form.package)}; out=FILE.gif needs none"
        raise UserError(f"out={out}: {out.suffix} needs a package, {remedy}")
    return form


def write(out: Path, images: Iterable[np.ndarray], seconds: Fraction) -> None:
    """Writes a video in the format of its ending, atomically.

    Args:
      out: the file; missing parent folders are created.
      images: each `[H, W, 3]`, H and W even.
      seconds: how long each is shown.

    Raises:
      UserError: as in `find_format`, or the file cannot be written.
    """
    form = find_format(out)
    with _replace_file(out) as unfinished:
        form.write(unfinished, images, seconds)


@contextlib.contextmanager
def _replace_file(path: Path) -> Iterator[Path]:
    """Yields a temporary path; what is written there replaces the file after the block."""
    try:
        with tempfile.TemporaryDirectory() as place:
            unfinished = Path(place, "movie")
            yield unfinished
            content = unfinished.read_bytes()
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"out={path}: cannot be written ({error.strerror or error})") from error
    try:
        replace(path, content)
    except UserError as error:
        raise UserError(f"out={error}") from error


def _write_mp4(path: Path, images: Iterable[np.ndarray], seconds: Fraction) -> None:
    import av

    images = iter(images)
    first = next(images)
    with path.open("wb") as file, av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=1 / seconds, options={"crf": QUALITY})
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"  # every player knows it; one colour for 2 x 2 pixels
        for image in itertools.chain([first], images):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")))
        container.mux(stream.encode())


def _write_gif(path: Path, images: Iterable[np.ndarray], seconds: Fraction) -> None:
    from PIL import Image

    pictures = [Image.fromarray(image).quantize(method=Image.Quantize.FASTOCTREE) for image in images]
    milliseconds = [10 * delay for delay in compute_delays(len(pictures), seconds)]
    first, *rest = pictures
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=milliseconds, loop=0)


def compute_delays(number: int, seconds: Fraction) -> list[int]:
    """How long each picture is shown, in ticks: picture i begins at the tick nearest to i * seconds.

    >>> compute_delays(6, Fraction(1, 30))
    [3, 4, 3, 3, 4, 3]
    """
    begins = [math.floor(i * seconds / TICK + Fraction(1, 2)) for i in range(number + 1)]
    return [end - begin for begin, end in itertools.pairwise(begins)]


FORMATS = {
    ".mp4": Format(_write_mp4, 240, "av"),
    ".gif": Format(_write_gif, int(1 / (MIN_TICKS * TICK)), None),
}
