"""A run against the last one: what is judged, what is only told, and what fails."""

import json

import pytest

from benchmarks import __main__ as program
from benchmarks import compare, report

HERE = {"cpu": "one", "cores": 2, "python": "3.11", "packages": {}}


def found(peer=10.0, size=4.0, seconds=2.0, error="2.17 %", about="a thing of 1,000 vertices"):
    """A report with a ratio to a peer, one of a size, and one of a time to its limit; as JSON."""
    out = report.Report(about)
    out.rows += [
        report.faster(f"R = 16, error {error}", 1.0, "s", f"the script: {peer:g} s", peer, 10.0),
        report.faster(f"R = 32, error {error}", 1.0, "s", "the script: 50 s", 50.0, 10.0),
        report.at_most("store", size, "MB", 8.0),
        report.at_most("program", seconds, "s", 8.0),
        report.Row("rays", 5.0, "Mray/s"),
    ]
    return json.loads(json.dumps(out.to_json()))


def changes(now, last, same=True):
    return {change.work: change for change in compare.compare("x", now, last, same)}


@pytest.mark.parametrize(("peer", "lost"), [(8.01, False), (7.99, True), (40.0, False)])
def test_a_fifth_of_a_ratio_may_be_lost(peer, lost):
    change = changes(found(peer), found(10.0))["R = 16, error 2.17 %"]
    assert change.judged
    assert change.lost == lost


def test_ratios_of_sizes_are_judged_and_times_to_limits_told():
    told = changes(found(size=8.0, seconds=8.0), found(size=4.0, seconds=2.0))
    assert told["store"].lost
    assert (told["program"].last, told["program"].now, told["program"].judged) == (4.0, 1.0, False)
    assert not told["program"].lost
    assert "rays" not in told  # has no ratio


def test_rows_are_found_again_by_their_words_without_numbers():
    told = changes(found(peer=1.0, error="3.2 %"), found(peer=10.0, error="2.17 %"))
    assert (told["R = 16, error 3.2 %"].last, told["R = 32, error 3.2 %"].last) == (10.0, 50.0)
    assert [change.lost for change in told.values()] == [True, False, False, False]


def test_what_only_one_run_has_is_told():
    last, now = found(), found()
    gone = last["rows"].pop(2)  # the store's size: new in this run
    del now["rows"][3]  # the program's time: not measured in it
    told = changes(now, last)
    assert (told[gone["work"]].last, told[gone["work"]].now) == (None, 2.0)
    assert (told["program"].last, told["program"].now) == (4.0, None)
    assert [compare.cells(told[work])[-1] for work in ("store", "program")] == ["new", "not measured now"]
    assert not any(change.lost for change in told.values())


@pytest.mark.parametrize("other", ["machine", "scene", "peer"])
def test_other_conditions_are_told_and_not_judged(other):
    now = found(1.0, about="another thing" if other == "scene" else "a thing of 2,000 vertices")
    if other == "peer":
        now["rows"][0]["against"] = "another script: 1 s"
    change = changes(now, found(10.0), same=other != "machine")["R = 16, error 2.17 %"]
    assert (change.last, change.now, change.judged, change.lost) == (10.0, 1.0, False, False)


def test_one_machine():
    assert compare.of_one_machine(HERE, HERE | {"python": "3.12"})
    assert not compare.of_one_machine(HERE, HERE | {"cores": 4})


@pytest.fixture
def bench(tmp_path, monkeypatch, capsys):
    """Runs the program on a benchmark that finds what it is told; returns its exit code and what it said."""

    def ran(command):
        (reply,) = replies
        with open(command[-1], "w") as file:
            json.dump(reply, file)
        return type("Done", (), {"returncode": 0})

    def run(reply, *options):
        replies[:] = [reply]
        given = [
            "benchmarks",
            "store",
            "--output",
            str(tmp_path / "bench.json"),
            "--last",
            str(tmp_path / "l" / "l.json"),
        ]
        monkeypatch.setattr("sys.argv", [*given, *options])
        code = program.main()
        out, error = capsys.readouterr()
        return code, out + error

    replies = []
    monkeypatch.setattr(program, "machine", lambda: HERE)
    monkeypatch.setattr(program.subprocess, "run", ran)
    return run


def test_a_loss_fails_until_it_is_accepted(bench):
    assert bench(found(10.0))[0] == 0  # nothing to compare with
    assert bench(found(9.0))[0] == 0
    code, said = bench(found(7.0))
    assert code == 1
    assert "lost: store: R = 16, error 2.17 %: ratio 9, now 7" in said
    assert "LOST" in said
    assert bench(found(7.0))[0] == 1  # the ratios before the loss are still what counts
    assert bench(found(1.0), "--quick")[0] == 0  # says nothing about speed: not compared, not kept
    assert bench(found(7.0), "--accept")[0] == 0
    assert bench(found(6.0))[0] == 0


def test_without_names_the_long_ones_are_left_out(monkeypatch):
    asked = []
    monkeypatch.setattr(program, "run", lambda names, *rest: asked.append(names) or 0)
    for options in ([], ["--all"], ["pose", "store"]):
        monkeypatch.setattr("sys.argv", ["benchmarks", *options])
        assert program.main() == 0
    assert asked == [list(program.SHORT), list(program.NAMES), ["store", "pose"]]


def test_ratios_into_a_page():
    document = {
        "machine": HERE,
        "runs": {"x": {"quick": False, "report": found()}, "y": {"quick": True, "report": found()}},
    }
    page = f"before\n\n{report.BEGIN}\nold\n{report.END}\nafter\n"
    written = report.put_ratios(page, document)
    assert written.startswith(f"before\n\n{report.BEGIN}\n2 cores, one, Python 3.11\n\n| benchmark | work |")
    assert written.endswith(f"{report.END}\nafter\n")
    assert "| x | store | 4 MB |  | 2 | <= 8 MB | yes |" in written
    assert "old" not in written
    assert "| y |" not in written
    assert report.put_ratios(written, document) == written
    with pytest.raises(ValueError, match="once each"):
        report.put_ratios("no marks", document)
    assert program.DOCUMENT.read_text().count(report.BEGIN) == 1
