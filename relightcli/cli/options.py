"""Options that several commands share, and how their results are told."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import click

from relightcli import __version__

Command = Callable[..., Any]
SEED = click.IntRange(0, 2**63 - 1)
# What may not be read is a system error (5), not bad usage (2); the stages say so.
PATH = click.Path(path_type=Path, readable=False)


class Url(type(Path())):  # type: ignore[misc]
    """A URL that goes through the stages as a path does: no file of this machine, and spelled as it was given."""

    def __new__(cls, url: str) -> Url:
        self: Url = super().__new__(cls, url)
        self._url = url
        return self

    def __str__(self) -> str:
        return str(getattr(self, "_url", None) or super().__str__())

    def __fspath__(self) -> str:
        return str(self)

    def __reduce__(self) -> tuple[type[Url], tuple[str]]:
        return Url, (str(self),)


def store_path(value: str) -> Path:
    """A store: a path, or a URL."""
    if value.startswith("file://"):
        return Path(unquote(urlsplit(value).path))
    return Url(value) if "://" in value else Path(value)


def available_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def output(help: str) -> Callable[[Command], Command]:
    return click.option("-o", "--output", required=True, type=store_path, help=help)


def workers(command: Command) -> Command:
    return click.option(
        "--workers", type=click.IntRange(1, 1024), default=None, help="Worker processes. Default: all cores."
    )(command)


def no_seed(command: Command) -> Command:
    """For scripts that give every stage the same options."""
    return click.option(
        "--seed", type=SEED, expose_value=False, help="As other stages take it; this one draws nothing at random."
    )(command)


def no_workers(command: Command) -> Command:
    """For scripts that give every stage the same options."""
    return click.option(
        "--workers", type=click.IntRange(1, 1024), expose_value=False, help="As stages take it; one process does it."
    )(command)


def scheduler(command: Command) -> Command:
    return click.option(
        "--scheduler",
        default=None,
        metavar="ADDRESS",
        help="Dask scheduler, e.g. tcp://host:8786, whose workers run the blocks instead of local processes.",
    )(command)


def note_no_blocks(result: dict[str, Any], scheduler: str | None) -> None:
    """Tells the user that there was nothing for a scheduler to do."""
    if scheduler is not None:
        result["notes"].append("--scheduler: this work is not made of blocks; it is done here, in --workers threads")


def overwrite(command: Command) -> Command:
    return click.option("--overwrite", is_flag=True, help="Replace a store made from other inputs or settings.")(
        command
    )


def report(command: Command) -> Command:
    """--json, -q, -v, --version."""
    command = click.version_option(__version__, prog_name="relightcli")(command)
    command = click.option("-v", "--verbose", is_flag=True, help="Show tracebacks and details.")(command)
    command = click.option("-q", "--quiet", is_flag=True, help="No progress, no summary.")(command)
    return click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout, nothing else.")(command)


def tell(result: dict[str, Any], text: str, as_json: bool, quiet: bool) -> None:
    """The result as JSON on stdout, or a summary on stderr."""
    if as_json:
        click.echo(json.dumps(result, allow_nan=False))
    elif not quiet:
        click.echo(text, err=True)


def predicted_text(result: dict[str, Any]) -> str:
    """What a dry run says of costs."""
    cost = result["predicted"]
    return f"predicted {cost['seconds']:.1f} s, {bytes_text(cost['bytes'])}"


def bytes_text(count: float) -> str:
    """1234567 as '1.2 MB'."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
