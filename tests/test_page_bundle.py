"""The modules of the page's script, joined into one (what the result does: test_page_in_browser.py)."""

import pytest

from jaxpg.watch.bundle import BundleError, bundle


@pytest.fixture
def joined(tmp_path):
    """`joined(main=..., other=...)`: the lines of the script of `main` that are not empty."""

    def of(*entries, **texts):
        for name, text in texts.items():
            (tmp_path / f"{name}.js").write_text(text, encoding="utf-8")
        return [line for line in bundle(tmp_path, *(entries or ["main.js"])).splitlines() if line]

    return of


A_ALONE = "export const a = 1;\n"
B_OF_A = 'import { a } from "./a.js";\nexport const b = a + 1;\n'


def test_a_module_comes_once_after_what_it_imports(joined):
    """The names of the files would give another order, as would the order of the imports in main.js alone."""
    main = 'import { z } from "./z.js";\nimport { b } from "./b.js";\nstart(z, b);\n'
    z = 'import { b } from "./b.js";\nexport const z = b;\n'
    expected = ["const a = 1;", "const b = a + 1;", "const z = b;", "start(z, b);"]
    assert joined(main=main, z=z, b=B_OF_A, a=A_ALONE) == expected


def test_of_two_imports_the_first_comes_first(joined):
    main = 'import { y } from "./y.js";\nimport { a } from "./a.js";\n'
    assert joined(main=main, y="export const y = 2;\n", a=A_ALONE) == ["const y = 2;", "const a = 1;"]


def test_what_nobody_imports_is_left_out(joined):
    assert joined(main="start();\n", a=A_ALONE) == ["start();"]


def test_several_entries_share_what_they_import(joined):
    c = 'import { a } from "./a.js";\nexport const c = -a;\n'
    assert joined("c.js", "b.js", a=A_ALONE, b=B_OF_A, c=c) == ["const a = 1;", "const c = -a;", "const b = a + 1;"]


def test_every_declaration_loses_its_export_and_nothing_else_changes(joined):
    kept = ["// export const no = 1;", "function f() {", '  return "export function g() {}";', "}"]
    declarations = ["async function g() {}", "function* h() {}", "let i = 0;", "class J {}", "const $k = 1;"]
    code = "\n".join([*kept, *(f"export {line}" for line in declarations)])
    assert joined(main=code) == [*kept, *declarations]


def test_an_import_may_have_several_lines(joined):
    main = 'import {\n  f,\n  g,\n} from "./other.js";\nf(g);\n'
    other = "export function f() {}\nexport const g = 1;\n"
    assert joined(main=main, other=other) == ["function f() {}", "const g = 1;", "f(g);"]


@pytest.mark.parametrize("start", ["main.js", "a.js"])
def test_a_cycle_is_refused_and_shown(joined, start):
    texts = {
        "main": 'import { a } from "./a.js";\n',
        "a": 'import { b } from "./b.js";\nexport const a = 1;\n',
        "b": 'import { a } from "./a.js";\nexport const b = 1;\n',
    }
    with pytest.raises(BundleError, match=r"a\.js imports b\.js imports a\.js$"):
        joined(start, **texts)


def test_a_module_that_imports_itself_is_a_cycle(joined):
    with pytest.raises(BundleError, match=r"main\.js imports main\.js$"):
        joined(main='import { a } from "./main.js";\nexport const a = 1;\n')


def test_a_missing_file_is_named_with_who_wants_it(joined):
    with pytest.raises(BundleError, match=r"^b\.js imports a\.js, which is not there$"):
        joined(main='import { b } from "./b.js";\n', b=B_OF_A)


@pytest.mark.parametrize("other", ["const a = 1;\n", "export const ab = 1;\n", "  export const a = 1;\n", "// a\n"])
def test_a_name_that_is_not_exported_is_refused(joined, other):
    with pytest.raises(BundleError, match=r"^main\.js imports a, which other\.js does not export$"):
        joined(main='import { a } from "./other.js";\n', other=other)


def test_a_name_is_imported_from_where_it_is_and_not_from_where_it_is_used(joined):
    with pytest.raises(BundleError, match=r"^main\.js imports a, which b\.js does not export$"):
        joined(main='import { a, b } from "./b.js";\n', b=B_OF_A, a=A_ALONE)


@pytest.mark.parametrize("mine", ["const f = 1;", "let f = 1;", "class f {}", "async function f() {}"])
@pytest.mark.parametrize("export", ["", "export "])
def test_a_name_of_two_modules_is_refused(joined, mine, export):
    main = f'import {{ g }} from "./other.js";\n{mine}\n'
    with pytest.raises(BundleError, match=r"^other\.js and main\.js both have f$"):
        joined(main=main, other=f"{export}function f() {{}}\nexport const g = f;\n")


def test_names_within_functions_may_be_those_of_other_modules(joined):
    other = "export function f() {\n  const g = 1;\n  return g;\n}\n"
    assert joined(main='import { f } from "./other.js";\nconst g = f();\n', other=other)[-1] == "const g = f();"


@pytest.mark.parametrize(
    "line",
    [
        'import { a as b } from "./other.js";',
        'import "./other.js";',
        'import other from "./other.js";',
        'import * as other from "./other.js";',
        'import { a } from "./folder/other.js";',
        'import { a } from "other";',
        "export default 1;",
        "export { a };",
        'export * from "./other.js";',
        "var a = 1;",
        "const { a } = window;",
        "let [a] = window;",
    ],
)
def test_other_forms_are_refused(joined, line):
    with pytest.raises(BundleError, match=r"main\.js"):
        joined(main=f"{line}\n", other=A_ALONE)
