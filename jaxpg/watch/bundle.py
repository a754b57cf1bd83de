"""JavaScript modules as one script, for a page that is one file and so has nothing to import from."""

from __future__ import annotations

import re
from pathlib import Path

IMPORT = re.compile(r'^import \{([^}]*)\} from "\./([\w.-]+)";\n', re.MULTILINE)
TOP = re.compile(r"^(export )?(?:(?:async )?function\*?|const|let|class) ([\w$]+)", re.MULTILINE)
# What would stay in the script and stop it, and top-level names that TOP does not see.
UNKNOWN = re.compile(r"^(?:import\b|export\b|var\b|(?:const|let)\s*[\[{]).*", re.MULTILINE)


class BundleError(Exception):
    """The modules cannot be joined; the message names the file."""


def bundle(folder: Path, *entries: str) -> str:
    r"""The modules `entries` of a folder and all that they import, each once and after what it imports.

    All names end in one scope. So imports become superfluous, and no two modules may have a top-level name in common.
    That a module uses nothing without importing it is checked by the linter. Text is matched, not parsed: the forms are
    `import { a, b } from "./file.js";` and `export` before a declaration, each at the beginning of a line.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     _ = Path(folder, "main.js").write_text('import { two } from "./two.js";\nalert(two + 1);')
    ...     _ = Path(folder, "two.js").write_text("export const two = 2;")
    ...     print(bundle(Path(folder), "main.js"))
    const two = 2;
    alert(two + 1);

    Raises:
      BundleError: a cycle, a file that is missing, a name that is imported but not exported, a top-level name of two
        modules, or an import, export or declaration in another form.
    """
    texts: dict[str, str] = {}
    for name in entries:
        _add(texts, folder, name, ())
    owners: dict[str, str] = {}
    for name, text in texts.items():
        for _, top in TOP.findall(text):
            if (owner := owners.setdefault(top, name)) != name:
                raise BundleError(f"{owner} and {name} both have {top}")
    return "\n".join(_plain(name, text) for name, text in texts.items())


def _add(texts: dict[str, str], folder: Path, name: str, above: tuple[str, ...]) -> None:
    """Adds a module's text after those of its imports; `above` are the modules that it is imported through."""
    if name in above:
        raise BundleError(f"a cycle: {' imports '.join((*above, name))}")
    if name in texts:
        return
    if not (folder / name).is_file():
        raise BundleError(f"{above[-1] if above else 'the page'} imports {name}, which is not there")
    text = (folder / name).read_text(encoding="utf-8")
    for names, other in IMPORT.findall(text):
        _add(texts, folder, other, (*above, name))
        exported = {top for export, top in TOP.findall(texts[other]) if export}
        if missing := sorted({one.strip() for one in names.split(",")} - {""} - exported):
            raise BundleError(f"{name} imports {', '.join(missing)}, which {other} does not export")
    texts[name] = text


def _plain(name: str, text: str) -> str:
    """The text without its imports and without the word `export`."""
    text = TOP.sub(lambda found: found[0].removeprefix("export "), IMPORT.sub("", text))
    if unknown := UNKNOWN.search(text):
        raise BundleError(f"{name} cannot be joined because of: {unknown[0]}")
    return text
