"""The README's two pictures: a rendered trace with the model through it, and the page of a verdict.

python analysis/readme_pictures.py            # five minutes of CPU; needs chromium
python analysis/readme_pictures.py RUN DIAGNOSIS   # from finished folders of `run` and `diagnose`
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from benchsim import jobs

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "pictures"
WIDTH = 800
"""px of each picture."""


def made(folder: Path) -> tuple[Path, Path]:
    """Fig. 7 run, and a bowed board diagnosed."""
    jobs.run(output=folder / "run")
    scene = ROOT / "scenes" / "campaign12.toml"
    jobs.render(scene, folder / "recording", effects=["screen-bow.bow_z=0.002"], conceal=True)
    jobs.diagnose(folder / "recording", folder / "diagnosis")
    return folder / "run", folder / "diagnosis"


def small(path: Path, name: str, height: int | None = None) -> int:
    """A picture made small, cut below a height; returns how high it is [px]."""
    with Image.open(path) as opened:
        picture = opened.convert("RGB")
    picture = picture.resize((WIDTH, picture.height * WIDTH // picture.width), Image.Resampling.LANCZOS)
    picture = picture.crop((0, 0, WIDTH, height or picture.height))
    picture.quantize(128, dither=Image.Dither.NONE).save(PICTURES / name, optimize=True)
    return picture.height


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        run, diagnosis = map(Path, sys.argv[1:]) if len(sys.argv) > 1 else made(Path(temporary))
        height = small(run / "overlay-001.png", "trace.png")
        page = Path(temporary) / "page.png"
        chromium = shutil.which("chromium") or sys.exit("chromium: not there; install it")
        options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--force-device-scale-factor=1.5"]
        subprocess.run(
            [chromium, *options, f"--screenshot={page}", "--window-size=1100,825", f"file://{diagnosis}/report.html"],
            check=True,
            capture_output=True,
        )
        small(page, "verdict.png", height)
    for path in sorted(PICTURES.iterdir()):
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
