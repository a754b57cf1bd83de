"""What docs/lesson.md refers to is there: files, names in them, and commands; and its formulas are well formed."""

import ast
import re
import shlex
from pathlib import Path

import pytest

from jaxpg.config.parsing import compose

ROOT = Path(__file__).parent.parent
LESSON = (ROOT / "docs" / "lesson.md").read_text(encoding="utf-8")

REFERENCE = re.compile(r"([\w./-]+\.\w+):(.+)")
FILE = re.compile(r"[\w.-]+(?:/[\w.-]+)+")


def prose(text):
    """The text without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def spans(text):
    """What stands in backticks."""
    return re.findall(r"`([^`\n]+)`", prose(text))


def references(text):
    """The `path:name` in backticks, as pairs."""
    return [match.groups() for match in map(REFERENCE.fullmatch, spans(text)) if match]


def defined(tree):
    """Functions, classes and variables of a module, by name."""
    names = set()
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            names.add(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}
    return names


def missing(text):
    """The references to names that are not defined, and the paths of files that do not exist."""
    wrong = []
    for path, name in references(text):
        file = ROOT / path
        if not file.is_file() or name not in defined(ast.parse(file.read_text(encoding="utf-8"))):
            wrong.append(f"{path}:{name}")
    wrong += [span for span in spans(text) if FILE.fullmatch(span) and not (ROOT / span).is_file()]
    wrong += [link for link in re.findall(r"\]\(([^)#]+)\)", text) if not (ROOT / "docs" / link).is_file()]
    return wrong


def commands(text):
    """The arguments of every `python -m jaxpg.train ...`, in a block or in backticks."""
    lines = re.findall(r"python -m jaxpg\.train([^`\n]*)", text)
    return [shlex.split(line) for line in lines]


def rows(text):
    """The options in the table of estimators."""
    return [shlex.split(options) for options in re.findall(r"^\|[^|]*\| `(algo=[^`]+)` \|", text, re.MULTILINE)]


def displayed(text):
    """The formulas between $$ lines, which stand alone on theirs."""
    return re.findall(r"^\$\$\n(.*?)^\$\$$", text, re.DOTALL | re.MULTILINE)


def inline(text):
    """The formulas between single dollars, outside code and displayed formulas."""
    text = re.sub(r"^\$\$$.*?^\$\$$", "", prose(text), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"\$([^$]+)\$", re.sub(r"`[^`\n]+`", "", text))


def unbalanced(formula):
    """What is opened and not closed, or the other way round."""
    problems = []
    open_braces = 0
    for brace in re.findall(r"(?<!\\)[{}]", formula):
        open_braces += 1 if brace == "{" else -1
        if open_braces < 0:
            break
    if open_braces != 0:
        problems.append("braces")
    for left, right in ((r"\\left(?![a-z])", r"\\right(?![a-z])"), (r"\\lVert", r"\\rVert"), (r"[\[(]", r"[\])]")):
        if len(re.findall(left, formula)) != len(re.findall(right, formula)):
            problems.append(left)
    return problems


def test_references_exist():
    assert missing(LESSON) == []


def test_the_page_refers_to_code_tests_and_results():
    found = {f"{path}:{name}" for path, name in references(LESSON)}
    assert len(found) >= 30
    for folder in ("jaxpg/", "envs/", "tests/"):
        assert sum(reference.startswith(folder) for reference in found) >= 10, folder
    assert any(span.startswith("experiments/results/") for span in spans(LESSON))


@pytest.mark.parametrize(
    "wrong",
    [
        "`jaxpg/returns.py:discounted_return`",
        "`jaxpg/returns.py:Returns.of`",
        "`jaxpg/return.py:discounted_returns`",
        "`tests/test_returns.py:test_nothing`",
        "`experiments/results/nothing.json`",
        "![a figure](../experiments/results/nothing.png)",
    ],
)
def test_a_wrong_reference_is_seen(wrong):
    assert len(missing(f"Code: {wrong}.")) == 1


def test_right_references_are_not_reported():
    text = (
        "`jaxpg/returns.py:td_errors`, `jaxpg/program/algorithms.py:BASELINES`, `jaxpg/online.py:Traces`, "
        "`jaxpg/losses.py`"
    )
    assert len(references(text)) == 3
    assert missing(text) == []


def test_commands_compose():
    found = commands(LESSON)
    assert ["env=quadratic", "algo=reinforce"] in found
    assert len(found) >= 10
    for arguments in found:
        compose(arguments)


def test_options_of_the_estimators_compose():
    found = rows(LESSON)
    assert len(found) >= 12
    for arguments in found:
        compose(["env=quadratic", *arguments])


@pytest.mark.parametrize("wrong", ["algo.baselin=none", "algo=reinforced", "algo.gamma=2"])
def test_a_wrong_option_is_seen(wrong):
    (arguments,) = commands(f"```bash\npython -m jaxpg.train env=quadratic {wrong}\n```")
    with pytest.raises(Exception, match=re.escape(wrong.partition("=")[0])):
        compose(arguments)


def test_formulas_are_balanced():
    formulas = displayed(LESSON)
    assert len(formulas) >= 20
    assert 2 * len(formulas) == LESSON.count("$$")
    assert {formula: unbalanced(formula) for formula in formulas + inline(LESSON) if unbalanced(formula)} == {}


@pytest.mark.parametrize("wrong", [r"\frac{1}{2", r"a}{b", r"\left[ x ]", r"\lVert x", "f(x"])
def test_an_unbalanced_formula_is_seen(wrong):
    assert unbalanced(wrong)


def test_formulas_are_rendered():
    """Blank lines around displayed ones; nothing in them that Markdown reads first or that GitHub does not know."""
    lines = ["", *LESSON.splitlines(), ""]
    marks = [i for i, line in enumerate(lines) if "$$" in line]
    assert all(lines[i] == "$$" for i in marks)
    for start, end in zip(marks[::2], marks[1::2], strict=True):
        assert (lines[start - 1], lines[end + 1]) == ("", ""), lines[start + 1]
        # A line that begins so is a list item or a heading to Markdown.
        assert not any(re.match(r"\s*([-+*#>=]|\d+\.)(\s|$)", line) for line in lines[start + 1 : end])
    for formula in displayed(LESSON) + inline(LESSON):
        assert not re.search(r"\\(boldsymbol|operatorname|bm|def|newcommand)\b", formula), formula
        assert not re.search(r"\\[^A-Za-z]|[*<>`]", formula), formula  # escapes and tags of Markdown
        assert not re.search(r"(?<![\w\s])_|\s_", formula), formula  # would begin emphasis


def test_lines_are_short():
    """But for the table, the displayed formulas and the commands, whose lines cannot be broken."""
    outside = re.sub(r"^\$\$$.*?^\$\$$|^```bash$.*?^```$", "", LESSON, flags=re.DOTALL | re.MULTILINE)
    assert [line for line in outside.splitlines() if len(line) > 120 and not line.startswith("|")] == []
