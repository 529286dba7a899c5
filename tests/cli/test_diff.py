"""`relightcli diff` from the outside: exit codes, and what is printed."""

import json
import os

import numpy as np
import pytest
from click.testing import CliRunner

from relightcli.adapters.images import write_image
from relightcli.cli.diff import command
from relightcli.errors import InputError


@pytest.fixture
def files(tmp_path):
    picture = np.full((4, 5, 3), 0.5, np.float32)
    write_image(tmp_path / "a.exr", picture * np.float32(1.01))
    write_image(tmp_path / "b.exr", picture)
    return [str(tmp_path / "a.exr"), str(tmp_path / "b.exr")]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ([], 1),
        (["--fail", "0.02"], 0),
        (["--fail", "0.005"], 1),
        (["--metric", "psnr", "--fail", "30"], 0),
        (["--metric", "relrmse", "--metric", "psnr", "--fail", "relrmse=0.02", "--fail", "psnr=50"], 1),
        (["--metric", "relrmse", "--metric", "psnr", "--fail", "relrmse=0.02"], 0),  # psnr is reported only
        (["--tolerance", "0.02"], 0),
        (["--metric", "psnr", "--tolerance", "0.005"], 1),
        (["--dry-run"], 0),
        (["--fail", "0.005", "--fail-percent", "50"], 1),
        (["--metric", "ssim"], 2),
        (["--fail-percent", "101"], 2),
    ],
)
def test_exit_codes(files, options, code):
    assert CliRunner().invoke(command, [*files, *options]).exit_code == code


def test_json_is_one_object(files):
    result = CliRunner().invoke(command, [*files, "--json", "--metric", "rmse", "--metric", "psnr", "--metric", "rmse"])
    answer = json.loads(result.stdout)
    assert answer["kind"] == "image"
    assert answer["passed"] is False
    assert answer["fail"] == {"rmse": 0.0, "psnr": "Infinity"}
    assert answer["items"][0]["metrics"]["rmse"] == pytest.approx(0.005, rel=1e-4)  # float32 of 0.505 less 0.5
    assert answer["items"][0]["percent_beyond"] == {"rmse": 100.0, "psnr": 100.0}


def test_quiet_prints_nothing_but_answers_by_exit_code_and_json(files):
    answer = CliRunner().invoke(command, [*files, "-q"])
    assert (answer.exit_code, answer.output) == (1, "")
    assert json.loads(CliRunner().invoke(command, [*files, "-q", "-v", "--json"]).stdout)["passed"] is False


def test_dry_run_names_the_pairs(files):
    answer = json.loads(CliRunner().invoke(command, [*files, "--dry-run", "--json"]).stdout)
    assert answer["items"] == {"a.exr": sum(os.path.getsize(file) for file in files)}
    assert CliRunner().invoke(command, [files[0], "none.exr", "--dry-run"]).exception is not None


def test_text_says_what_failed(files):
    result = CliRunner().invoke(command, [*files, "--fail", "0.005"])
    assert result.stdout == (
        "a.exr: relrmse 0.01  FAILED\n  relrmse is 0.01; expected at most 0.005.\nfailed: 1 of 1\n"
    )


def test_bad_input_reaches_the_caller(files):
    result = CliRunner().invoke(command, [files[0], "none.exr"])
    assert isinstance(result.exception, InputError)
