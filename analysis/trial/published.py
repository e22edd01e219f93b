"""The published trial: run it with a fresh seed, keep what a referee needs, make its recordings again.

python analysis/trial/published.py run out/trial --cases 150
python analysis/trial/published.py keep out/trial
python analysis/trial/published.py again out/again
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from benchsim import trial
from benchsim.trial import ledger

KEPT = Path(__file__).resolve().parent / "kept"


def keep(folder: Path) -> None:
    """Copy ledger, truths, verdicts, score and page; of the recordings their ledger only."""
    trial.verify(folder)
    shutil.rmtree(KEPT, ignore_errors=True)
    (KEPT / "recordings").mkdir(parents=True)
    shutil.copy(folder / "recordings" / ledger.NAME, KEPT / "recordings")
    for part in ("truth", "verdicts"):
        shutil.copytree(folder / part, KEPT / part)
    (KEPT / "truth").chmod(0o755)
    for name in (ledger.NAME, "score.json", "report.html"):
        shutil.copy(folder / name, KEPT)
    print(trial.verify(KEPT, recordings=False).summary())


def again(folder: Path) -> None:
    """Conceal the same trial from its opened seed, and say which recordings are the same to the byte."""
    plan = json.loads((KEPT / "truth" / "plan.json").read_text(encoding="utf-8"))
    trial.conceal(folder, len(plan["kinds"]), seed=int(plan["seed"], 16), shrink=plan["shrink"], zero=plan["zero"])
    was, now = (ledger.standing(ledger.read(f / "recordings" / ledger.NAME)).concealed for f in (KEPT, folder))
    same = [case for case in was if was[case]["files"] == now[case]["files"]]
    print(f"{len(same)} of {len(was)} recordings are the same to the byte")


def main() -> None:
    """Run, keep, or make again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["run", "keep", "again"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--cases", type=int, default=150)
    parser.add_argument("--workers", type=int, default=None)
    args = parser.parse_args()
    if args.what == "run":
        print(trial.run(args.folder, args.cases, workers=args.workers).summary())
    elif args.what == "keep":
        keep(args.folder)
    else:
        again(args.folder)


if __name__ == "__main__":
    main()
