"""Relight stores on disk: create, resume, commit, open, verify. The contract is formats/SPEC.md.

Names load when first used: a program that only needs `StoreError` never pays for NumPy or Zarr.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from relight_formats.bits import pack_bits, unpack_bits
    from relight_formats.errors import RelightError, StoreError
    from relight_formats.fingerprint import canonical_json, fingerprint_file, fingerprint_json
    from relight_formats.header import CONVENTIONS, FORMAT
    from relight_formats.quantisation import dequantise, quantise
    from relight_formats.start import begin
    from relight_formats.store import ArraySize, Store, open_store, progress
    from relight_formats.writer import Status, Writer, worker_array

_HOME = {
    "CONVENTIONS": "header",
    "FORMAT": "header",
    "ArraySize": "store",
    "RelightError": "errors",
    "Status": "writer",
    "Store": "store",
    "StoreError": "errors",
    "Writer": "writer",
    "begin": "start",
    "canonical_json": "fingerprint",
    "dequantise": "quantisation",
    "fingerprint_file": "fingerprint",
    "fingerprint_json": "fingerprint",
    "open_store": "store",
    "pack_bits": "bits",
    "progress": "store",
    "quantise": "quantisation",
    "unpack_bits": "bits",
    "worker_array": "writer",
}

__all__ = [
    "CONVENTIONS",
    "FORMAT",
    "ArraySize",
    "RelightError",
    "Status",
    "Store",
    "StoreError",
    "Writer",
    "begin",
    "canonical_json",
    "dequantise",
    "fingerprint_file",
    "fingerprint_json",
    "open_store",
    "pack_bits",
    "progress",
    "quantise",
    "unpack_bits",
    "worker_array",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
