"""Reading a whole store to see whether it is what was committed."""

import itertools
from pathlib import Path
from typing import Any

from relight_formats.arrays import Layout
from relight_formats.errors import StoreError
from relight_formats.files import walk
from relight_formats.header import ROOT, dump, load_document
from relight_formats.remote import Place
from relight_formats.seal import LEDGER_GROUP, chunk_digest


def verify(folder: Place, layouts: dict[str, Layout], ledger: dict[str, Any]) -> list[str]:
    """Problems of a store whose metadata passed `open_store`, one or two sentences each.

    Every chunk is read, checked against its checksum and decoded. Missing and additional files are named; so are chunks
    that are sound in themselves but not those that were committed.
    """
    problems = []
    document, content = load_document(folder / ROOT, folder)
    if content != dump(document):
        problems.append(f"{folder}: {ROOT} is not spelled as it was written.")
    if isinstance(folder, Path):
        present = {relative for relative, entry in walk(folder) if not entry.is_dir(follow_symlinks=False)}
    else:
        present = folder.files()
    expected = {ROOT, f"{LEDGER_GROUP}/{ROOT}", *ledger["documents"]}
    for name, layout in sorted(layouts.items()):
        found, chunks = _array_problems(folder, name, layout, present, ledger["arrays"][name])
        problems += found
        expected |= chunks
    return problems + [f"{folder}: {name} does not belong to the store." for name in sorted(present - expected)]


def _array_problems(
    folder: Place, name: str, layout: Layout, present: set[str], entry: dict[str, Any]
) -> tuple[list[str], set[str]]:
    """Problems of one array, and those files in `present` that are chunks of it."""
    from relight_formats.chunks import open_committed

    here = sum(file.startswith(f"{name}/c") for file in present)
    # The metadata of an untrusted store may claim any number of chunks; the files there bound the work.
    names = list(itertools.islice(layout.chunk_names(), 2 * here + 4))
    chunks = {f"{name}/{chunk}" for chunk in names} & present
    missing = [chunk for chunk in names if f"{name}/{chunk}" not in present]
    problems = [f"{folder}: array {name}: chunk file {name}/{chunk} is missing." for chunk in missing]
    if len(names) < layout.chunk_count:
        problems.append(f"{folder}: array {name}: expected {layout.chunk_count} chunk files, found {len(chunks)}.")
    array = open_committed(folder, name)
    for chunk in names:
        if f"{name}/{chunk}" not in present:
            continue
        index = tuple(map(int, chunk.split(".")[1:]))
        try:
            _ = array.get_block_selection(index) if index else array[...]
        except StoreError as error:
            problems.append(str(error))
        except (ValueError, RuntimeError, TypeError) as error:
            problems.append(f"{folder}: array {name}: chunk file {name}/{chunk} cannot be decoded ({error}).")
    if not problems:
        digest, stored, _ = chunk_digest(folder / name, layout)
        if (digest, stored) != (entry["chunks"], entry["stored_bytes"]):
            problems.append(f"{folder}: array {name}: its chunks are sound, but not those that were committed.")
    return problems, chunks
