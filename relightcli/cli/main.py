"""The command line's root: subcommands load when called, errors become exit codes."""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import signal
import sys
import warnings
from importlib import import_module
from types import FrameType
from typing import Any

import click

from relightcli import __version__
from relightcli.cli.exits import INTERRUPTED, exit_code

# Name, module, one line for --help. The modules are imported only when their command runs.
COMMANDS = {
    "precompute": "Simulate the light transport of a scene once: SCENE.toml to a transfer store.",
    "cluster": "Group receivers and find a basis for their light: a transfer store to a clusters store.",
    "factorize": "Compress the transfer tensors of a clusters store into a self-contained asset.",
    "fit-pose": "Learn from a transfer store what skinned objects see in any pose.",
    "relight": "Make pictures from a store: new sky, camera, materials, sequences.",
    "diff": "Compare images, sequences or stores; exit 1 when they differ too much.",
    "tradeoff": "Measure what accuracy costs in time and bytes, as table, plots and page.",
    "inspect": "Show what a store holds, what it cost, and whether it is sound.",
}


class LazyGroup(click.Group):
    """A group that knows its commands' names and imports one of them at most."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        command: click.Command = import_module(f"relightcli.cli.{name.replace('-', '_')}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))


@click.command(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="relightcli")
def group() -> None:
    """Simulate light transport once, then make each new picture in a fraction of a second with a known error."""


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Exit codes are those of interface.md: 0, 1 (diff), 2, 3, 4, 5, 130.

    Ends the process without taking the interpreter down module by module, which costs a third of a second after a
    picture: what the exit handlers do is done, files are closed, the rest is memory.
    """
    given = sys.argv[1:] if arguments is None else arguments
    if not _is_verbose(given):
        # After an interruption zarr's event loop complains, with tracebacks, about what it was about to do.
        sys.unraisablehook = lambda _: None
        warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    code = run(given)
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _is_verbose(arguments: list[str]) -> bool:
    return any(a == "--verbose" or (a.startswith("-v") and a.strip("v") == "-") for a in arguments)


def run(arguments: list[str]) -> int:
    """Runs one command line and returns its exit code; prints errors to stderr, tracebacks only with -v."""
    signal.signal(signal.SIGTERM, _interrupt)
    _occupy_closed_streams()
    verbose = _is_verbose(arguments)
    # After an error zarr's event loop complains, with tracebacks, about the chunks that nobody waits for any more.
    logging.getLogger("asyncio").disabled = not verbose
    try:
        result: Any = group.main(arguments, prog_name="relightcli", standalone_mode=False)
        sys.stdout.flush()
        return result if isinstance(result, int) else 0
    except click.exceptions.Exit as stop:
        return int(stop.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return 2
    except (click.exceptions.Abort, KeyboardInterrupt):
        return _interrupted()
    except click.ClickException as error:
        error.show()
        return 2
    except (BrokenPipeError, SystemExit):
        # A closed pipe, which click turns into an exit; nothing else here raises one.
        _drop_stdout()
        return 0
    except BaseException as error:
        if _by_signal(error):
            return _interrupted()
        if verbose:
            import traceback

            traceback.print_exc()
        code, message = exit_code(error)
        click.echo(f"relightcli: {message}", err=True)
        try:
            sys.stdout.flush()
        except OSError:  # the interpreter would try again at exit, and end with another code
            sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return code


def _by_signal(error: BaseException | None) -> bool:
    """Whether it comes of a signal: of one that arrives while compiled code returns, Python makes a SystemError."""
    while isinstance(error, SystemError):
        error = error.__cause__
    return isinstance(error, KeyboardInterrupt)


def _interrupted() -> int:
    click.echo("relightcli: interrupted; finished blocks are kept, run the same command again to continue", err=True)
    return INTERRUPTED


def _occupy_closed_streams() -> None:
    """Standard streams that the caller closed are taken up, lest the next file gets their number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is not None:
            continue
        with contextlib.suppress(OSError):
            os.fstat(number)
            continue
        os.open(os.devnull, os.O_WRONLY if name == "stdin" else os.O_RDONLY)  # takes the lowest free number
        if name == "stdout":
            sys.stdout = open(number, "w", closefd=False)  # noqa: SIM115
        elif name == "stderr":
            sys.stderr = open(os.devnull, "w")  # noqa: SIM115


def _drop_stdout() -> None:
    """The reader of stdout has gone (head, a closed pager): what is still to be flushed at exit goes nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
