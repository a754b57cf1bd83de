"""Names as files and programs can take them."""

from __future__ import annotations

import re
import unicodedata

LONGEST = 40  # letters of a name; C compilers may leave those of an identifier after the 63rd unread
# <NAME.h> of C and POSIX: a compiler that looks for headers beside NAME.h would take it for one of them.
SYSTEM_HEADER = re.compile(
    "aio|assert|complex|cpio|ctype|dirent|dlfcn|errno|fcntl|fenv|float|fnmatch|ftw|glob|grp|iconv|inttypes|iso646|"
    "langinfo|libgen|limits|locale|malloc|math|memory|monetary|netdb|poll|pthread|pwd|regex|sched|search|semaphore|"
    "setjmp|signal|spawn|stdalign|stdarg|stdatomic|stdbit|stdbool|stdckdint|stddef|stdint|stdio|stdlib|stdnoreturn|"
    "string|strings|syslog|tar|termios|tgmath|threads|time|uchar|ulimit|unistd|utime|wchar|wctype|wordexp"
)


def identifier(name: str) -> str:
    """What C identifiers and files begin with for this name: ASCII letters, digits and single underscores.

    They always go on (`NAME_command`, `NAME.h`), so a keyword may stand there.

    >>> identifier("humanoid/run-2"), identifier("2link"), identifier("Rücken"), identifier("机"), identifier("math")
    ('humanoid_run_2', 'policy_2link', 'Rucken', 'policy', 'policy_math')
    """
    ascii_letters = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    word = re.sub(r"[^0-9A-Za-z]+", "_", ascii_letters)[:LONGEST].strip("_")
    taken = SYSTEM_HEADER.fullmatch(word.lower())
    return f"policy_{word}".rstrip("_") if not word or word[0].isdigit() or taken else word


def printable(text: str) -> str:
    """A text on one line that can be encoded: what has no printed form becomes an escape.

    >>> print(printable("angle [°]\\nsecond line"))
    angle [°]\\nsecond line
    """
    return "".join(x if x.isprintable() else x.encode("unicode_escape").decode() for x in text)


def in_comment(text: str) -> str:
    """A printable text that neither ends a comment in C, nor begins another, nor joins its line to the next.

    >>> print(in_comment("speed [m/*s] */ ??/"))
    speed [m/ *s] * / ? ?/
    """
    apart = re.sub(r"(?<=\*)(?=/)|(?<=/)(?=\*)|(?<=\?)(?=\?)", " ", printable(text))
    return re.sub(r"\\(\s*)$", r"\\\1.", apart)
