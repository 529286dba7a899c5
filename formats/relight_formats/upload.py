"""Stores made at a URL: worked on in a folder of the current directory, then sent, the commit mark last.

An object store cannot rename, so there the root metadata says how far a store is: without the commit mark it is a
claim, which names the folder where the work is done; with it, and only then, the store opens. Whoever finds the claim
of another folder does not write.
"""

import contextlib
import hashlib
import os
import socket
from pathlib import Path
from typing import Any

from relight_formats.errors import StoreError
from relight_formats.files import UNFINISHED, remove_store, sibling, walk
from relight_formats.header import ROOT, is_store, mismatch, read_root, root_bytes
from relight_formats.remote import RemotePath

CLAIM = "claim"
BATCH = 64  # files sent at once


class Target:
    """A URL that a store is to be made at, and the local folder `folder` where it is made.

    Raises:
        StoreError: a store made from others is there, unless `overwrite`; another writer's claim, unless `overwrite`;
            something that is no relight store.
        OSError: the URL cannot be reached.
    """

    def __init__(self, place: RemotePath, header: dict[str, Any], overwrite: bool) -> None:
        self.place = place
        self.header = header
        name = hashlib.sha256(str(place).encode()).hexdigest()[:8]
        self.folder = Path(os.path.realpath(f"{place.name}.{name}"))
        """Where the work is done: the store's name and a digest of its URL, in the current directory."""
        self.finished = False
        """Whether the store that is asked for is there."""
        self._found: bytes | None = None  # the root that may be replaced; None: there was none
        self._claimed = False
        self._check(overwrite)

    def _check(self, overwrite: bool) -> None:
        found = self._root()
        if found is None:
            if self._fresh().files():
                raise StoreError(
                    f"{self.place}: expected a relight store or nothing, found other files. Use another output, or "
                    f"delete them."
                )
            return
        self._found = found
        there = self._fresh()
        if not is_store(there):
            raise StoreError(f"{self.place}: expected a relight store or nothing, found something else.")
        if overwrite:
            return
        header, attributes = read_root(there)
        if header["complete"]:
            different = mismatch(header, self.header, with_program=False)
            if different:
                raise StoreError(
                    f"{self.place}: a finished store is there, made with others: {'; '.join(different)}. "
                    f"Use another output, or --overwrite to replace it."
                )
            self.finished = True
        elif attributes.get(CLAIM) != self._own_claim():
            raise StoreError(
                f"{self.place}: another process is making this store, or was interrupted: "
                f"{attributes.get(CLAIM, 'unknown')}. Wait for it, or repeat its command there; with --overwrite it is "
                f"made here instead."
            )

    def _own_claim(self) -> str | None:
        """The claim of the work that is in the local folder."""
        for folder in (sibling(self.folder, UNFINISHED), self.folder):
            with contextlib.suppress(StoreError):
                return self._claim(read_root(folder)[0])
        return None

    def _claim(self, header: dict[str, Any]) -> str:
        return f"{self.folder} on {socket.gethostname()}, begun {header['created']}"

    def _fresh(self) -> RemotePath:
        """The place, with nothing kept from before."""
        self.place.fs.invalidate_cache()
        return RemotePath(self.place.fs, self.place.path)

    def _root(self) -> bytes | None:
        try:
            return (self._fresh() / ROOT).read_bytes()
        except FileNotFoundError:
            return None

    def claim(self, header: dict[str, Any]) -> None:
        """Says at the URL that a store is being made, unless a finished one is there, which stays until the end.

        header: of the work in the local folder.
        """
        with contextlib.suppress(StoreError):
            if self._found is not None and read_root(self._fresh())[0]["complete"]:
                return
        self._put_claim(header)

    def _put_claim(self, header: dict[str, Any]) -> None:
        document = {**header, "complete": False, "summary": {}, "ledger": None, "content": None}
        content = root_bytes(document, {CLAIM: self._claim(header)})
        with contextlib.suppress(OSError):  # where there are folders; an object store may not let one make them
            self.place.fs.makedirs(self.place.path, exist_ok=True)
        self.place.fs.pipe_file((self.place / ROOT).path, content)
        self._found, self._claimed = content, True

    def withdraw(self) -> None:
        """Takes the claim back, if there is one of ours."""
        if self._claimed and self._root() == self._found:
            self.place.fs.rm_file((self.place / ROOT).path)

    def send(self) -> None:
        """The finished store in the local folder to the URL; then the folder is deleted.

        Raises:
            StoreError: another writer has taken the place since.
            OSError: it cannot be sent. The folder stays, and the next run sends it.
        """
        header, _ = read_root(self.folder)
        self._need_ours()
        self._put_claim(header)
        names = [name for name, entry in walk(self.folder) if entry.is_file(follow_symlinks=False) and name != ROOT]
        for start in range(0, len(names), BATCH):
            some = names[start : start + BATCH]
            self.place.fs.put([str(self.folder / n) for n in some], [(self.place / n).path for n in some])
        for name in sorted(self._fresh().files() - {*names, ROOT}):
            self.place.fs.rm_file((self.place / name).path)
        self._need_ours()
        self.place.fs.pipe_file((self.place / ROOT).path, (self.folder / ROOT).read_bytes())
        remove_store(self.folder)

    def _need_ours(self) -> None:
        if self._root() != self._found:
            raise StoreError(
                f"{self.place}: another process has written there meanwhile. The finished store is kept in "
                f"{self.folder}; with --overwrite the next run sends it."
            )
