"""Small copies of pictures: thumbnails.py FOLDER PICTURE..."""

import sys
from pathlib import Path

from PIL import Image

SIZE = (400, 300)

folder = Path(sys.argv[1])
folder.mkdir(parents=True, exist_ok=True)
for name in map(Path, sys.argv[2:]):
    with Image.open(name) as picture:
        small = picture.convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)
    small.save(folder / name.name, optimize=True)
    print(folder / name.name)
