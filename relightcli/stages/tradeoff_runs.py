"""The commands that a sweep runs, each in a process of its own, and the records of what they took.

A record lies in the report's folder, `runs/NAME-KEY/record.json`, and is written in one step when its command has
ended. The key hangs on the command's arguments and on what it starts from, so that points share what they have in
common, and a sweep that was interrupted, or has grown, runs only what has no record. A command that was cut off is run
again from its start: its seconds are those of a whole run.
"""

from __future__ import annotations

import json
import shutil
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import relight_formats as formats
from relightcli.adapters.files import write_atomic
from relightcli.adapters.processes import run_program
from relightcli.errors import InputError, NumericalError, RelightError, StoreError, SystemFault

FRAMES = 4  # of the turning sky by which frames are timed; the first one also opens the store
_ERRORS: dict[int, type[RelightError]] = {2: InputError, 3: StoreError, 4: NumericalError, 5: SystemFault}
_OUTPUTS = {"precompute": "transfer.zarr", "cluster": "clusters.zarr", "factorize": "asset.zarr"}


@dataclass(frozen=True)
class View:
    """A picture that every point is judged by: a sky (its name, file and fingerprint) and a camera."""

    sky: str
    environment: str
    fingerprint: str
    camera: str

    @property
    def name(self) -> str:
        return f"{self.sky}, {self.camera}"

    @property
    def key(self) -> str:
        return _key(self.fingerprint, self.camera)


@dataclass(frozen=True)
class Step:
    """One command that makes a store. words: its options; source: the step whose store it starts from."""

    stage: str
    words: tuple[str, ...]
    source: Step | None = None

    @property
    def name(self) -> str:
        return f"{self.stage}-{_key(*self._chain())}"

    def _chain(self) -> list[Any]:
        return [*(self.source._chain() if self.source else []), self.stage, list(self.words)]

    def command(self, scene: str) -> list[str]:
        """As a user would type it."""
        start = _OUTPUTS[self.source.stage] if self.source else scene
        return ["relightcli", self.stage, start, "-o", _OUTPUTS[self.stage], *self.words]


@dataclass
class Runs:
    """The report's folder, and how commands are run. `count` is of those that were run, not found."""

    folder: Path
    scene: Path
    workers: int
    allow_outside: bool = False
    count: int = field(default=0, init=False)

    def record(self, name: str) -> list[dict[str, Any]]:
        """All runs of a command so far: seconds, cpu_seconds, peak_bytes, answer (its JSON)."""
        try:
            found: list[dict[str, Any]] = json.loads((self._at(name) / "record.json").read_text())["runs"]
        except FileNotFoundError:
            return []
        except (ValueError, KeyError, TypeError):
            raise StoreError(
                f"{self._at(name) / 'record.json'}: is damaged; delete it, and its run is done again"
            ) from None
        return found

    def make(self, step: Step, times: int) -> None:
        """Runs a step until it has been run `times` times. Its store is kept for the steps that follow."""
        while len(self.record(step.name)) < times:
            self._make(step)

    def store(self, step: Step) -> Path:
        """The step's store; made again, as one more run, where it has been removed since."""
        path = self._at(step.name) / "store.zarr"
        if not path.exists():
            self._make(step)
        return path

    def picture(self, step: Step, view: View) -> Path:
        """The picture of a view with its layers, from the step's store."""
        path = self._at(step.name) / f"picture-{view.key}.exr"
        if not path.exists():
            self._run(["relight", str(self.store(step)), "-o", str(path), "--layers", *_look(view)])
        return path

    def frames(self, step: Step, view: View, times: int) -> str:
        """Times frames of a turning sky; the record's name."""
        name = f"{step.name}/frames-{view.key}"
        while len(self.record(name)) < times:
            folder = self._fresh(self._at(name) / "work")
            shots = folder / "shots.toml"
            shots.write_text(
                f"format = 1\nframes = {FRAMES}\n[[key]]\nframe = 1\nenv = {json.dumps(view.environment)}\n"
                f"env_rotate = 0\n[[key]]\nframe = {FRAMES + 1}\nenv_rotate = 100\n"
            )
            output = str(folder / "####.exr")
            words = ["relight", str(self.store(step)), "--frames", str(shots), "-o", output, "--camera", view.camera]
            self._append(name, self._run(words))
            shutil.rmtree(folder)
        return name

    def reference(self, view: View, spp: int, seed: int, bounces: int) -> tuple[Path, dict[str, Any]]:
        """A path-traced picture and its record."""
        name = f"reference-{_key(view.fingerprint, view.camera, spp, seed, bounces)}"
        path = self._at(name) / "picture.exr"
        if not self.record(name):
            self._fresh(self._at(name))
            words = ["relight", str(self.scene), "-o", str(path), "--layers", "--reference", "--spp", str(spp)]
            words += ["--seed", str(seed), "--bounces", str(bounces), *_look(view)]
            self._append(name, self._run([*words, *(["--allow-outside"] if self.allow_outside else [])]))
        return path, self.record(name)[0]

    def predict(self, step: Step) -> dict[str, Any]:
        """What `precompute --dry-run` says."""
        output = str(self.folder.parent / "predicted.zarr")
        answer: dict[str, Any] = self._run([*self._start(step, output), "--dry-run"])["answer"]
        return answer

    def warm(self, step: Step, view: View) -> None:
        """Runs a step and a picture of it without a record: the first runs on a machine compile."""
        folder = self._fresh(self._at("warm"))
        store = str(folder / "store.zarr")
        self._run(self._start(step, store))
        self._run(["relight", store, "-o", str(folder / "picture.exr"), "--layers", *_look(view)])
        shutil.rmtree(folder)

    def remove_stores(self) -> None:
        """What is recorded stays; the stores can be made again."""
        for path in self.folder.glob("runs/*/store.zarr*"):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()

    def _at(self, name: str) -> Path:
        return self.folder / "runs" / name

    def _fresh(self, folder: Path) -> Path:
        """The folder, empty: what a cut-off run has left in it goes."""
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        return folder

    def _start(self, step: Step, output: str) -> list[str]:
        if step.source is None:
            return [
                *(step.stage, str(self.scene), "-o", output, *step.words),
                *(["--allow-outside"] if self.allow_outside else []),
            ]
        return [step.stage, str(self.store(step.source)), "-o", output, *step.words]

    def _make(self, step: Step) -> None:
        folder = self._at(step.name)
        folder.mkdir(parents=True, exist_ok=True)
        kept, again = folder / "store.zarr", folder / "again.zarr"
        for path in folder.glob("again.zarr*" if self.record(step.name) and kept.exists() else "*.zarr*"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        target = again if kept.exists() else kept
        run = self._run(self._start(step, str(target)))
        self._append(step.name, run)
        if target == again:
            shutil.rmtree(again)

    def _append(self, name: str, run: dict[str, Any]) -> None:
        runs = [*self.record(name), run]
        write_atomic(self._at(name) / "record.json", json.dumps({"runs": runs}, indent=1).encode())

    def _run(self, words: Sequence[str]) -> dict[str, Any]:
        """One command to its end. Raises its error, by its exit code, with its message."""
        done = run_program([sys.executable, "-m", "relightcli", *words, "--workers", str(self.workers), "--json"])
        self.count += 1
        if done.code in (130, -signal.SIGINT, -signal.SIGTERM):
            raise KeyboardInterrupt
        if done.code < 0:
            why = f"was ended by signal {-done.code}; where memory ran out, use fewer --workers"
            raise SystemFault(f"relightcli {words[0]}: {why}")
        if done.code:
            said = done.stderr.strip().splitlines() or ["no message"]
            message = said[-1].removeprefix("relightcli: ").removeprefix("Error: ")
            raise _ERRORS.get(done.code, SystemFault)(f"relightcli {words[0]}: {message}")
        return {
            "seconds": done.seconds,
            "cpu_seconds": done.cpu_seconds,
            "peak_bytes": done.peak_bytes,
            "answer": json.loads(done.stdout),
        }


def _look(view: View) -> list[str]:
    return ["--env", view.environment, "--camera", view.camera]


def _key(*parts: Any) -> str:
    return formats.fingerprint_json(list(parts))[-12:]
