"""``benchsim calibrate``: photographs of the board become ``camera.toml``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchsim.bench.errors import BenchsimError
from benchsim.bench.marks import read_marks
from benchsim.calibration import BOARD, LENS, TARGETS, Calibration, is_camera, pictures, sight, write_camera
from benchsim.calibration import calibrate as solve
from benchsim.calibration.focus import MATTERS_POINT
from benchsim.jobs.progress import Progress, silent
from benchsim.jobs.shown import Shown
from benchsim.jobs.workers import workers

BOARD_SIGMA = 5.0
"""Shapes of the board below this many sigma are not spoken of."""

BOARD_MATTERS = {"stretch": 2.5e-4, "shear": 2.5e-4, "bow_y_mm": 0.2, "bow_z_mm": 0.2, "twist_mm": 0.2}
"""Nor such as move no mark by more than 0.1 mm on a board of 700 mm, or lift none by more than 0.2 mm."""

STRAY = 0.1
"""Nor are marks named that lie off by less than this [mm]."""


@dataclass(frozen=True, repr=False)
class CalibrateResult(Shown):
    """What ``calibrate`` found and wrote.

    Attributes
    ----------
    file, picture : Path
    board : Path
    calibration : Calibration
    """

    file: Path
    picture: Path
    board: Path
    calibration: Calibration

    def as_dict(self) -> dict[str, Any]:
        """Plain values for ``--json``."""
        c = self.calibration
        b = c.bundle
        return {
            "format": "benchsim-calibration/1",
            "file": str(self.file),
            "picture": str(self.picture),
            "photographs": list(c.names),
            "left_out": [{"photograph": name, "why": why} for name, why in c.left_out],
            "marks": _marks(c),
            "rms_px": _rms(c),
            "lens": _with_sigma(LENS, b.lens, b.sigma[: len(LENS)]),
            "intrinsics_sigma": list(c.intrinsics_sigma),
            "covariance": b.covariance[: len(LENS), : len(LENS)].tolist(),
            "board": _with_sigma(BOARD, b.board, b.sigma[len(LENS) :]),
            "print_sigma_mm": b.print_sigma,
            "focal_by_view": [
                {"photograph": name, "distance_mm": float(d), "change": float(v), "sigma": float(s)}
                for name, d, v, s in zip(c.names, b.distance, c.focal.value[:, 0], c.focal.sigma[:, 0], strict=True)
            ],
            "focal_is_one_probability": c.focal.probability,
            "principal_point_is_one_probability": c.principal_point.probability,
            "fixed_within": dict(c.advice.sigma),
            "poorly_fixed": list(c.advice.poor),
            "views_to_add": list(c.advice.views),
            "fixed_within_then": dict(c.advice.then),
        }

    def summary(self) -> str:
        """The lens, how far to believe it, and what to do next."""
        c = self.calibration
        b, longer = c.bundle, max(c.camera.resolution)
        sigma = b.sigma
        w, h = c.camera.resolution
        lines = [
            f"camera {c.camera.name} from {len(c.names)} photographs of {w} × {h} px, {_marks(c)} marks, residuals "
            f"{_rms(c):.3f} px rms: {self.file}, {self.picture}",
            f"  focal length     {b.lens[0]:.2f} ± {sigma[0]:.2g} px",
            f"  principal point  ({b.lens[1]:.2f} ± {sigma[1]:.2g}, {b.lens[2]:.2f} ± {sigma[2]:.2g}) px",
            "  distortion       "
            + ", ".join(f"{n} = {x:.5g} ± {s:.2g}" for n, x, s in zip(LENS[3:], b.lens[3:], sigma[3:8], strict=True)),
            f"  a line of sight anywhere in the picture: within {c.advice.sigma['lines of sight'] * longer:.2g} px",
            *self._lens_notes(),
            *self._board_notes(),
        ]
        lines += [f"not used: {name}: {why}" for name, why in c.left_out]
        lines += self._advice()
        return "\n".join([*lines, f"next: benchsim new DIR --photos PHOTOS --calibration {self.file}"])

    def _lens_notes(self) -> list[str]:
        c = self.calibration
        moved, point = c.focal, c.principal_point
        wanders = point.seen and point.amount > MATTERS_POINT * max(c.camera.resolution)
        # Of a principal point that moves the focal lengths explain a part.
        if not moved.seen or wanders:
            typical = 100 * float(np.median(moved.sigma))
            out = [
                f"the same focal length in all pictures (p = {moved.probability:.2g}; one view alone gives it within "
                f"{typical:.2g} %)"
            ]
        else:
            out = [
                f"the focal length changes between the pictures by {100 * moved.amount:.2g} % "
                f"(p = {moved.probability:.0e}): little, and added to its uncertainty"
            ]
        if wanders:
            out.append(
                f"the principal point moves between the pictures by {point.amount:.2g} px "
                f"(p = {point.probability:.0e}), as stabilisation does: switch it off; added to its uncertainty"
            )
        return out

    def _board_notes(self) -> list[str]:
        b = self.calibration.bundle
        value, sigma = dict(zip(BOARD, b.board, strict=True)), dict(zip(BOARD, b.sigma[len(LENS) :], strict=True))
        seen = {
            name
            for name in BOARD
            if abs(value[name]) > BOARD_SIGMA * sigma[name] and abs(value[name]) > BOARD_MATTERS[name]
        }
        out = []
        if "stretch" in seen:
            longer, other = ("y", "z") if value["stretch"] > 0 else ("z", "y")
            out.append(
                f"the board is {200 * abs(value['stretch']):.3f} ± {200 * sigma['stretch']:.3f} % longer along "
                f"{longer} than along {other}, compared with {self.board.name}: measure both check rules and correct "
                "it with 'benchsim board --measured-mm Y Z'"
            )
        if "shear" in seen:
            out.append(
                f"the board's axes are {2000 * abs(value['shear']):.2f} ± {2000 * sigma['shear']:.2f} mrad off a right "
                "angle: the print leans, or its tiles do"
            )
        places, sigma_of = b.places, b.places_sigma
        strays = ((np.abs(places) > BOARD_SIGMA * sigma_of) & (np.abs(places) > STRAY)).any(axis=1)
        if strays.any():
            out.append(
                f"marks {', '.join(str(i) for i in b.ids[strays])} lie up to {np.abs(places[strays]).max():.2f} mm "
                f"beside where {self.board.name} puts them: are the tiles joined well?"
            )
        bent = sorted(seen & {"bow_y_mm", "bow_z_mm", "twist_mm"})
        if bent:
            out.append(
                "the board is not flat: "
                + ", ".join(f"{n.removesuffix('_mm')} {value[n]:+.2f} ± {sigma[n]:.2f} mm" for n in bent)
                + " at the outermost marks; put a straightedge across it, and brace it"
            )
        return out

    def _advice(self) -> list[str]:
        a, longer = self.calibration.advice, max(self.calibration.camera.resolution)
        if not a.poor:
            return []

        def say(name: str, x: float) -> str:
            return f"{100 * x:.2g} %" if name == "focal length" else f"{x * longer:.2g} px"

        lines = [
            "poorly fixed: "
            + ", ".join(f"{n} (± {say(n, a.sigma[n])}, wanted {say(n, TARGETS[n])})" for n in a.poor)
            + "; add views:"
        ]
        lines += [f"  {view}" for view in a.views]
        return [*lines, "  with them: " + ", ".join(f"{n} ± {say(n, a.then[n])}" for n in a.poor)]


def _with_sigma(names: Sequence[str], values: Any, sigma: Any) -> dict[str, dict[str, float]]:
    return {n: {"value": float(x), "sigma": float(s)} for n, x, s in zip(names, values, sigma, strict=True)}


def _marks(c: Calibration) -> int:
    return sum(int(u.sum()) for u in c.bundle.used)


def _rms(c: Calibration) -> float:
    return float(np.sqrt(np.mean(c.bundle.rms**2)))


def calibrate(
    photos: Sequence[Path | str],
    output: Path | str | None = None,
    *,
    board: Path | str,
    name: str = "A",
    gamma: float | str = "unknown",
    progress: Progress = silent,
) -> CalibrateResult:
    """Calibrate a camera from photographs of the board.

    Parameters
    ----------
    photos : sequence of path
        Photographs, or folders of them.
    output : path, optional
        File to write; default ``./camera.toml``. The picture of the residuals goes beside it, as PNG of its name.
    board : path
        ``marks.csv`` of the board.
    name : str
        What the camera is called.
    gamma : float, "srgb" or "unknown"
        Goes into the file as it stands.
    progress : callable
        Called with what is being done and the fraction done.

    Returns
    -------
    CalibrateResult

    Raises
    ------
    BenchsimError
        If the photographs cannot be used, the lens changed between them, or the file cannot be written.
    """
    file = Path("camera.toml" if output is None else output)
    picture = file.with_suffix(".png")
    if file.suffix != ".toml":
        raise BenchsimError(f"{file}: camera files are TOML; give a name that ends in .toml with -o")
    if file.exists() and not is_camera(file):
        raise BenchsimError(f"{file}: there is another file of this name; choose another with -o")
    if not file.parent.is_dir():
        raise BenchsimError(f"{file}: there is no folder {file.parent}; make it, or choose another with -o")
    paths = pictures([Path(p) for p in photos])
    if picture.resolve() in {p.resolve() for p in paths}:
        raise BenchsimError(f"{picture}: is one of the photographs and would be replaced; choose another name with -o")
    if not Path(board).exists():
        raise BenchsimError(f"{board}: not there; give --board the marks.csv that 'benchsim board' wrote")
    marks = read_marks(Path(board))
    with workers() as pool:
        found = solve(paths, marks, name=name, gamma=gamma, each=pool.each, progress=progress)
    progress("drawing", 0.96)
    result = CalibrateResult(file, picture, Path(board), found)
    try:
        _draw(result)
        write_camera(
            file,
            found.camera,
            found.intrinsics_sigma,
            found.bundle.covariance[: len(LENS), : len(LENS)],
            photographs=len(found.names),
            marks=_marks(found),
            rms=_rms(found),
            board=Path(board).name,
        )
    except OSError as error:
        raise BenchsimError(f"{file}: cannot be written ({error.strerror}); choose another with -o") from None
    return result


def _draw(result: CalibrateResult) -> None:
    from benchsim.reports import calibration_pictures

    c = result.calibration
    b = c.bundle
    calibration_pictures.calibration(
        result.picture,
        c.camera.resolution,
        c.names,
        [v.corners[u].reshape(-1, 2) for v, u in zip(c.views, b.used, strict=True)],
        [r[u].reshape(-1, 2) for r, u in zip(b.residuals, b.used, strict=True)],
        sight(b),
        b.distance,
        c.focal.value[:, 0],
        c.focal.sigma[:, 0],
        b.rms,
        f"camera {c.camera.name}: {len(c.names)} photographs, {_marks(c)} marks, residuals {_rms(c):.3f} px rms",
        f"one focal length for all pictures? p = {c.focal.probability:.2g}; far to near {100 * c.focal.trend:+.3f} ± "
        f"{100 * c.focal.trend_sigma:.3f} %",
    )
