"""Writes the pictures of the README's gallery: one of each notebook, as it stands there.

python notebooks/figures/gallery.py [folder]
"""

import base64
import json
import sys
from pathlib import Path

# The number of the picture in the notebook, from the first, 0.
CHOSEN = {
    "quickstart": -1,
    "uncertainty": 1,
    "friction": 0,
    "control": 0,
    "poisson": 0,
    "your_kernel": 0,
    "planets": 0,
    "double_pendulum": 1,
    "particles": -1,
    "logs": 2,
    "molecule": 0,
    "arm": 0,
    "paper": 0,
    "formula": 0,
    "families": 0,
}


def main(folder: Path) -> None:
    notebooks = Path(__file__).parents[1]
    for name, which in CHOSEN.items():
        cells = json.loads((notebooks / f"{name}.ipynb").read_text())["cells"]
        outputs = [output for cell in cells for output in cell.get("outputs", [])]
        data = [output.get("data", {}) for output in outputs]
        picture = [each["image/png"] for each in data if "image/png" in each][which]
        (folder / f"gallery_{name}.png").write_bytes(base64.b64decode("".join(picture)))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
