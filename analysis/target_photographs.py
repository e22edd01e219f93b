"""The beam's centroid in photographs of a tower's targets, against the focal spots that came with them.

Every ``*-raw.png`` below the folder, with its calibration properties beside it and the tower file above it: a table of
the centroid with its error bar, what that consists of, and the distance to the spots of UTIS and HeliOS; and a picture
of each rectified target with marks, contour and centroids.

UTIS reads grey counts, as they are, with a neural network: compare its spot also with what *counts as light* gives.

    python analysis/target_photographs.py [FOLDER] [--templates FOLDER] [-o DIR]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.instruments.mount.beam_light import beam_on
from benchsim.instruments.mount.paint import METHODS
from benchsim.instruments.mount.photograph import TargetPhotograph, measure_beam, on_target, rectified

DATA = Path(__file__).resolve().parents[2] / "shared" / "recordings" / "heliostat-juelich"
COLOURS = {"UTIS": "tab:blue", "HeliOS": "tab:green"}


def spots(found: TargetPhotograph) -> dict[str, np.ndarray]:
    """(east, up) mm of each published focal spot."""
    name = found.path.name.removesuffix("-raw.png") + "-calibration-properties.json"
    published = json.loads((found.path.parent / name).read_text())["focal_spot"]
    return {m: on_target(found, np.array(published[m])) for m in METHODS if published.get(m)}


def colours(found: TargetPhotograph) -> str:
    """Which curve the beam's own colour asks for.

    The beam adds light of one colour to a background of another: red and blue less background are proportional to
    green less background, if counts are turned into light by the right curve. Misfit of that, relative to the most
    light, for counts to the power γ.
    """
    counts = cv2.imread(str(found.path)).astype(np.float32) / 255
    maps = [rectified(found, counts[..., k]) for k in range(3)]
    bare = rectified(found, (~found.marks.ink).astype(np.float32)) > 0.99
    inside = cv2.erode(found.beam.inside.astype(np.uint8), np.ones((3, 3))) > 0
    inside &= np.max(maps, axis=0) < 0.95
    told = []
    for gamma in (1.0, 1.4, 1.8, 2.2, 2.6, 3.2):
        net = [beam_on(m**gamma, bare).net[inside] for m in maps]
        bins = np.digitize(net[1], np.quantile(net[1], np.linspace(0, 1, 16))[1:-1])
        b, g, r = (np.array([n[bins == k].mean() for k in range(15)]) for n in net)
        off = [np.std(y - g * (y @ g) / (g @ g)) / y.max() for y in (r, b)]
        told.append(f"{gamma:g}: {off[0]:.1%} and {off[1]:.1%}")
    return "  misfit of one colour (red, blue) for counts to the power  " + ", ".join(told)


def ellipse(found: TargetPhotograph) -> np.ndarray:
    """The 95 % ellipse, (2, n) mm."""
    turn = np.linspace(0, 2 * np.pi, 90)
    root = np.linalg.cholesky(found.covariance) * np.sqrt(5.99)
    return found.centroid[:, None] + root @ [np.cos(turn), np.sin(turn)]


def picture(found: TargetPhotograph, path: Path) -> None:
    """The rectified target as seen from the heliostats: east on the left."""
    e0, e1, u0, u1 = np.array(found.extent) / 1e3
    fig, axes = plt.subplots(1, 3, figsize=(17, 6.2), layout="constrained", width_ratios=[1, 1, 0.8])
    for ax, image, title in (
        (axes[0], found.light, "light"),
        (axes[1], found.beam.net, "light less background"),
        (axes[2], found.beam.net, "about the centroid"),
    ):
        scale = found.beam.peak * (0.25 if ax is axes[1] else 1)
        scale = np.quantile(image, 0.995) if ax is axes[0] else scale
        low = -scale * 0.2 if ax is axes[1] else 0
        shown = ax.imshow(image, origin="lower", extent=(e0, e1, u0, u1), cmap="gray", vmin=low, vmax=scale)
        fig.colorbar(shown, ax=ax, shrink=0.7)
        ax.contour(
            found.beam.inside, levels=[0.5], colors="tab:orange", linewidths=1, extent=(e0, e1, u0, u1), origin="lower"
        )
        for name, at in spots(found).items():
            ax.plot(*at / 1e3, "+", color=COLOURS[name], markersize=11, label=name)
        ax.plot(*found.centroid / 1e3, "x", color="tab:red", label="centroid, 95 % ellipse")
        ax.plot(*ellipse(found) / 1e3, color="tab:red", linewidth=1)
        ax.set(title=title, xlabel="east of the target's centre [m]", ylabel="up [m]")
    marks = found.marks
    ax = axes[0]
    ax.plot(*marks.plane.T / 1e3, "s", mfc="none", color="tab:cyan", label="marks, residual × 20")
    ax.quiver(
        *marks.plane.T / 1e3, *marks.residual.T / 1e3 * 20, angles="xy", scale_units="xy", scale=1, color="tab:cyan"
    )
    margin = 0.4
    ax.set(
        xlim=(e1 + margin, e0 - margin),
        ylim=(marks.plane[:, 1].min() / 1e3 - margin, marks.plane[:, 1].max() / 1e3 + margin),
    )
    axes[1].set(xlim=(e1, e0), ylim=(u0, u1))
    east, up = found.centroid / 1e3
    axes[2].set(xlim=(east + 0.25, east - 0.25), ylim=(up - 0.25, up + 0.25))
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, fontsize=8)
    fig.suptitle(f"{found.path.name}, {found.target}")
    fig.savefig(path, dpi=110)
    plt.close(fig)


def table(found: TargetPhotograph) -> list[str]:
    s = found.sigma
    lines = [
        f"{found.path.name}  {found.target}",
        f"  centroid  east {found.centroid[0] / 1e3:+.3f} ± {s[0] / 1e3:.3f} m, up {found.centroid[1] / 1e3:+.3f} ± "
        f"{s[1] / 1e3:.3f} m;  {found.geodetic[0]:.8f}° {found.geodetic[1]:.8f}° {found.geodetic[2]:.3f} m",
        "  error bar [mm, east/up]  "
        + ", ".join("{} {:.0f}/{:.0f}".format(k, *np.sqrt(np.diag(v))) for k, v in found.parts.items()),
        f"  marks  {found.marks.used.sum()} used, residual {found.marks.rms:.1f} mm rms, σ {found.marks.sigma:.1f} mm, "
        f"correlation {found.marks.score.min():.2f} to {found.marks.score.max():.2f}; "
        f"beam {found.saturated:.1%} saturated",
    ]
    lines.append(
        "  other choices move it by [mm]  "
        + ", ".join("{} {:+.0f}/{:+.0f}".format(k, *m) for k, m in found.moves.items())
    )
    for name, at in spots(found).items():
        off = found.centroid - at
        pull = np.sqrt(off @ np.linalg.solve(found.covariance, off))
        lines.append(
            f"  less {name:6}  east {off[0]:+.0f} mm, up {off[1]:+.0f} mm: {np.linalg.norm(off):.0f} mm, {pull:.1f} σ"
        )
    lines.append(colours(found))
    return lines + [f"  {s}" for s in found.says]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=DATA)
    parser.add_argument("--templates", type=Path, default=DATA / "markers")
    parser.add_argument("-o", "--out", type=Path, default=Path("target-photographs"))
    options = parser.parse_args()
    photographs = sorted(options.folder.rglob("*-raw.png"))
    if not photographs:
        parser.exit(1, f"{options.folder}: holds no *-raw.png; give a folder of raw target photographs\n")
    options.out.mkdir(parents=True, exist_ok=True)
    for path in photographs:
        try:
            found = measure_beam(path, options.templates)
        except BenchsimError as e:
            print(e)
            continue
        print("\n".join(table(found)))
        picture(found, options.out / f"{path.stem}.png")


if __name__ == "__main__":
    main()
