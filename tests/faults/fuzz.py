"""Files of strangers: every parser on valid files that were changed at random.

    python -m tests.faults.fuzz --minutes 10 --seed 0

A parser either returns, or raises one of the program's own errors: no other exception, no more than 2 seconds of
computing a file, no more than 1 GiB beyond what the process had, no death. Each target runs in forks of its own, so
that a crash in a library is found and told with the number of the file, which makes it again.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import json
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import relight_formats as formats
from relight_formats.header import KEY, dump, write_root
from relightcli.adapters.bvh import load_bvh
from relightcli.adapters.images import encode_image, read_environment, read_image, read_texture
from relightcli.adapters.meshes import load_mesh
from relightcli.adapters.ply import encode_ply
from relightcli.adapters.rigs import load_rig
from relightcli.errors import RelightError
from relightcli.scene.model import Camera
from relightcli.scene.motions import load_joint_map
from relightcli.scene.parse import load_scene
from relightcli.stages.relight import Config, relight
from relightcli.stages.shots import Shot, read_shots
from tests.adapters.test_meshes import FACET, SMALL_GLTF, TRIANGLE_OFF, TRIANGLE_PLY, binary_stl
from tests.core.transport.scenes import lambert, square
from tests.faults.children import one_thread
from tests.faults.damage import HARMS, harmed
from tests.stages.pose_files import bar
from tests.stages.scene_files import make_store, write_scene

SECONDS = 2.0  # of computing, for one file
MEMORY = 1 << 30  # beyond what the process has
PATIENCE = 30.0  # seconds that a fork may wait, or compute beyond its time
SLICE = 200  # files from one fork
TOKENS = (
    b"1e999",
    b"-1",
    b"nan",
    b"99999999999999999999",
    b"2147483648",
    b"[" * 2000,
    b"{}",
    b'""',
    b"\0",
    b"\xff" * 4,
)
SHOTS = """format = 1
frames = 3
[[key]]
frame = 1
env = "sky"
env_rotate = 0
exposure = 1
set = { "gold.roughness" = 0.2, "red.diffuse" = [0.6, 0.1, 0.1] }
pose = { man = "walk@0" }
move = { ball = [0, 1, 2] }
[[key]]
frame = 4
env_rotate = 360
set = { "gold.roughness" = 0.4 }
move = { ball = [1, 1, 2] }
"""
LIGHTS = """[lights.lamp]
shape = "sphere"
center = [0, 2, 0]
radius = 0.1
radiance = [20, 20, 18]
[lights.panel]
shape = "rectangle"
center = [0, 2, 0]
edge_u = [1, 0, 0]
edge_v = [0, 0, 1]
radiance = [1, 1, 1]
[accuracy]
tolerance = 0.02
"""
BVH = """HIERARCHY
ROOT hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT knee
  {
    OFFSET 0 1 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 1 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
0 0 0 0 0 0 10 0 0
0 1 0 0 5 0 20 0 0
"""


class TooSlow(BaseException):
    """Not an Exception, so that no parser takes it for one of its own."""


@dataclass(frozen=True)
class Target:
    """name; suffix of the file; valid files; what reads one."""

    name: str
    suffix: str
    seeds: tuple[bytes, ...]
    read: Callable[[Path], object]


def mutated(data: bytes, rng: random.Random) -> bytes:
    """One to six changes: damage, numbers exchanged, tokens put in, pieces doubled, exchanged or left out."""
    for _ in range(rng.randint(1, 6)):
        if not data:
            break
        kind = rng.randrange(6)
        a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
        b = min(b, a + 64)
        if kind == 0:
            data = harmed(data, rng.choice([h for h in HARMS if h not in ("deleted", "emptied")]), rng)
        elif kind == 1:
            data = data[:a] + rng.choice(TOKENS) + data[a:]
        elif kind == 2:
            data = data[:b] + data[a:b] + data[b:]
        elif kind == 3:
            data = data[:a] + data[b:]
        elif kind == 4 and (found := list(re.finditer(rb"-?\d+(?:\.\d+)?", data[: 1 << 16]))):
            at = rng.choice(found)
            data = data[: at.start()] + rng.choice(TOKENS) + data[at.end() :]
        elif len(data) >= 4:
            a = min(a, len(data) - 4)
            word = struct.pack("<I", rng.choice((0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, rng.getrandbits(32))))
            data = data[:a] + word + data[a + 4 :]
    return data


def mutated_json(value: object, rng: random.Random) -> object:
    """A JSON value in which one place holds something else, or nothing."""
    if rng.random() < 0.3 or not isinstance(value, dict | list) or not value:
        return rng.choice([None, True, -1, 0, 1 << 40, 1e300, "", "x", [], {}, [1, 2], {"a": 1}])
    if isinstance(value, dict):
        key = rng.choice(sorted(value))
        if rng.random() < 0.2:
            return {k: v for k, v in value.items() if k != key}
        return {**value, key: mutated_json(value[key], rng)}
    at = rng.randrange(len(value))
    if rng.random() < 0.2:
        return value[:at] + value[at + 1 :]
    return [*value[:at], mutated_json(value[at], rng), *value[at + 1 :]]


def file_targets(folder: Path) -> list[Target]:
    """Parsers of one file, with valid files for each."""
    rng = np.random.default_rng(1)
    parts = {"ground": square(1, material=lambert(0.5))}
    cameras = [Camera("main", (0, 1.5, 4), (0, 0.5, 0), size=(4, 3))]
    scene = write_scene(folder / "scene", parts, cameras, {"sky": rng.random((2, 4, 3))}, adjustable=True, more=LIGHTS)
    glb = bar(folder / "bar.glb").read_bytes()
    rig = load_rig(folder / "bar.glb")[1]
    corners, triangles = parts["ground"].corners, parts["ground"].triangles
    ply = encode_ply(corners, triangles, np.ones_like(corners))
    obj = (folder / "scene" / "ground.obj").read_bytes()
    pixels = rng.random((4, 8, 3)).astype(np.float32)
    default = Shot(1, None, 0.0, None, 0.0, ())
    joints = b'[joints]\nlow = "hips"\nhigh = "knee"\n'

    def scene_file(path: Path) -> object:
        # Beside the files that it names.
        beside = folder / "scene" / path.name
        beside.write_bytes(path.read_bytes())
        return load_scene(beside)

    def picture(path: Path) -> object:
        with contextlib.suppress(RelightError):
            read_image(path)
        with contextlib.suppress(RelightError):
            read_texture(path)
        return read_environment(path)

    pictures = [
        Target(f"picture {suffix}", suffix, (encode_image(suffix, pixels, layers={}, metadata={}),), picture)
        for suffix in (".exr", ".hdr", ".tif", ".png", ".jpg")
    ]
    return [
        Target("scene", ".toml", (scene.read_bytes(),), scene_file),
        Target("keyframes", ".toml", (SHOTS.encode(),), lambda path: read_shots(path, default)),
        Target("joint map", ".toml", (joints,), lambda path: load_joint_map(path, rig)),
        Target("BVH", ".bvh", (BVH.encode(),), load_bvh),
        Target("PLY", ".ply", (TRIANGLE_PLY.encode(), ply), load_mesh),
        Target("OBJ", ".obj", (obj,), load_mesh),
        Target("OFF", ".off", (TRIANGLE_OFF.encode(),), load_mesh),
        Target("STL", ".stl", (f"solid x\n{FACET}endsolid x\n".encode(), binary_stl([np.eye(3)])), load_mesh),
        Target("glTF", ".gltf", (SMALL_GLTF.encode(),), load_mesh),
        Target("GLB", ".glb", (glb,), load_mesh),
        Target("skinned GLB", ".glb", (glb,), load_rig),
        *pictures,
    ]


def store_target(folder: Path) -> Target:
    """A store whose metadata somebody has rewritten, with digests that fit: opened, verified, read."""
    path = folder / "store.zarr"
    with formats.begin(path, "transfer", settings={"a": 1}, inputs={"b": "c"}, program="p") as writer:  # type: ignore[union-attr]
        writer.set_attrs({"scene": {"objects": ["a"], "more": [1, 2.5]}})
        writer.put("group/values", np.arange(12.0).reshape(3, 4), dims=("a", "b"))
        writer.put("bits", np.arange(5, dtype=np.uint8), dims=("c",), codec="zstd")
        writer.record("block/0", {"rays": 3.0})
        writer.commit({"seconds": 1.0})
    documents = {p.relative_to(path).as_posix(): p.read_bytes() for p in sorted(path.rglob("zarr.json"))}

    def read(file: Path) -> object:
        rng = random.Random(file.read_bytes())
        for name, content in documents.items():
            (path / name).write_bytes(content)
        name = rng.choice(sorted(documents))
        changed = mutated_json(json.loads(documents[name]), rng)
        if not isinstance(changed, dict):
            return None
        (path / name).write_bytes(dump(changed))
        if name != "zarr.json":
            _fit(path, name)
        elif isinstance(changed.get("attributes"), dict) and isinstance(changed["attributes"].get(KEY), dict):
            attributes = dict(changed["attributes"])
            write_root(path, attributes.pop(KEY), attributes)
        with contextlib.suppress(RelightError):
            formats.progress(path)
        store = formats.open_store(path)
        store.verify()
        for array in store.names():
            # As the stages do: what an untrusted shape asks for is looked at first.
            if store.layouts[array].raw_bytes < 1 << 20:
                with contextlib.suppress(RelightError):
                    store.read(array)
        return store.sizes()

    return Target("store", ".seed", (b"0123456789abcdef",), read)


def stage_target(folder: Path) -> Target:
    """A transfer store whose description somebody has rewritten, with digests that fit: a picture is made from it."""
    path = make_store(folder / "scene" / "scene.toml", light_resolution=16, subdivide=False)
    original = (path / "zarr.json").read_bytes()

    def read(file: Path) -> object:
        rng = random.Random(file.read_bytes())
        attributes = json.loads(original)["attributes"]
        header = attributes.pop(KEY)
        changed = mutated_json({"settings": header["settings"], "attributes": attributes}, rng)
        if not isinstance(changed, dict) or not all(isinstance(v, dict) for v in changed.values()):
            return None
        header["settings"] = changed.get("settings", {})
        write_root(path, header, changed.get("attributes", {}))
        return relight(Config(path, str(folder / "stage.exr"), env=str(folder / "scene" / "sky-sky.exr")))

    return Target("description", ".seed", (b"0123456789abcdef",), read)


def _fit(path: Path, name: str) -> None:
    """Bring the ledger's and the root's digests in line with a changed document."""
    from relight_formats.fingerprint import fingerprint_bytes

    ledger_file, root_file = path / "ledger" / "zarr.json", path / "zarr.json"
    if name != "ledger/zarr.json":
        ledger = json.loads(ledger_file.read_text())
        ledger["attributes"]["documents"][name] = fingerprint_bytes((path / name).read_bytes())
        ledger_file.write_bytes(dump(ledger))
    attributes = json.loads(root_file.read_text())["attributes"]
    header = {**attributes.pop(KEY), "ledger": fingerprint_bytes(ledger_file.read_bytes())}
    write_root(path, header, attributes)


def all_targets(folder: Path) -> list[Target]:
    return [*file_targets(folder), store_target(folder), stage_target(folder)]


def attempt(target: Target, folder: Path, rng: random.Random) -> str:
    """Reads one changed file; what is wrong with how that ended, or nothing."""
    path = folder / f"file{target.suffix}"
    path.write_bytes(mutated(rng.choice(target.seeds), rng))

    def late(signum: int, frame: object) -> None:
        raise TooSlow

    old = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS, SECONDS)  # again, for it may come where exceptions are dropped
    try:
        target.read(path)
    except RelightError:
        pass
    except TooSlow:
        return f"takes more than {SECONDS:g} s"
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, old)
    return ""


def _slice(target: Target, folder: Path, seed: int, first: int, until: float, told: int, stacks: int) -> None:
    """In a fork: files `first` to `first` + SLICE, each problem as a line, and the number of files at the end."""
    faulthandler.register(signal.SIGUSR1, stacks)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    for number in range(first, first + SLICE):
        os.pwrite(told, b"%-12d\n" % (number - first), 0)
        problem = attempt(target, folder, random.Random(f"{seed}/{target.name}/{number}"))
        if problem:
            os.lseek(told, 0, os.SEEK_END)
            os.write(told, f"{target.name} {number}: {problem}\n".encode())
        if time.monotonic() > until:
            break


def _wait(pid: int, until: float) -> tuple[int, str]:
    """Exit status of a fork, and what was wrong when it had to be killed: it waited for something that does not come,
    or computed without an end. One whose turn has not come yet, on a busy machine, does neither."""
    known, since = -1.0, until
    late = None
    while True:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return status, ""
        now = time.monotonic()
        if now > until:
            computed, waits = _doing(pid)
            late = computed if late is None else late
            if computed != known or not waits:
                known, since = computed, now
            problem = "waits" if now - since > PATIENCE else "computes" if computed - late > PATIENCE else ""
            if problem:
                os.kill(pid, signal.SIGUSR1)  # it tells where
                time.sleep(1.0)
                os.kill(pid, signal.SIGKILL)
                return os.waitpid(pid, 0)[1], f"{problem} without an end"
        time.sleep(0.005)


def _doing(pid: int) -> tuple[float, bool]:
    """Seconds that a process has computed, and whether all of its threads wait."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    states = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(OSError):  # it has just ended
            states.append((task / "stat").read_text().rpartition(")")[2].split()[0])
    return seconds, "R" not in states and "D" not in states


def _where(stacks: str) -> str:
    """The innermost places of every thread, from what faulthandler writes."""
    threads = [re.findall(r'File "[^"]*?([^"/]+)", line (\d+) in (\S+)', text) for text in stacks.split("hread ")]
    return "; ".join(" < ".join(f"{f}:{line} {name}" for f, line, name in places[:6]) for places in threads if places)


def fuzz(targets: list[Target], folder: Path, seed: int, seconds: float) -> tuple[dict[str, int], list[str]]:
    """Files per target, and the problems found. The targets share the time."""
    for target in targets:  # the valid files, so that forks find everything loaded
        for k, data in enumerate(target.seeds):
            path = folder / f"valid{k}{target.suffix}"
            path.write_bytes(data)
            target.read(path)
    count, problems = dict.fromkeys((t.name for t in targets), 0), []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        for target in targets:
            with tempfile.TemporaryFile() as told, tempfile.TemporaryFile() as stacks:
                until = min(end, time.monotonic() + max(0.2, seconds / (10 * len(targets))))
                pid = os.fork()
                if pid == 0:
                    try:
                        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # libraries complain about every file
                        _slice(target, folder, seed, count[target.name], until, told.fileno(), stacks.fileno())
                        os._exit(0)
                    finally:
                        os._exit(1)
                status, late = _wait(pid, until)
                told.seek(0)
                stacks.seek(0)
                first, *lines = told.read().decode().splitlines()
                problems += lines
                if status:
                    number = count[target.name] + int(first)
                    how = f"ends the process ({os.waitstatus_to_exitcode(status)})"
                    if late:
                        how = f"{late}: {_where(stacks.read().decode())}"
                    problems.append(f"{target.name} {number}: {how}")
                count[target.name] += int(first) + 1
            if time.monotonic() > end:
                break
    return count, problems


def main() -> int:
    parser = argparse.ArgumentParser(prog="tests.faults.fuzz")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, help="file of figures to be written")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as name:
        folder = Path(name)
        targets = all_targets(folder)
        count, problems = fuzz(targets, folder, asked.seed, 60.0 * asked.minutes)
    if asked.results:
        found = {"seed": asked.seed, "minutes": asked.minutes, "files": count, "problems": problems}
        asked.results.parent.mkdir(parents=True, exist_ok=True)
        asked.results.write_text(json.dumps(found, indent=1) + "\n")
    for target, files in count.items():
        print(f"{target}: {files} files")
    print(*problems, sep="\n")
    print(f"{sum(count.values())} files, {len(problems)} problems, seed {asked.seed}, {asked.minutes:g} minutes")
    return 1 if problems else 0


if __name__ == "__main__":
    one_thread("tests.faults.fuzz")
    sys.exit(main())
