"""The rules that hold for every file: style, types, directions of imports, length, docstrings, layout."""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "uav_dc_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))
LONGEST = 400
FILES_MAX = 15  # in a folder

CHECKS = {
    "ruff check": ["-m", "ruff", "check", "."],
    "ruff format": ["-m", "ruff", "format", "--check", "."],
    "mypy": ["-m", "mypy"],
    # import-linter has no __main__.
    "import contracts": ["-c", "import importlinter.cli as cli; cli.lint_imports_command()"],
}


@pytest.mark.parametrize("check", CHECKS)
def test_tool_has_nothing_to_say(check):
    done = subprocess.run(
        [sys.executable, *CHECKS[check]], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{check}:\n{done.stdout}{done.stderr}"


def test_the_modules_were_found():
    assert {"radio.py", "world.py", "scenario.py"} <= {path.name for path in MODULES}


def test_a_file_can_be_read_in_one_sitting():
    lines = {str(path.relative_to(ROOT)): len(path.read_text("utf-8").splitlines()) for path in MODULES}
    assert {name: n for name, n in lines.items() if n > LONGEST} == {}


def test_a_public_class_name_stands_for_one_thing_and_no_folder_is_a_corridor():
    names = [
        node.name
        for path in MODULES
        for node in ast.parse(path.read_text("utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    assert [name for name, count in Counter(names).items() if count > 1] == []
    # The package's own folder holds the commands and what all rooms share.
    folders = Counter(
        path.parent for path in MODULES if path.name != "__init__.py" and path.parent != PACKAGE
    )
    assert {str(folder): count for folder, count in folders.items() if count > FILES_MAX} == {}


def undocumented(tree, prefix=""):
    """Names of public modules, classes, functions and methods without a docstring."""
    if isinstance(tree, ast.Module) and not ast.get_docstring(tree):
        yield "the module"
    for node in tree.body:
        if not isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if node.name.startswith("_"):
            continue
        name = f"{prefix}{node.name}"
        if not ast.get_docstring(node):
            yield name
        if isinstance(node, ast.ClassDef):
            yield from undocumented(node, f"{name}.")


def test_everything_public_has_a_docstring():
    missing = {
        str(path.relative_to(ROOT)): list(undocumented(ast.parse(path.read_text("utf-8"))))
        for path in MODULES
    }
    assert {name: names for name, names in missing.items() if names} == {}


def test_the_check_for_docstrings_finds_what_is_missing():
    source = "def f(): 1\nclass C:\n    'doc'\n    def m(self): 1\n    def _p(self): 1\n"
    assert list(undocumented(ast.parse(source))) == ["the module", "f", "C.m"]


# Words that a reader has to interpret. The field's: report or log (tell), receive (hear), publish (say),
# request (ask), no node (nobody), any node that (whoever).
REFUSED = re.compile(
    r"(?<![a-z])(told|tells?|telling|heard|hears?|hearing|says?|said|saying|asks?|asked|asking|nobody|somebody"
    r"|whoever|deaf|wish(?:es)?|wished|utters?|uttered)(?![a-z])",
    re.IGNORECASE,
)
ALLOWED = {"bags/part_writer.py": ["tell"]}  # a method of Python's files


def refused(source):
    """Refused words of names, docstrings, comments, log lines and errors, each with its line."""
    return [
        (i, found[1])
        for i, line in enumerate(source.splitlines(), start=1)
        for found in REFUSED.finditer(line)
    ]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_words_are_the_field_s(path):
    allowed = ALLOWED.get(str(path.relative_to(PACKAGE)), [])
    assert [found for found in refused(path.read_text("utf-8")) if found[1] not in allowed] == []


def test_the_check_for_words_finds_them_in_names_and_text():
    source = "def tell_all(): ...\nclass Hearing: ...\nx = 'nobody said so'\n# mask, essay, basket, retold\n"
    assert [word for _, word in refused(source)] == ["tell", "Hearing", "nobody", "said"]
