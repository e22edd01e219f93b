"""What the report page of a mount's diagnosis is drawn from, beside ``diagnosis.json``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from benchsim.reports.page import FORMAT

if TYPE_CHECKING:
    from benchsim.jobs.mount_diagnosis import MountDiagnosis


def page(result: MountDiagnosis) -> dict[str, Any]:
    """``page.json``: residuals across and up, by the number of the record."""
    d, problem = result.diagnosis, result.built.problem
    r, unit = d.residuals, result.session.mount.unit

    def plain(values: Any) -> list[float | None]:
        return [float(v) if np.isfinite(v) else None for v in values]

    rows = []
    for kind in ("across", "up"):
        mine = problem.kind == kind
        rows.append(
            {
                "exposure": f"{kind} ({unit})",
                "setting": "",
                "photograph": None,
                "size_px": [1, 1],
                "same": d.verdict == "nothing-missing",
                "measured_px": [],
                "before_px": [],
                "after_px": [],
                "s_mm": [float(k) for k in range(1, int(mine.sum()) + 1)],
                "residual_mm": {
                    "before": plain(r.before[mine]),
                    "after": plain(r.after[mine]),
                    "held_out_before": plain(r.held_out_before[mine]),
                    "held_out_after": plain(r.held_out_after[mine]),
                },
                "sigma_mm": plain(r.sigma[mine]),
                "sigma_alone_mm": plain(r.sigma[mine]),
            }
        )
    found = d.verdict != "nothing-missing"
    return {
        "format": FORMAT,
        "title": result.session.title,
        "instrument": "mount",
        "unit": unit,
        "settings": len(problem.names),
        "states": {
            "before": "the mount as stated",
            "after": "with what was found" if found else "the mount as stated",
        },
        "catalogue": [{"name": e.name, "element": e.element, "says": e.says} for e in problem.catalogue],
        "exposures": rows,
    }
