"""Invalid stores: each function damages a copy of `valid/small` in the one way that its name says.

Where a name says nothing of digests, the digests are made to fit the damage: what is refused is the damage itself.
"""

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from relight_formats.fingerprint import fingerprint_bytes
from relight_formats.header import dump, write_root

TRANSFER = "direct/transfer"
LIGHTS_PER_ROW = 10


@dataclass(frozen=True)
class Defect:
    """How to make one invalid example and what must be said about it."""

    damage: Callable[[Path], None]
    found_by: str
    """`open`: the store does not open. `verify`: it opens, and `verify` names the problem."""
    words: str
    """Part of the message."""


def _load(file: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(file.read_bytes())
    return document


def _edit_root(folder: Path, change: Callable[[dict[str, Any]], object], *, fit_digest: bool = True) -> None:
    document = _load(folder / "zarr.json")
    change(document["attributes"]["relight"])
    if fit_digest:
        header = document["attributes"].pop("relight")
        write_root(folder, header, document["attributes"])
    else:
        (folder / "zarr.json").write_bytes(dump(document))


def _edit_ledger(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    document = _load(folder / "ledger/zarr.json")
    change(document["attributes"])
    content = dump(document)
    (folder / "ledger/zarr.json").write_bytes(content)
    _edit_root(folder, lambda header: header.update(ledger=fingerprint_bytes(content)))


def _edit_array(folder: Path, change: Callable[[dict[str, Any]], object], *, fit_digest: bool = True) -> None:
    file = folder / TRANSFER / "zarr.json"
    document = _load(file)
    change(document)
    file.write_bytes(dump(document))
    if fit_digest:
        print_ = fingerprint_bytes(file.read_bytes())
        _edit_ledger(folder, lambda ledger: ledger["documents"].update({f"{TRANSFER}/zarr.json": print_}))


def _flip(file: Path, position: int) -> None:
    content = bytearray(file.read_bytes())
    content[position] ^= 1
    file.write_bytes(content)


def _empty_folder(folder: Path) -> None:
    shutil.rmtree(folder)
    folder.mkdir()


def _zarr_v2(folder: Path) -> None:
    _empty_folder(folder)
    (folder / ".zgroup").write_text('{"zarr_format": 2}')


def _foreign_group(folder: Path) -> None:
    (folder / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')


def _pickle_codec(document: dict[str, Any]) -> None:
    document["codecs"] = [{"name": "numcodecs.pickle", "configuration": {"protocol": 5}}, {"name": "crc32c"}]


def _swap_chunks(folder: Path) -> None:
    first, second = folder / TRANSFER / "c.0.0", folder / TRANSFER / "c.1.0"
    contents = first.read_bytes(), second.read_bytes()
    first.write_bytes(contents[1])
    second.write_bytes(contents[0])


def _link(folder: Path) -> None:
    chunk = folder / TRANSFER / "c.0.0"
    outside = folder.parent / "outside"
    shutil.copy(chunk, outside)
    chunk.unlink()
    os.symlink(outside, chunk)


DEFECTS: dict[str, Defect] = {
    "empty-folder": Defect(_empty_folder, "open", "expected a relight store, found a folder without zarr.json"),
    "zarr-version-2": Defect(_zarr_v2, "open", "expected a relight store, found a folder without zarr.json"),
    "zarr-group-of-another-program": Defect(_foreign_group, "open", "the attribute 'relight'"),
    "root-is-not-json": Defect(lambda f: _flip(f / "zarr.json", 0), "open", "expected JSON"),
    "root-cut-short": Defect(lambda f: os.truncate(f / "zarr.json", 100), "open", "expected JSON"),
    "root-changed-after-commit": Defect(
        lambda f: _edit_root(f, lambda h: h["settings"].update(tolerance=0.5), fit_digest=False), "open", "its digest"
    ),
    "format-newer": Defect(lambda f: _edit_root(f, lambda h: h.update(format=2)), "open", "use a newer relightcli"),
    "format-older": Defect(lambda f: _edit_root(f, lambda h: h.update(format=0)), "open", "make the store again"),
    "format-is-text": Defect(lambda f: _edit_root(f, lambda h: h.update(format="1")), "open", "store format 1"),
    "settings-have-wrong-type": Defect(
        lambda f: _edit_root(f, lambda h: h.update(settings=[])), "open", "relight.settings has the wrong type"
    ),
    "input-is-no-fingerprint": Defect(
        lambda f: _edit_root(f, lambda h: h["inputs"].update(scene=3)), "open", "must map names to fingerprints"
    ),
    "no-commit-mark": Defect(lambda f: _edit_root(f, lambda h: h.update(complete=False)), "open", "unfinished"),
    "ledger-missing": Defect(lambda f: shutil.rmtree(f / "ledger"), "open", "is missing"),
    "ledger-digest-wrong": Defect(lambda f: _flip(f / "ledger/zarr.json", -10), "open", "ledger/zarr.json"),
    "ledger-has-wrong-type": Defect(
        lambda f: _edit_ledger(f, lambda ledger: ledger.update(blocks=[1])), "open", "expected blocks"
    ),
    "ledger-names-a-path-outside": Defect(
        lambda f: _edit_ledger(f, lambda ledger: ledger["documents"].update({"../small/zarr.json": "sha256:0"})),
        "open",
        "no metadata of this store",
    ),
    "array-metadata-missing": Defect(lambda f: (f / TRANSFER / "zarr.json").unlink(), "open", "is missing"),
    "array-digest-wrong": Defect(
        lambda f: _edit_array(f, lambda d: d["attributes"].update(units="m"), fit_digest=False), "open", "its digest"
    ),
    "codec-pickle": Defect(lambda f: _edit_array(f, _pickle_codec), "open", "codecs"),
    "codec-without-checksum": Defect(
        lambda f: _edit_array(f, lambda d: d.update(codecs=d["codecs"][:-1])), "open", "codecs"
    ),
    "data-type-text": Defect(lambda f: _edit_array(f, lambda d: d.update(data_type="string")), "open", "data_type"),
    "dimension-names-missing": Defect(
        lambda f: _edit_array(f, lambda d: d.pop("dimension_names")), "open", "dimension_names"
    ),
    "units-missing": Defect(lambda f: _edit_array(f, lambda d: d["attributes"].pop("units")), "open", "units"),
    "shape-negative": Defect(lambda f: _edit_array(f, lambda d: d.update(shape=[-1, 10])), "open", "shape"),
    "chunk-too-large": Defect(
        lambda f: _edit_array(
            f, lambda d: d["chunk_grid"]["configuration"].update(chunk_shape=[1 << 40, LIGHTS_PER_ROW])
        ),
        "open",
        "chunks of at most 1024 MiB",
    ),
    "unknown-metadata-key": Defect(
        lambda f: _edit_array(f, lambda d: d.update(extension={"name": "x"})), "open", "unknown keys extension"
    ),
    "symbolic-link-inside": Defect(_link, "open", "symbolic link"),
    "shape-larger-than-chunks-there": Defect(
        lambda f: _edit_array(f, lambda d: d.update(shape=[1 << 60, 10])), "verify", "is missing"
    ),
    "chunk-bit-flipped": Defect(lambda f: _flip(f / TRANSFER / "c.0.0", 20), "verify", "does not match its checksum"),
    "chunk-cut-short": Defect(lambda f: os.truncate(f / TRANSFER / "c.0.0", 3), "verify", "is cut short"),
    "chunk-missing": Defect(lambda f: (f / TRANSFER / "c.1.0").unlink(), "verify", "c.1.0 is missing"),
    "chunks-swapped": Defect(_swap_chunks, "verify", "not those that were committed"),
    "additional-file": Defect(
        lambda f: (f / "direct/notes.txt").write_text("x") and None, "verify", "direct/notes.txt does not belong"
    ),
    "root-spelled-differently": Defect(
        lambda f: (f / "zarr.json").write_text(json.dumps(_load(f / "zarr.json"))) and None, "verify", "not spelled"
    ),
}
"""All invalid examples by name."""


def make(name: str, valid: Path, folder: Path) -> None:
    """Copy the valid example to `folder` and damage the copy."""
    shutil.copytree(valid, folder)
    DEFECTS[name].damage(folder)
