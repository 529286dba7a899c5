"""Starting a store: nothing to do, take up unfinished work, or start afresh."""

import contextlib
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from relight_formats.errors import StoreError
from relight_formats.files import LOCK, REPLACED, UNFINISHED, local_path, sibling, sweep_unfinished
from relight_formats.fingerprint import plain
from relight_formats.header import CONVENTIONS, FORMAT, ROOT, is_store, mismatch, read_root, write_root
from relight_formats.lock import Lock
from relight_formats.publish import discard, sealed, tidy
from relight_formats.remote import RemotePath, place
from relight_formats.upload import Target
from relight_formats.writer import Status, Writer


def begin(
    path: str | os.PathLike[str],
    kind: str,
    *,
    settings: dict[str, Any],
    inputs: dict[str, str],
    program: str,
    overwrite: bool = False,
) -> Writer | None:
    """Start or continue the store at `path`.

    Args:
        path: final name of the store; work goes into `<path>.partial`. At a URL: work goes into a folder of the current
            directory, and is sent when it is finished (`upload`).
        kind: what the store holds (`transfer`, `clusters`, ...).
        settings: JSON values that decide the result.
        inputs: name to fingerprint of everything the result is made from.
        program: name and version of the program, bound to unfinished work: half a store from each of two versions would
            be the store of neither.
        overwrite: replace a finished store (at commit; it stays in place until then), even one made from the same
            inputs and settings, and drop unfinished work made from others.

    Returns:
        A writer; or None when the finished store of this kind, settings and inputs is there. Its time stamp is
        refreshed, so that Make sees a target newer than its sources.

    Raises:
        StoreError: a store, finished or not, made from other inputs or settings, unless `overwrite`; a damaged one,
            unless `overwrite`; something that is no relight store (never touched); another writer at work.
        OSError: the folder is missing or cannot be written; the URL cannot be reached.
    """
    header = {
        "format": FORMAT,
        "kind": kind,
        "program": program,
        "settings": plain(settings, "settings"),
        "inputs": plain(inputs, "inputs"),
        "conventions": CONVENTIONS,
        "complete": False,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "summary": {},
        "ledger": None,
        "content": None,
    }
    where = place(path)
    if isinstance(where, RemotePath):
        return _begin_at(where, header, overwrite)
    return _begin_in(local_path(where), header, overwrite)


def _begin_at(where: RemotePath, header: dict[str, Any], overwrite: bool) -> Writer | None:
    target = Target(where, header, overwrite)
    if target.finished:
        return None
    unsent = sealed(target.folder) and _same(target.folder, header)  # the last run could not send it
    try:
        writer = _begin_in(target.folder, header, overwrite and not unsent)
    except StoreError as error:
        raise StoreError(f"{where}: {error}") from None
    if writer is None:
        lock = Lock(target.folder)
        try:
            target.send()
        finally:
            lock.release()
        return None
    try:
        target.claim(writer.header)
    except BaseException:
        writer.close()
        raise
    writer.target = target
    return writer


def _begin_in(final: Path, header: dict[str, Any], overwrite: bool) -> Writer | None:
    partial = sibling(final, UNFINISHED)
    if not overwrite and _finished(final, header):
        _tidy_beside(final, partial, header)
        return None
    _need_replaceable(final)
    lock = Lock(final)
    try:
        published = _tidy(final, partial, overwrite)
        # Either another writer committed just before the lock was ours, or the run that this one repeats had died
        # between its commit mark and the final name.
        if (published and _same(final, header)) or (not overwrite and _finished(final, header)):
            lock.release()
            return None
        return _take_up(final, partial, header, lock, overwrite)
    except BaseException:
        lock.release()
        raise


def _tidy(final: Path, partial: Path, overwrite: bool) -> bool:
    try:
        return tidy(final, partial)
    except StoreError:
        # A sealed store that was damaged before it took its name; anything else is in the way still.
        if not overwrite or not sealed(partial):
            raise
        discard(final, partial)
        return tidy(final, partial)


def _tidy_beside(final: Path, partial: Path, header: dict[str, Any]) -> None:
    """Clear what a crash just after the final rename left, and work on a second store like the one that is there.
    Not worth failing for, nor waiting for another writer."""
    if any(sibling(final, suffix).exists() for suffix in (REPLACED, LOCK, UNFINISHED)):
        with contextlib.suppress(StoreError, OSError):
            lock = Lock(final)
            try:
                tidy(final, partial)
                if partial.exists() and not mismatch(read_root(partial)[0], header, with_program=False):
                    discard(final, partial)
            finally:
                lock.release()


def _same(final: Path, asked: dict[str, Any]) -> bool:
    return not mismatch(read_root(final)[0], asked, with_program=False)


def _finished(final: Path, asked: dict[str, Any]) -> bool:
    if not final.exists():
        return False
    _need_replaceable(final)
    found, _ = read_root(final)
    different = mismatch(found, asked, with_program=False)
    if different:
        raise StoreError(
            f"{final}: a finished store is there, made with others: {'; '.join(different)}. "
            f"Use another output, or --overwrite to replace it."
        )
    if not found["complete"]:
        raise StoreError(
            f"{final}: the store there carries no commit mark; it is damaged. Use --overwrite to replace it."
        )
    os.utime(final / ROOT)
    return True


def _need_replaceable(final: Path) -> None:
    if final.exists() and not is_store(final):
        raise StoreError(
            f"{final}: expected a relight store or nothing, found something else. Use another output, or move it."
        )


def _take_up(final: Path, partial: Path, header: dict[str, Any], lock: Lock, overwrite: bool) -> Writer:
    if partial.exists() and not _only_leftovers(partial):
        if not is_store(partial):
            raise StoreError(
                f"{partial}: expected unfinished work of a relight store, found something else; move it away."
            )
        try:
            found, attributes = read_root(partial)
            different = mismatch(found, header, with_program=True)
            if different:
                raise StoreError(
                    f"{partial}: unfinished work is there, made with others: {'; '.join(different)}. "
                    f"Repeat the command that began it, or use --overwrite to start afresh."
                )
            sweep_unfinished(partial)
            return Writer(final, partial, found, attributes, lock, Status.RESUMED)
        except StoreError:
            if not overwrite:
                raise
            discard(final, partial)
    partial.mkdir(exist_ok=True)
    sweep_unfinished(partial)
    write_root(partial, header, {})
    return Writer(final, partial, header, {}, lock, Status.FRESH)


def _only_leftovers(partial: Path) -> bool:
    # A crash between making the folder and writing its root metadata leaves no more than a half-written root.
    return partial.is_dir() and all(name.endswith(UNFINISHED) for name in os.listdir(partial))
