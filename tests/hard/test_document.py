"""docs/hard-cases.md names every hard case, and every test that it names exists."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from benchmarks.numerics.table import cases as kernels
from tests.hard.cases import CASES, nodes
from tests.hard.document import PAGE, ROOT, replace, table


def functions(path):
    return {n.name for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)}


@pytest.mark.parametrize("node", nodes())
def test_named_tests_exist(node):
    path, name = node.split("::")
    found = functions(ROOT / path)
    assert any(f.startswith(name[:-1]) for f in found) if name.endswith("*") else name in found


def test_no_hard_test_is_left_out():
    named = {node.split("::")[1] for node in nodes()}
    own = {
        name
        for path in sorted(Path(__file__).parent.glob("test_*.py"))
        if path.name != "test_document.py"
        for name in functions(path)
        if name.startswith("test_")
    }
    assert own - named == {"test_hard_meshes_large"}  # the larger files of the same folder


def test_the_page_has_every_case_and_kernel():
    text = PAGE.read_text()
    for section, cases in CASES.items():
        assert f"### {section}\n" in text
        for case, tests in cases:
            assert f"| {case} | `{tests[0]}` |" in text
            for test in tests:
                assert f"`{test}`" in text
    for one in kernels():
        assert f"| {one.kernel} |" in text
    assert "FAILED" not in text


def test_what_was_not_run_stays_as_it_was():
    ran, other = nodes()[:2]
    rows = [{"node": f"{ran}[a]", "outcome": "passed", "figures": [["x", 0.5, 1.0]]}]
    page = table([{"node": other, "outcome": "passed", "figures": [["y", 2.0, 4.0]]}])
    text = table(rows, page)
    assert f"`{ran}` | 1 passed | x: 0.5, at most 1 |" in text
    assert f"`{other}` | 1 passed | y: 2, at most 4 |" in text
    assert text.count("passed") == 2
    assert table([], PAGE.read_text()) in PAGE.read_text()


def test_a_failure_shows():
    node = nodes()[0]
    rows = [{"node": f"{node}[a]", "outcome": "failed", "figures": [["x", 2.0, 1.0], ["y", 0.1, 1.0]]}]
    text = table(rows)
    assert "1 FAILED" in text
    assert "x: 2, at most 1 |" in text
    assert "not run" in text
    assert replace("<!-- a: begin -->\nold\n<!-- a: end -->", "a", "new") == "<!-- a: begin -->\nnew\n<!-- a: end -->"
    with pytest.raises(ValueError, match="expected the lines"):
        replace("no marks", "a", "new")
