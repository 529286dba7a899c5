"""Exit codes, and which error gives which. The only place that knows both."""

from __future__ import annotations

from relightcli.errors import InputError, NumericalError, StoreError, SystemFault

OK = 0
BEYOND_TOLERANCE = 1
BAD_INPUT = 2
BAD_STORE = 3
NUMERICAL = 4
SYSTEM = 5
INTERRUPTED = 130


def exit_code(error: BaseException) -> tuple[int, str]:
    """Exit code and message of an error that ended a command."""
    if isinstance(error, InputError):
        return BAD_INPUT, str(error)
    if isinstance(error, StoreError):
        return BAD_STORE, str(error)
    if isinstance(error, NumericalError):
        return NUMERICAL, str(error)
    if isinstance(error, SystemFault):
        return SYSTEM, str(error)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return SYSTEM, f"{where}{error.strerror or error}"
    if isinstance(error, MemoryError):
        return SYSTEM, "out of memory; use fewer --workers or a smaller scene"
    return SYSTEM, f"internal error: {type(error).__name__}: {error} (run again with -v for the traceback)"
