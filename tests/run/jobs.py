"""Jobs for tests of the scheduler; importable, so that worker processes can unpickle them."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path


class FileLedger:
    """A ledger in memory, as far as the scheduler needs one."""

    def __init__(self, folder):
        self.folder = folder
        self.infos = {}

    @property
    def done(self):
        return frozenset(self.infos)

    def record(self, block_id, info):
        assert block_id not in self.infos
        self.infos[block_id] = info


@dataclass(frozen=True)
class Counting:
    """Appends to one file per block, and a line to `opened` per worker."""

    folder: str
    name: str = ""

    def open(self):
        with open(Path(self.folder) / "opened", "a") as file:
            file.write(f"{os.getpid()}{self.name}\n")
        return self

    def run(self, block):
        with open(Path(self.folder) / f"{block.start}.out", "a") as file:
            file.write(f"{block.start} {block.stop}\n")
        return {"rays": float(block.stop - block.start)}


@dataclass(frozen=True)
class Broken:
    folder: str
    error: BaseException
    at: int

    def __hash__(self):
        return hash((self.folder, self.at))

    def open(self):
        return self

    def run(self, block):
        if block.start == self.at:
            raise self.error
        return {}


@dataclass(frozen=True)
class Dying:
    """Kills its process at one block: the first time only (`once`), or whenever it comes there."""

    folder: str
    at: int
    once: bool

    def open(self):
        return self

    def run(self, block):
        mark = Path(self.folder) / "died"
        if block.start == self.at and not (self.once and mark.exists()):
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return {}


@dataclass(frozen=True)
class Sleeping:
    folder: str

    def open(self):
        return self

    def run(self, block):
        (Path(self.folder) / f"pid.{os.getpid()}").touch()
        time.sleep(60)
        return {}


@dataclass(frozen=True)
class FailingBesideASleeper:
    """Block 0 takes a minute; block 1 fails as soon as block 0 has begun."""

    folder: str

    def open(self):
        return self

    def run(self, block):
        if block.start == 0:
            return Sleeping(self.folder).run(block)
        while not list(Path(self.folder).glob("pid.*")):
            time.sleep(0.01)
        raise ValueError("bug")


@dataclass(frozen=True)
class Slow:
    """Notes when a block begins and when it ends, a second later."""

    folder: str

    def open(self):
        return self

    def run(self, block):
        (Path(self.folder) / f"{block.start}.begun").touch()
        time.sleep(1)
        (Path(self.folder) / f"{block.start}.ended").touch()
        return {}
