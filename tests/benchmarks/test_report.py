"""How benchmark results are told."""

import json
from dataclasses import asdict

import pytest

from benchmarks import __main__ as program
from benchmarks import report


@pytest.fixture
def document():
    found = report.Report("a small thing")
    found.rows += [
        report.at_most("fast", 2.0, "s", 4.0),
        report.at_most("slow", 8.0, "s", 4.0),
        report.faster("new", 0.5, "s", "old: 50 s", 100.0, 100.0),
        report.Row("neither", 12_345.6, "rays"),
    ]
    found.tables.append(report.Table("side by side", ("what", "n", "error"), (("a", 3, 0.01234), ("b", 4, 0.0))))
    found.skipped.append("a peer is not installed")
    return json.loads(json.dumps({"machine": program.machine(), "runs": {"x": run(found)}}))


def run(found):
    return {"quick": True, "seconds": 1.0, "report": found.to_json()}


def test_targets():
    assert asdict(report.at_most("w", 2.0, "s", 4.0)) | {"ratio": 2.0, "met": True, "target": "<= 4 s"} == asdict(
        report.at_most("w", 2.0, "s", 4.0)
    )
    assert not report.at_most("w", 4.1, "s", 4.0).met
    assert report.faster("w", 1.0, "s", "", 10.0, 10.0).met
    assert not report.faster("w", 1.0, "s", "", 9.9, 10.0).met


def test_text(document):
    lines = report.text("x", document["runs"]["x"]["report"]).splitlines()
    assert lines[0] == "== x: a small thing"
    assert lines[3].split() == ["fast", "2", "s", "2", "<=", "4", "s", "yes"]
    assert lines[4].split()[-1] == "NO"
    assert lines[5].split("  ")[-1].strip() == "yes"
    assert lines[6].split() == ["neither", "12,346", "rays"]
    assert "a     3  0.0123" in lines
    assert lines[-1] == "skipped: a peer is not installed"


def test_markdown_tables_have_as_many_cells_as_heads(document):
    text = report.markdown(document)
    assert "(small sizes: `--quick`)" in text
    blocks = [block for block in text.split("\n\n") if block.startswith("|")]
    assert len(blocks) == 2
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1
    assert "| slow | 8 s |  | 0.5 | <= 4 s | NO |" in text


def test_markdown_of_the_last_run(document, tmp_path, capsys, monkeypatch):
    path = tmp_path / "bench.json"
    monkeypatch.setattr("sys.argv", ["benchmarks", "--markdown", "--output", str(path)])
    with pytest.raises(SystemExit) as stop:
        program.main()
    assert stop.value.code == 2
    assert "run the benchmarks first" in capsys.readouterr().err
    path.write_text(json.dumps(document))
    assert program.main() == 0
    assert capsys.readouterr().out.startswith(f"{document['machine']['cores']} cores")


def test_unknown_names_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmarks", "speed"])
    with pytest.raises(SystemExit) as stop:
        program.main()
    assert stop.value.code == 2
    assert "no benchmark named speed" in capsys.readouterr().err


def test_ratios_are_written_into_the_page(document, tmp_path, monkeypatch):
    # The page itself, as it is in the repository: it has the two marks.
    page, path = tmp_path / "performance.md", tmp_path / "bench.json"
    page.write_text(program.DOCUMENT.read_text())
    document["runs"]["full"] = document["runs"]["x"] | {"quick": False}
    path.write_text(json.dumps(document))
    monkeypatch.setattr(program, "DOCUMENT", page)
    monkeypatch.setattr("sys.argv", ["benchmarks", "--document", "--output", str(path)])
    assert program.main() == 0
    once = page.read_text()
    table = once[once.index(report.BEGIN) : once.index(report.END)].splitlines()
    assert "| full | slow | 8 s |  | 0.5 | <= 4 s | NO |" in table
    assert not any("neither" in line or line.startswith("| x ") for line in table)  # no ratio; small sizes
    assert program.main() == 0
    assert page.read_text() == once
