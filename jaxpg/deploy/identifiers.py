"""Text made safe for file names, C identifiers and C comments."""

from __future__ import annotations

import re
import unicodedata

MAX_LENGTH = 40  # characters of a name; C compilers may ignore those of an identifier after the 63rd
# Headers of C and POSIX: if NAME.h is on the include path, a compiler would take it for <NAME.h>.
SYSTEM_HEADER = re.compile(
    "aio|assert|complex|cpio|ctype|dirent|dlfcn|errno|fcntl|fenv|float|fnmatch|ftw|glob|grp|iconv|inttypes|iso646|"
    "langinfo|libgen|limits|locale|malloc|math|memory|monetary|netdb|poll|pthread|pwd|regex|sched|search|semaphore|"
    "setjmp|signal|spawn|stdalign|stdarg|stdatomic|stdbit|stdbool|stdckdint|stddef|stdint|stdio|stdlib|stdnoreturn|"
    "string|strings|syslog|tar|termios|tgmath|threads|time|uchar|ulimit|unistd|utime|wchar|wctype|wordexp"
)


def make_identifier(name: str) -> str:
    """The prefix of C identifiers and files for this name: ASCII letters, digits and single underscores.

    Something always follows it (`NAME_command`, `NAME.h`), so it may be a keyword.

    >>> [make_identifier(name) for name in ("humanoid/run-2", "2link", "Rücken", "机", "math")]
    ['humanoid_run_2', 'policy_2link', 'Rucken', 'policy', 'policy_math']
    """
    ascii_letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    word = re.sub(r"[^0-9A-Za-z]+", "_", ascii_letters)[:MAX_LENGTH].strip("_")
    is_header = SYSTEM_HEADER.fullmatch(word.lower())
    return f"policy_{word}".rstrip("_") if not word or word[0].isdigit() or is_header else word


def escape_text(text: str) -> str:
    r"""The text on one line and encodable: characters that cannot be printed are escaped.

    >>> print(escape_text("angle [°]\nsecond line"))
    angle [°]\nsecond line
    """
    return "".join(x if x.isprintable() else x.encode("unicode_escape").decode() for x in text)


def escape_comment(text: str) -> str:
    """The text for a C comment: it neither ends the comment, begins another, nor joins its line to the next.

    >>> print(escape_comment("speed [m/*s] */ ??/"))
    speed [m/ *s] * / ? ?/
    """
    separated = re.sub(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)", " ", escape_text(text))
    return re.sub(r"\\(\s*)$", r"\\\1.", separated)
