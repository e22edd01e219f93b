"""A year's energy by four days, as ``benchsim flux --year`` has it, against the hours of all days; shipped plants.

    python analysis/plant_year.py [--every 1]

No chance enters. ``--every``: of so many days one, to be quicker.
"""

from __future__ import annotations

import argparse
from datetime import date, timedelta
from pathlib import Path

import benchsim as bs
from benchsim.plant import files

PLANTS = Path(__file__).resolve().parents[1] / "scenes" / "plants"
NAMES = ("five", "six", "radial100")
YEAR = 2026
CELLS = 20
"""Along and up of a map: sums are the same to 0.1 % from here on."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--every", type=int, default=1, help="days (default %(default)s)")
    every = parser.parse_args().every
    for name in NAMES:
        plant = files.read(PLANTS / name)
        four = bs.flux(plant, year=YEAR, cells=CELLS).total("power").sum()
        days = [date(YEAR, 1, 1) + timedelta(days=k) for k in range(0, 365, every)]
        sums = [bs.flux(plant, day=str(day), cells=CELLS).total("power").sum() for day in days]
        whole = 365.25 * sum(sums) / len(sums)
        print(f"{name}: {four / 1e6:.4g} GWh by four days, {whole / 1e6:.4g} by {len(days)}: {four / whole - 1:+.2%}")


if __name__ == "__main__":
    main()
