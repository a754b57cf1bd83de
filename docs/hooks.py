"""For `mkdocs build`: the figures stay in experiments/results, where the scripts that draw them write them.

On GitHub the pages' links lead there; on the site, which has docs/ only, they lead to copies in figures/.
"""

from pathlib import Path

from mkdocs.structure.files import File

RESULTS = Path(__file__).parent.parent / "experiments" / "results"


def on_files(files, config):
    for path in sorted(RESULTS.glob("*.png")):
        files.append(File.generated(config, f"figures/{path.name}", abs_src_path=str(path)))
    return files


def on_page_markdown(markdown, **_):
    return markdown.replace("](../experiments/results/", "](figures/")
