"""BVH files, made here and captured."""

import numpy as np
import pytest

from relightcli.adapters.bvh import load_bvh
from relightcli.core.pose.clip import rotation_vector
from relightcli.errors import InputError

TEXT = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Knee
  {
    OFFSET 0 -2 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 -1 0
    }
  }
  JOINT Tail
  {
    OFFSET 0 0 -1
    CHANNELS 1 Xrotation
  }
}
MOTION
Frames: 2
Frame Time: 0.25
1 2 3 0 0 0 0 0 0 0
1 2 4 90 0 90 0 30 0 -45
"""


def write(folder, text=TEXT):
    path = folder / "a.bvh"
    path.write_text(text)
    return path


def test_joints_offsets_and_channels(tmp_path):
    motion = load_bvh(write(tmp_path))
    assert motion.names == ("Hips", "Knee", "Tail")
    assert motion.parent.tolist() == [-1, 0, 0]
    assert motion.offset.tolist() == [[0, 0, 0], [0, -2, 0], [0, 0, -1]]
    assert motion.seconds.tolist() == [0, 0.25]
    assert motion.translation[1].tolist() == [[1, 2, 4], [0, -2, 0], [0, 0, -1]]
    # Z then X, each about turned axes: Rz(90) Rx(90) is a third of a turn about (1, 1, 1).
    vectors = rotation_vector(motion.rotation[1])
    assert np.allclose(vectors[0], 2 * np.pi / 3 / np.sqrt(3), atol=1e-14)
    assert np.allclose(vectors[1:], [[np.pi / 6, 0, 0], [-np.pi / 4, 0, 0]], atol=1e-14)
    assert np.allclose(motion.rotation[0], [0, 0, 0, 1])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MOTION", "MOVES", "no line MOTION"),
        ("HIERARCHY", "TREE", "line 1: expected HIERARCHY, found 'TREE'"),
        ("OFFSET 0 -2 0", "OFFSET 0 x 0", "line 8: expected a number, found 'x'"),
        ("CHANNELS 1 Xrotation", "CHANNELS 1 Wrotation", "line 18: expected a channel such as .*Wrotation"),
        ("CHANNELS 1 Xrotation", "CHANNELS 7 Xrotation", "line 18: expected 0 to 6 channels"),
        ("JOINT Tail", "JOINT Knee", "another name"),
        ("JOINT Tail", "BONE Tail", "expected JOINT, End Site or }, found 'BONE'"),
        ("}\nMOTION", "MOTION", "is it cut short"),
        ("Frames: 2", "Frames: two", "expected 'Frames:' with a number"),
        ("Frames: 2", "Frames: 0", "whole number of frames"),
        ("Frames: 2", "Frames: 1e999", "whole number of frames and a time above 0, found inf"),
        ("Frames: 2", "Frames: 3", "expected 3 frames of 10 finite numbers, found 20"),
        ("Frame Time: 0.25", "Frame Time: 0", "a time above 0"),
        ("1 2 3 0", "1 2 nan 0", "1 of them not finite"),
        ("1 2 3 0", "1 2 ? 0", "expected numbers after Frame Time"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, old, new, message):
    assert old in TEXT
    with pytest.raises(InputError, match=f"a.bvh: .*{message}"):
        load_bvh(write(tmp_path, TEXT.replace(old, new, 1)))


def test_captured_walks(shared_data):
    motion = load_bvh(shared_data / "skinned" / "bvh" / "01_01.bvh")
    assert len(motion.names) == 31
    assert motion.rotation.shape == (2752, 31, 4)
    assert np.allclose(np.linalg.norm(motion.rotation, axis=2), 1, atol=1e-12)
