"""A store being written: arrays, the ledger of finished blocks, and the commit."""

import enum
import os
from collections.abc import Sequence, Set
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from relight_formats.arrays import CHUNK_BYTES, Codec, Layout, array_metadata, check_name, read_layout
from relight_formats.errors import StoreError
from relight_formats.files import fsync_folder, local_path, remove_store, sweep_unfinished, walk, write_durably
from relight_formats.fingerprint import fingerprint_bytes, plain
from relight_formats.header import KEY, ROOT, dump, load_document, write_root
from relight_formats.ledger import DOCUMENTS, FILE_NAME, LedgerFile, read_ledger
from relight_formats.lock import Lock
from relight_formats.publish import discard, publish, sealed
from relight_formats.seal import LEDGER_GROUP, seal
from relight_formats.upload import Target

if TYPE_CHECKING:
    import zarr

_GROUP = dump({"zarr_format": 3, "node_type": "group", "attributes": {}})
_DROPPED = "dropped "  # in the notes of documents, before the name of an array that only the work needed
_START_AGAIN = "Start again with --overwrite."


class Status(enum.Enum):
    """How far a store has come: nothing was there, unfinished work was taken up, or it is committed."""

    FRESH = "fresh"
    RESUMED = "resumed"
    DONE = "done"


class Writer:
    """Owner of `NAME.partial` until it is committed or closed. Made by `begin`; a context manager.

    Leaving the context without `commit` keeps the unfinished work for the next run and lets go of the lock. One process
    owns the writer; others write whole chunks through `worker_array` and report to it.
    """

    def __init__(
        self, path: Path, partial: Path, header: dict[str, Any], attributes: dict[str, Any], lock: Lock, status: Status
    ) -> None:
        self.path = path
        """Where the store will be."""
        self.partial_path = partial
        """Where it is while it is written."""
        self.status = status
        self.target: Target | None = None
        """The URL that the store goes to once it is finished, if there is one."""
        self._header = header
        self._attributes = attributes
        self._lock = lock
        self._synced: dict[str, int] = {}
        self._layouts: dict[str, Layout] = check_unfinished(partial)
        self._ledger = LedgerFile(partial / FILE_NAME)
        self._documents = LedgerFile(partial / DOCUMENTS)

    @property
    def header(self) -> dict[str, Any]:
        """Of the root metadata so far."""
        return self._header

    @property
    def settings(self) -> dict[str, Any]:
        """As given to `begin`."""
        settings: dict[str, Any] = self._header["settings"]
        return settings

    @property
    def attrs(self) -> dict[str, Any]:
        """As given to `set_attrs`."""
        return self._attributes

    @property
    def layouts(self) -> dict[str, Layout]:
        """Shape, chunks, data type and dimension names per array so far."""
        return dict(self._layouts)

    def read(self, name: str) -> "np.ndarray[Any, Any]":
        """A whole array so far, in memory. Raises StoreError if there is none."""
        return np.asarray(worker_array(self.partial_path, name)[...])

    @property
    def done(self) -> Set[str]:
        """Ids of the blocks whose results are on disk: a view, which grows with them."""
        return self._ledger.ids.keys()

    @property
    def blocks(self) -> list[dict[str, Any]]:
        """The ledger so far: per finished block `id` and what was recorded with it."""
        return list(self._ledger.blocks)

    def array(
        self,
        name: str,
        *,
        shape: Sequence[int],
        dtype: Any,
        chunks: Sequence[int],
        dims: Sequence[str],
        units: str | None = None,
        attrs: dict[str, Any] | None = None,
        codec: Codec = "lz4",
        fill: float | bool = 0,
    ) -> "zarr.Array[Any]":
        """Create an array, or take up the one that an interrupted run created.

        Every chunk must be written before `commit`, by one owner each; chunks of fill values count too.

        Args:
            name: path of the array, groups before it: `direct/haar/index`.
            shape, chunks: sizes per axis; a chunk is cut to the shape. About 4 MB a chunk keeps the files few.
            dtype: anything NumPy takes for a bool, integer or real number; stored little-endian.
            dims: one name per axis; within a group and those above and below it a name stands for one size.
            units: SI symbol (`m`, `sr`, `s`); None is written as `1`, a plain number.
            attrs: further JSON attributes.
            codec: `lz4` (blosc, byte shuffle), `zstd` (level 3), `zstd_shuffled` (blosc, byte shuffle, level 3) or
                `none`; a CRC-32C always follows.
            fill: the value that unwritten elements of a chunk read as.

        Raises:
            ValueError: what the format does not allow.
            StoreError: the interrupted run made this array with another shape, type, chunks, codec or attributes.
            OSError: disk full, no permission.
        """
        self._need_open()
        data_type = np.dtype(dtype).name
        document = array_metadata(
            name,
            shape=shape,
            dtype=data_type,
            chunks=chunks,
            dims=dims,
            units=units,
            attrs=attrs,
            codec=codec,
            fill=fill,
        )
        layout = read_layout(document, name)
        self._check_group(name, layout)
        folder = self.partial_path / name
        content = dump(document)
        if name in self._layouts:
            found = (folder / ROOT).read_bytes()
            if found != content:
                self._spoil()
                raise StoreError(
                    f"{self.partial_path}: array {name}: the interrupted run made it with another shape, type, chunks, "
                    f"codec or attributes than this one. {_START_AGAIN}"
                )
        else:
            self._make_groups(name)
            folder.mkdir(exist_ok=True)
            # Noted first: a document that is there and not as noted is a damaged one.
            self._documents.append({"id": name, "document": fingerprint_bytes(content)})
            write_durably(folder / ROOT, content)
            fsync_folder(folder.parent)
            self._layouts[name] = layout
        return worker_array(self.partial_path, name)

    def _check_group(self, name: str, layout: Layout) -> None:
        group = name[: name.rfind("/") + 1]  # "" at the root
        for other, known in self._layouts.items():
            if other.startswith(name + "/") or name.startswith(other + "/"):
                raise ValueError(f"array {name}: {other} exists; an array cannot lie inside an array.")
            others = other[: other.rfind("/") + 1]
            if other == name or not (group.startswith(others) or others.startswith(group)):
                continue
            sizes = dict(zip(known.dims, known.shape, strict=True))
            for dim, size in zip(layout.dims, layout.shape, strict=True):
                if sizes.get(dim, size) != size:
                    raise ValueError(
                        f"array {name}: dimension {dim} has size {size}, but {sizes[dim]} in {other} of the same "
                        f"group or one above or below; readers such as xarray need one size per name there. "
                        f"Use another name or another group."
                    )

    def _make_groups(self, name: str) -> None:
        parts = name.split("/")[:-1]
        for depth in range(1, len(parts) + 1):
            folder = self.partial_path.joinpath(*parts[:depth])
            if not (folder / ROOT).exists():
                folder.mkdir(exist_ok=True)
                write_durably(folder / ROOT, _GROUP)
                fsync_folder(folder.parent)

    def put(
        self,
        name: str,
        data: Any,
        *,
        dims: Sequence[str],
        units: str | None = None,
        attrs: dict[str, Any] | None = None,
        codec: Codec = "lz4",
    ) -> None:
        """Write a whole array at once, in chunks of about 4 MB along axis 0. Repeating it on the same data is harmless.

        Raises as `array`.
        """
        values = np.asarray(data)
        row = max(1, int(np.prod(values.shape[1:])) * values.dtype.itemsize)
        chunks = (max(1, CHUNK_BYTES // row), *(max(1, n) for n in values.shape[1:])) if values.ndim else ()
        array = self.array(
            name,
            shape=values.shape,
            dtype=values.dtype,
            chunks=chunks,
            dims=dims,
            units=units,
            attrs=attrs,
            codec=codec,
        )
        if values.size:
            array[...] = values

    def drop(self, name: str) -> None:
        """Delete an array, or a group and all in it, that only the work needed. Harmless if it is not there.

        Raises:
            ValueError: a name that the format does not allow.
            OSError: no permission.
        """
        self._need_open()
        check_name(name)
        for own in [other for other in self._layouts if f"{other}/".startswith(f"{name}/")]:
            if _DROPPED + own not in self._documents.ids:  # noted first: it is not missing when it is gone
                self._documents.append({"id": _DROPPED + own})
            del self._layouts[own]
            self._synced.pop(own, None)
        folder = self.partial_path / name
        if folder.exists():
            remove_store(folder)
            fsync_folder(folder.parent)

    def set_attrs(self, attrs: dict[str, Any]) -> None:
        """Add JSON attributes to the root, replacing those of the same names. `relight` is reserved.

        Raises:
            ValueError, TypeError: the reserved name, or no JSON value.
        """
        self._need_open()
        if KEY in attrs:
            raise ValueError(f"attribute {KEY!r} is reserved for the store's own header.")
        merged = {**self._attributes, **plain(attrs, "attributes")}
        write_root(self.partial_path, self._header, merged)
        self._attributes = merged

    def record(self, block_id: str, info: dict[str, Any]) -> None:
        """Note that a block is finished; on disk when this returns, and so are the chunks written before it.

        Args:
            block_id: name of the block, once per store.
            info: what it cost and how good it is, JSON values: seconds, rays, peak_bytes, bytes, error, ...

        Raises:
            ValueError: the block is recorded already, or `info` is no JSON.
            OSError: disk full, no permission.
        """
        self._need_open()
        if block_id in self.done:
            raise ValueError(f"block {block_id!r} is recorded already.")
        self._sync_folders()
        self._ledger.append({**plain(info, f"block {block_id}"), "id": block_id})

    def _sync_folders(self) -> None:
        for name in self._layouts:
            folder = self.partial_path / name
            changed = os.stat(folder).st_mtime_ns
            if self._synced.get(name) != changed:
                fsync_folder(folder)
                self._synced[name] = changed

    def commit(self, summary: dict[str, Any]) -> None:
        """Finish: check that every chunk is there, write the ledger and the commit mark, take the final name.

        Array files are not touched. A crash at any point leaves a state that the next `begin` finishes or takes up.

        Raises:
            StoreError: chunks are missing.
            OSError: disk full, no permission.
        """
        self._need_open()
        sweep_unfinished(self.partial_path)
        for name in self._layouts:
            self._make_groups(name)  # unless something has deleted them, they are there
        self._sync_folders()
        self._header = {**self._header, "summary": plain(summary, "summary")}
        try:
            noted = self._documents.ids.keys()
            dropped = {note.removeprefix(_DROPPED) for note in noted if note.startswith(_DROPPED)}
            lost = sorted(note for note in noted - self._layouts.keys() - dropped if not note.startswith(_DROPPED))
            if lost:
                raise StoreError(
                    f"{self.partial_path}: array {lost[0]}: its {ROOT}, which an interrupted run wrote, is missing. "
                    f"{_START_AGAIN}"
                )
            seal(self.partial_path, self._header, self._attributes, self._ledger.blocks)
        except StoreError:
            self._spoil()
            raise
        self._ledger.close()
        self._documents.close()
        publish(self.path, self.partial_path)
        if self.target is not None:
            self.target.send()
        self.status = Status.DONE
        self._lock.release()

    def close(self) -> None:
        """Keep the unfinished work and let go of the lock. Harmless when repeated and after `commit`."""
        self._ledger.close()
        self._documents.close()
        self._lock.release()

    def abandon(self) -> None:
        """Delete the unfinished work, which no next run can use, and let go of the lock. After `commit`, or where
        that was interrupted, the store is whole and stays."""
        if not self._lock.released and self.partial_path.exists() and not sealed(self.partial_path):
            discard(self.path, self.partial_path)
            if self.target is not None:
                self.target.withdraw()
        self.close()

    def _spoil(self) -> None:
        """No rerun takes up this work any more, for it would fail again; with `--overwrite` one starts afresh."""
        write_root(self.partial_path, {**self._header, "kind": "damaged"}, self._attributes)

    def _need_open(self) -> None:
        if self._lock.released:
            raise ValueError(f"{self.path}: this writer is closed.")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def check_unfinished(partial: Path) -> dict[str, Layout]:
    """Layouts of the arrays of unfinished work, all of which is read: metadata against its notes, chunks against their
    checksums. Raises StoreError for whatever is not as it was written; what is missing shows at commit."""
    from relight_formats.chunks import chunk_problem, is_chunk

    noted: dict[str, Any] = {}
    for note in read_ledger(partial / DOCUMENTS)[0]:
        noted[note["id"]] = note.get("document")
    layouts = {}
    for relative, entry in walk(partial):
        folder = relative.rpartition("/")[0]
        if entry.is_dir(follow_symlinks=False) or folder in ("", LEDGER_GROUP):
            continue
        problem = None
        if entry.name == ROOT:
            document, content = load_document(Path(entry.path), partial)
            if document.get("node_type") == "array":
                layouts[folder] = read_layout(document, f"{partial}: array {folder}")
            if content != _GROUP and fingerprint_bytes(content) != noted.get(folder):
                problem = "is not as it was written"
        elif is_chunk(relative):
            problem = chunk_problem(Path(entry.path).read_bytes())
        if problem:
            raise StoreError(f"{partial}: {relative} {problem}; the unfinished work is damaged. {_START_AGAIN}")
    return layouts


def worker_array(partial_path: str | Path, name: str) -> "zarr.Array[Any]":
    """An array of a store being written, for worker processes: assign whole chunks, each chunk by one owner.

    A chunk's content is on disk when the assignment returns.

    Args:
        partial_path: `Writer.partial_path`.
        name: as given to `Writer.array`.

    Raises:
        ValueError: a name that the format does not allow.
        StoreError: no such array.
        OSError: disk full, no permission.
    """
    check_name(name)
    folder = local_path(partial_path)
    document, _ = load_document(folder / name / ROOT, folder)
    read_layout(document, f"{folder}: array {name}")
    from relight_formats.chunks import open_written

    return open_written(folder, name)
