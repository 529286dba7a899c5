"""A new picture from a store: a fresh process, its lighting, further frames."""

from __future__ import annotations

import statistics
import sys

from benchmarks.processes import run_program, run_tool
from benchmarks.report import Report, Row, Table, at_most
from benchmarks.scenes import Setting, all_skies, main_store, write_scene

RUNS = 3  # per sky
FRAMES = """\
format = 1
frames = {frames}

[[key]]
frame = 1
env_rotate = 0

[[key]]
frame = {beyond}
env_rotate = 360
"""


def measure(setting: Setting) -> Report:
    _, subject = write_scene(setting)
    store, skies = main_store(setting), all_skies(setting)
    report = Report(f"{subject}, 640x480, EXR, {len(skies)} skies")
    out = setting.work / "picture.exr"
    run_tool("relight", store, "--env", next(iter(skies.values())), "-o", out)  # compiled code onto disk
    seconds, lighting = {}, {}
    for name, path in skies.items():
        runs = [run_tool("relight", store, "--env", path, "-o", out) for _ in range(RUNS)]
        seconds[name] = statistics.median(finished.seconds for finished, _ in runs)
        lighting[name] = statistics.median(said["lighting_seconds"] for _, said in runs)
    slowest, darkest = max(seconds, key=seconds.__getitem__), max(lighting, key=lighting.__getitem__)
    frames = 4 if setting.quick else 12
    shots = setting.work / "frames.toml"
    shots.write_text(FRAMES.format(frames=frames, beyond=frames + 1))
    _, said = run_tool(
        "relight", store, "--env", skies[slowest], "--frames", shots, "-o", setting.work / "frame.####.exr"
    )
    further = said["frame_seconds"][1:]
    program = (sys.executable, "-m", "relightcli")
    help_seconds = statistics.median(run_program(*program, "--help").seconds for _ in range(5))
    report.rows += [
        at_most(f"picture, start of the program to its end, median of {RUNS}, slowest sky", seconds[slowest], "s", 2.5),
        at_most(f"its lighting, median of {RUNS}, slowest sky", lighting[darkest], "s", 0.1),
        at_most(f"further frames of a sequence, file written; slowest of {len(further)}", max(further), "s", 0.3),
        Row("the same, median", statistics.median(further), "s"),
        at_most("relightcli --help, median of 5", help_seconds, "s", 0.4),
    ]
    rows = tuple((name, seconds[name], lighting[name]) for name in skies)
    report.tables.append(Table("medians by sky", ("sky", "s", "of these lighting"), rows))
    return report
