"""One root, four leaves. Only the command line turns them into exit codes (`relightcli.cli.exits`)."""

from relight_formats.errors import RelightError, StoreError

__all__ = ["InputError", "NumericalError", "RelightError", "StoreError", "SystemFault"]


class InputError(RelightError):
    """Bad usage or bad input: names the file, the key, what was expected and what was found. Exit code 2."""


class NumericalError(RelightError):
    """A computation that cannot keep its promise (not finite, above a requested tolerance). Exit code 4."""


class SystemFault(RelightError):
    """The machine said no: disk full, no permission, workers that die. Exit code 5."""
